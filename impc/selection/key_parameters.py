"""Key parameters (chapter 5): sensitive, explaining, reliable and of several pathways.

Four filters, one after the other, on the subsets that the information allows for every subject and
visit together (5.5):

    variability        max over subjects and visits of max diag F_s^-1 <= v
    goodness of fit    mean VAF of the refitted subset above a threshold
    reliability        min over the subset of ICC(A,k) between visits, at least rho (5.6), (5.7)
    diversity          number of distinct pathways in the subset; the largest is chosen
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.reliability.icc import icc
from impc.selection.estimation import estimate
from impc.selection.fisher import fisher_information
from impc.selection.subsets import largest_subsets

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from impc.arrays import Array
    from impc.selection.model import ParametricModel, Trial
    from impc.selection.subsets import Selection

__all__ = ["Candidate", "KeyParameters", "key_parameters"]


@dataclass(frozen=True)
class Candidate:
    """A sensitive subset and how it does in the other filters.

    Attributes
    ----------
    subset : tuple of int
    variance : float
        Largest, over subjects and visits, in normalised units.
    vaf : float
        Mean over subjects and visits, %.
    reliability : float
        Least ICC(A,k) of its parameters; NaN where none is defined.
    diversity : int
        Number of pathways.
    kept : bool
        Whether it passes goodness of fit and reliability.
    """

    subset: tuple[int, ...]
    variance: float
    vaf: float
    reliability: float
    diversity: int
    kept: bool


@dataclass(frozen=True)
class KeyParameters:
    """Outcome of the filters.

    Attributes
    ----------
    selection : Selection
        Subsets of the first filter.
    candidates : tuple of Candidate
        All of them, best first: kept before not, then diversity, then reliability.
    chosen : tuple of int
        The first kept one; empty when none is kept.
    """

    selection: Selection
    candidates: tuple[Candidate, ...]
    chosen: tuple[int, ...]


def key_parameters(
    model: ParametricModel,
    recorded: Mapping[tuple[str, str], Sequence[Trial]],
    nominal: Mapping[tuple[str, str], Array],
    *,
    bound: float = 0.35,
    least_vaf: float = 69.0,
    least_reliability: float = 0.75,
    most: int = 20,
    progress: Callable[[str], None] = lambda _: None,
) -> KeyParameters:
    """Choose key parameters of a study of several subjects and visits.

    Parameters
    ----------
    model : ParametricModel
        Its typical values are where fixed parameters stay.
    recorded : mapping
        (subject, visit) -> trials.
    nominal : mapping
        (subject, visit) -> all parameters (k,) at which the information is taken.
    bound, least_vaf, least_reliability
        v, VAF in %, rho: chapter 5 has .35, 69 % and .75.
    most : int
        How many subsets of the first filter go on, those of least variance.
    progress : callable
        Told each subset's names when it is done.
    """
    informations = [
        np.asarray(fisher_information(model, np.asarray(nominal[key]), trials).F)
        for key, trials in recorded.items()
    ]
    selection = largest_subsets(informations, bound)
    candidates = []
    pairs = list(zip(selection.subsets, selection.variances, strict=True))[:most]
    for subset, variance in pairs:
        vaf, reliability = _refitted(model, recorded, subset)
        diversity = len({model.pathways[index] for index in subset})
        kept = vaf > least_vaf and reliability >= least_reliability
        candidates.append(Candidate(subset, variance, vaf, reliability, diversity, kept))
        progress(", ".join(model.names[index] for index in subset))
    candidates.sort(
        key=lambda item: (not item.kept, -item.diversity, -np.nan_to_num(item.reliability))
    )
    chosen = candidates[0].subset if candidates and candidates[0].kept else ()
    return KeyParameters(selection, tuple(candidates), chosen)


def _refitted(
    model: ParametricModel,
    recorded: Mapping[tuple[str, str], Sequence[Trial]],
    subset: tuple[int, ...],
) -> tuple[float, float]:
    """Mean VAF, and the least ICC between visits of the subset's estimates."""
    subjects = list(dict.fromkeys(key[0] for key in recorded))
    visits = list(dict.fromkeys(key[1] for key in recorded))
    values = np.full((len(subset), len(subjects), len(visits)), np.nan)
    shares = []
    for (subject, visit), trials in recorded.items():
        found = estimate(model, trials, subset, np.array(model.typical))
        shares.append(float(np.mean(found.vaf)))
        place = subjects.index(subject), visits.index(visit)
        values[:, place[0], place[1]] = np.array(found.theta)[list(subset)]
    if len(visits) < 2 or len(subjects) < 2:
        return float(np.mean(shares)), float("nan")
    correlations = [icc(table, "A,k").value for table in values]
    return float(np.mean(shares)), float(np.min(correlations))
