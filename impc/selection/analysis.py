"""Sensitive parameters of a study (chapter 4): per subject, in common, and for all at once."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from impc.errors import DataError, InputError
from impc.selection.bootstrap import bootstrap_subset, draw_blocks, draw_single
from impc.selection.estimation import estimate, multi_start
from impc.selection.fisher import fisher_information, null_directions, unseen_scalings
from impc.selection.lasso import lasso_of_size, table_c1
from impc.selection.modern import agreement, collinearity, fixed_bias
from impc.selection.subsets import largest_subsets, sweep

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from impc.arrays import Array
    from impc.selection.bootstrap import BootstrapIntervals
    from impc.selection.estimation import Estimate
    from impc.selection.fisher import Information, NullDirection
    from impc.selection.lasso import Lasso
    from impc.selection.model import ParametricModel, Trial
    from impc.selection.modern import FixedBias
    from impc.selection.subsets import Selection

__all__ = [
    "SelectSettings",
    "StudySelection",
    "SubjectSelection",
    "select_settings",
    "select_study",
]

_DRAW = {"single": draw_single, "block": draw_blocks}


@dataclass(frozen=True)
class SelectSettings:
    """The [select] table.

    Attributes
    ----------
    bound : float
        v, largest variance in normalised units, of the subset that is refitted.
    bounds : list of float
        Of the sweep.
    least : int
        n_min.
    size : int
        Parameters that the LASSO is to leave.
    starts : int
        Of the nominal fit.
    replicates : int
        Of the bootstrap.
    draw : "single" or "block"
    nelder_mead : bool
        Whether Table C.1 is run too: slow.
    seed : int
    """

    bound: float = 0.05
    bounds: list[float] = field(default_factory=lambda: [0.05 + 0.1 * k for k in range(10)])
    least: int = 2
    size: int = 5
    starts: int = 3
    replicates: int = 200
    draw: str = "block"
    nelder_mead: bool = False
    seed: int = 0


@dataclass(frozen=True)
class SubjectSelection:
    """One subject (and visit).

    Attributes
    ----------
    name : str
    nominal : Estimate
        All parameters fitted.
    information : Information
        At the nominal estimate.
    unseen : tuple of NullDirection
    scalings : tuple of tuple of str
        Parameters that may be scaled together unseen.
    sweep : tuple of Selection
    seconds_information : float
        Information and sweep.
    """

    name: str
    nominal: Estimate
    information: Information
    unseen: tuple[NullDirection, ...]
    scalings: tuple[tuple[str, ...], ...]
    sweep: tuple[Selection, ...]
    seconds_information: float


@dataclass(frozen=True)
class StudySelection:
    """The study.

    Attributes
    ----------
    subjects : tuple of SubjectSelection
    worst_case : tuple of Selection
        (5.5): the variance holds for every subject and visit; a sweep.
    intersection : tuple of tuple of int
        Subsets that are among the largest of every subject at the bound (chapter 4).
    chosen : tuple of int
        The subset that is refitted: the best of the worst case at the bound, or at the first bound
        of the sweep that has one; failing that the most frequent of the subjects'.
    refits : mapping
        Subject -> fit of the chosen subset, others at typical values.
    intervals : mapping
        Subject -> bootstrap.
    lasso : mapping
        Subject -> LASSO selection; the group's choice is the most frequent.
    lasso_common : tuple of int
    nelder_mead : mapping
        Subject -> Table C.1, when asked for.
    agreement : mapping
        Rule -> subset, of the first subject.
    collinearity : float
        Of the chosen subset in the first subject.
    bias : tuple of FixedBias
        Of the first subject.
    seconds : mapping
        "fim", "lasso" and "nelder_mead", per subject on average.
    """

    subjects: tuple[SubjectSelection, ...]
    worst_case: tuple[Selection, ...]
    intersection: tuple[tuple[int, ...], ...]
    chosen: tuple[int, ...]
    refits: Mapping[str, Estimate]
    intervals: Mapping[str, BootstrapIntervals]
    lasso: Mapping[str, Lasso]
    lasso_common: tuple[int, ...]
    nelder_mead: Mapping[str, Lasso]
    agreement: Mapping[str, Any]
    collinearity: float
    bias: tuple[FixedBias, ...]
    seconds: Mapping[str, float]


def select_settings(table: Mapping[str, Any]) -> SelectSettings:
    """Read the [select] table.

    Raises
    ------
    InputError
        When a key is unknown or a value of the wrong kind.
    """
    unknown = [key for key in table if key not in SelectSettings.__dataclass_fields__]
    if unknown:
        known = ", ".join(SelectSettings.__dataclass_fields__)
        raise InputError(f"[select] {unknown[0]}", "is not a setting", f"known: {known}")
    try:
        found = msgspec.convert(dict(table), SelectSettings, strict=True)
    except msgspec.ValidationError as error:
        raise InputError("[select]", str(error), "see docs/selection.md") from None
    if found.draw not in _DRAW:
        raise InputError("[select] draw", f"got {found.draw!r}", "give single or block")
    return found


def select_study(
    model: ParametricModel,
    recorded: Mapping[str, Sequence[Trial]],
    settings: SelectSettings,
    progress: Callable[[str], None] = lambda _: None,
) -> StudySelection:
    """Select sensitive parameters.

    Parameters
    ----------
    model : ParametricModel
    recorded : mapping
        Subject (and visit) -> trials.
    settings : SelectSettings
    progress : callable
        Told each step.

    Raises
    ------
    DataError
        When there is no subject.
    """
    if not recorded:
        raise DataError("study", "has no subject", "check where it looks for recordings")
    subjects = []
    for name, trials in recorded.items():
        subjects.append(_subject(model, name, trials, settings))
        progress(f"{name}: nominal fit and information")
    informations = [np.asarray(item.information.F) for item in subjects]
    worst = sweep(informations, settings.bounds, settings.least)
    chosen = _chosen(informations, worst, subjects, settings)
    refits, intervals, lasso, slow = {}, {}, {}, {}
    spent = {"lasso": 0.0, "nelder_mead": 0.0}
    for item in subjects:
        trials = recorded[item.name]
        refits[item.name] = estimate(model, trials, chosen, np.array(model.typical))
        intervals[item.name] = bootstrap_subset(
            model, trials, refits[item.name], settings.replicates, settings.seed,
            _DRAW[settings.draw],
        )  # fmt: skip
        progress(f"{item.name}: bootstrap")
        started = time.perf_counter()
        lasso[item.name] = lasso_of_size(model, trials, settings.size)
        spent["lasso"] += time.perf_counter() - started
        progress(f"{item.name}: LASSO")
        if settings.nelder_mead:
            started = time.perf_counter()
            slow[item.name] = table_c1(model, trials, settings.size)
            spent["nelder_mead"] += time.perf_counter() - started
            progress(f"{item.name}: Table C.1")
    first = subjects[0]
    common = Counter(item.selected for item in lasso.values()).most_common(1)[0][0]
    trials = recorded[first.name]
    return StudySelection(
        tuple(subjects),
        worst,
        _intersection(subjects, settings),
        chosen,
        refits,
        intervals,
        lasso,
        common,
        slow,
        agreement(model, trials, np.array(first.nominal.theta), settings.bound),
        collinearity(first.information, chosen),
        fixed_bias(model, trials, refits[first.name]),
        {
            "fim": float(np.mean([item.seconds_information for item in subjects])),
            **{key: value / len(subjects) for key, value in spent.items() if value},
        },
    )


def _subject(
    model: ParametricModel, name: str, trials: Sequence[Trial], settings: SelectSettings
) -> SubjectSelection:
    nominal = multi_start(model, trials, range(model.size), settings.starts, settings.seed)[0]
    started = time.perf_counter()
    theta: Array = np.array(nominal.theta)
    found = fisher_information(model, theta, trials)
    swept = sweep([found.F], settings.bounds, settings.least)
    seconds = time.perf_counter() - started
    return SubjectSelection(
        name,
        nominal,
        found,
        null_directions(model, found),
        unseen_scalings(model, found),
        swept,
        seconds,
    )


def _chosen(
    informations: list[Array],
    worst: tuple[Selection, ...],
    subjects: list[SubjectSelection],
    settings: SelectSettings,
) -> tuple[int, ...]:
    at_bound = largest_subsets(informations, settings.bound, settings.least)
    for selection in (at_bound, *worst):
        if selection.subsets:
            return selection.subsets[0]
    counted = Counter(
        subset for item in subjects for selection in item.sweep[:1] for subset in selection.subsets
    )
    if not counted:
        raise DataError(
            "selection", "no subset is feasible at any bound", "raise [select] bound or lower least"
        )
    return counted.most_common(1)[0][0]


def _intersection(
    subjects: list[SubjectSelection], settings: SelectSettings
) -> tuple[tuple[int, ...], ...]:
    lists = [
        set(largest_subsets([item.information.F], settings.bound, settings.least).subsets)
        for item in subjects
    ]
    return tuple(sorted(set.intersection(*lists)))
