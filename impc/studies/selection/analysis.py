"""Sensitive parameters of a study (chapter 4): per subject, in common, and for all at once."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.errors import DataError
from impc.studies.selection.subject import Chosen, Nominal, fit_chosen, fit_nominal
from impc.studies.selection.subsets import largest_subsets, sweep

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from impc.arrays import Array
    from impc.studies.selection.model import Trial
    from impc.studies.selection.model_source import Runner
    from impc.studies.selection.settings import SelectSettings
    from impc.studies.selection.subsets import Selection


@dataclass(frozen=True)
class StudySelection:
    """The study."""

    # Subject (and visit) -> all parameters fitted, information, feasible subsets
    nominal: Mapping[str, Nominal]
    # (5.5): the variance holds for every subject and visit; a sweep
    worst_case: tuple[Selection, ...]
    # Subsets that are among the largest of every subject at the bound (chapter 4)
    intersection: tuple[tuple[int, ...], ...]
    # The subset that is refitted: the best of the worst case at the bound, or at the first bound of
    # the sweep that has one; failing that the most frequent of the subjects'
    free: tuple[int, ...]
    chosen: Mapping[str, Chosen]  # Subject -> refit of that subset, intervals, LASSO
    lasso: tuple[int, ...]  # What the LASSO selects most often
    # "fim", "lasso" and, when it was asked for, "nelder_mead": time in s, mean over subjects
    seconds: Mapping[str, float]


def select_study(
    recorded: Mapping[str, Sequence[Trial]], settings: SelectSettings, run: Runner
) -> StudySelection:
    """Select sensitive parameters."""
    if not recorded:
        raise DataError("study", "has no subject", "check where it looks for recordings")
    trials = {name: tuple(item) for name, item in recorded.items()}
    nominal = run(fit_nominal, Nominal, {name: (trials[name], settings) for name in trials})
    informations = [np.asarray(item.information.F) for item in nominal.values()]
    worst = sweep(informations, settings.bounds, settings.least)
    free = _free(informations, worst, nominal, settings)
    chosen = run(fit_chosen, Chosen, {name: (trials[name], settings, free) for name in trials})
    seconds = {
        "fim": float(np.mean([item.seconds for item in nominal.values()])),
        "lasso": float(np.mean([item.seconds_lasso for item in chosen.values()])),
    }
    if settings.nelder_mead:
        spent = [item.seconds_nelder_mead for item in chosen.values()]
        seconds["nelder_mead"] = float(np.mean(spent))
    return StudySelection(
        nominal,
        worst,
        _intersection(informations, settings),
        free,
        chosen,
        Counter(item.lasso.selected for item in chosen.values()).most_common(1)[0][0],
        seconds,
    )


def _free(
    informations: list[Array],
    worst: tuple[Selection, ...],
    nominal: Mapping[str, Nominal],
    settings: SelectSettings,
) -> tuple[int, ...]:
    at_bound = largest_subsets(informations, settings.bound, settings.least)
    for selection in (at_bound, *worst):
        if selection.subsets:
            return selection.subsets[0]
    counted = Counter(
        subset
        for item in nominal.values()
        for selection in item.sweep[:1]
        for subset in selection.subsets
    )
    if not counted:
        raise DataError(
            "selection", "no subset is feasible at any bound", "raise [select] bound or lower least"
        )
    return counted.most_common(1)[0][0]


def _intersection(
    informations: list[Array], settings: SelectSettings
) -> tuple[tuple[int, ...], ...]:
    lists = [
        set(largest_subsets([F], settings.bound, settings.least).subsets) for F in informations
    ]
    return tuple(sorted(set.intersection(*lists)))
