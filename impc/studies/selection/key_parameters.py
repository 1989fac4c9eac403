"""Key parameters (chapter 5): sensitive, well fitting, reliable, of several pathways.

Four consecutive filters (5.5):

    variability        max over subjects and visits of max diag F_s^-1 <= v
    goodness of fit    mean VAF of the refitted subset above a threshold
    reliability        min over the subset of ICC(A,k) between visits (5.6), (5.7); here the lower
                       end of its 95 % interval >= rho, because an ICC of few people varies much
    diversity          number of distinct pathways in the subset; the largest is selected
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.errors import DataError
from impc.studies.reliability.icc import GOOD, icc
from impc.studies.selection.analysis import Nominal, fit_nominal
from impc.studies.selection.estimation import Estimate, estimate
from impc.studies.selection.fisher import largest_subsets, sweep

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from impc.studies.selection.fisher import Selection
    from impc.studies.selection.model import ParametricModel, Trial
    from impc.studies.selection.model_source import Runner
    from impc.studies.selection.settings import SelectSettings


@dataclass(frozen=True)
class Candidate:
    """A sensitive subset and its results in the other filters."""

    subset: tuple[int, ...]  # Indices of its parameters
    variance: float  # Largest variance over subjects and visits, in normalised units
    vaf: float  # Mean VAF over subjects and visits, %
    reliability: float  # Smallest ICC(A,k) of its parameters; NaN if undefined
    certain: float  # Smallest lower end of their 95 % intervals; NaN if undefined
    diversity: int  # Number of pathways
    explained: bool  # Whether it passes goodness of fit
    kept: bool  # Whether it passes goodness of fit and reliability


@dataclass(frozen=True)
class KeyParameters(Frozen):
    """Outcome of the filters."""

    selection: Selection  # Subsets of the first filter
    sweep: tuple[Selection, ...]  # The first filter at other bounds
    # Best first: kept ones, then by diversity, then by reliability
    candidates: tuple[Candidate, ...]
    chosen: tuple[int, ...]  # First kept subset; empty if none is kept
    # Estimates with all parameters free (parameters, subjects, visits), in physical units
    nominal: Array
    # Estimates of the chosen subset (chosen, subjects, visits), in physical units
    estimates: Array


def refit_subsets(
    model: ParametricModel, trials: Sequence[Trial], subsets: tuple[tuple[int, ...], ...]
) -> tuple[Estimate, ...]:
    """Fit each of the `subsets`, the other parameters fixed at their typical values."""
    typical = np.array(model.typical)
    return tuple(estimate(model, trials, subset, typical) for subset in subsets)


def key_parameters(
    model: ParametricModel,
    recorded: Mapping[tuple[str, str], Sequence[Trial]],
    settings: SelectSettings,
    run: Runner,
    *,
    bound: float = 0.35,
    least_vaf: float = 69.0,
    least_reliability: float = GOOD,
    most: int = 20,
) -> KeyParameters:
    """Select key parameters of a study; `recorded` by (subject, visit)."""
    subjects, visits = (tuple(dict.fromkeys(one)) for one in zip(*recorded, strict=True))
    whole = sum(all((one, visit) in recorded for visit in visits) for one in subjects)
    if min(whole, len(visits)) < 2:
        found = f"has {whole} subjects with all visits, and {len(visits)} visits"
        raise DataError("study", found, "record at least 2 of each")
    trials = {" visit ".join(filter(None, key)): tuple(item) for key, item in recorded.items()}
    nominal = run(fit_nominal, Nominal, {name: (trials[name], settings) for name in trials})
    informations = [np.asarray(item.information.F) for item in nominal.values()]
    selection = largest_subsets(informations, bound, settings.least)
    subsets = selection.subsets[:most]
    refits = run(
        refit_subsets, tuple[Estimate, ...], {name: (trials[name], subsets) for name in trials}
    )
    candidates = []
    for place, subset in enumerate(subsets):
        fits = [item[place] for item in refits.values()]
        vaf = float(np.mean([np.mean(item.vaf) for item in fits]))
        # (5.6): minimum over the subset of the ICC, and of the lower end of its interval.
        tables = _by_visit(recorded, fits, subset)
        iccs = [icc(table, "A,k", "generalised")[:2] for table in tables]
        reliability, certain = np.min(iccs, axis=0).tolist()
        diversity, explained = len({model.pathways[index] for index in subset}), vaf > least_vaf
        candidates.append(Candidate(
            subset, selection.variances[place], vaf, reliability, certain, diversity, explained,
            explained and certain >= least_reliability,
        ))  # fmt: skip
    candidates.sort(
        key=lambda item: (not item.kept, -item.diversity, -np.nan_to_num(item.reliability))
    )
    chosen = candidates[0].subset if candidates and candidates[0].kept else ()
    alone = [item[subsets.index(chosen)] for item in refits.values()] if chosen else []
    return KeyParameters(
        selection,
        sweep(informations, settings.bounds, settings.least),
        tuple(candidates),
        chosen,
        _by_visit(recorded, [item.fit for item in nominal.values()], range(model.size)),
        _by_visit(recorded, alone, chosen),
    )


def _by_visit(
    keys: Iterable[tuple[str, str]], fits: Sequence[Estimate], subset: Sequence[int]
) -> Array:
    """Estimates of a subset (len(subset), subjects, visits); NaN if a visit is missing."""
    subjects, visits = (list(dict.fromkeys(one)) for one in zip(*keys, strict=True))
    values = np.full((len(subset), len(subjects), len(visits)), np.nan)
    for (subject, visit), found in zip(keys, fits, strict=bool(subset)):
        place = subjects.index(subject), visits.index(visit)
        values[:, *place] = np.array(found.theta)[list(subset)]
    return frozen(values)
