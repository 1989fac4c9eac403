"""What is expected of a selection today, beside the dissertation's: other selectors, and doubts.

pivoted QR     parameters in the order in which each adds most to what the others span
SVD and QR     the k parameters that span best the k best seen directions (Burth et al. 1999)
collinearity   gamma = 1 / sqrt(least eigenvalue of S's) of a subset, S its sensitivities scaled
to length one; below 10 to 20 it counts as identifiable (Brun et al. 2001)
bounds, point  selections with every range doubled, and at other points
bias           how far the free parameters move when a fixed one is elsewhere in its range
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg
import scipy.optimize
import scipy.stats

from impc.arrays import Array, Frozen, frozen
from impc.checking import replace
from impc.studies.selection.estimation import estimate, residuals
from impc.studies.selection.fisher import fisher_information
from impc.studies.selection.model import normalised, physical
from impc.studies.selection.subsets import largest_subsets

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.studies.selection.estimation import Estimate
    from impc.studies.selection.fisher import Information
    from impc.studies.selection.model import ParametricModel, Trial
    from impc.studies.selection.subsets import Selection

# Subsets whose collinearity is looked at.
_MOST = 200_000


@dataclass(frozen=True)
class FixedBias(Frozen):
    """Shift of the free parameters (in normalised units) for one fixed parameter moved."""

    name: str  # The fixed parameter
    moved: float  # By how much, in normalised units
    shift: Array  # Of each free parameter (free,), in normalised units


def pivoted_order(found: Information) -> tuple[int, ...]:
    """Parameters by pivoted QR of the sensitivity, most telling first."""
    root = found.singular_values[:, None] * found.directions
    _, order = scipy.linalg.qr(root, mode="r", pivoting=True)
    return tuple(int(index) for index in order)


def subset_by_svd(found: Information, count: int) -> tuple[int, ...]:
    """Subset of `count` parameters by SVD with pivoted QR."""
    _, order = scipy.linalg.qr(np.asarray(found.directions)[:count], mode="r", pivoting=True)
    return tuple(sorted(int(index) for index in order[:count]))


def collinearity(found: Information, subset: Sequence[int]) -> float:
    """Brun's index of a subset; infinite where sensitivities are proportional."""
    F = np.asarray(found.F)[np.ix_(list(subset), list(subset))]
    size = np.sqrt(np.diag(F))
    if np.any(size == 0):
        return float("inf")
    least = float(np.linalg.eigvalsh(F / np.outer(size, size))[0])
    return float(1 / np.sqrt(least)) if least > 1e-15 else float("inf")


def best_collinear(found: Information, count: int) -> tuple[tuple[int, ...], float]:
    """The subset of `count` parameters with the least collinearity, and its index.

    None, and NaN, where there are more than 200 000 of that size: a minute's work.
    """
    if math.comb(len(found.F), count) > _MOST:
        return (), float("nan")
    subsets = itertools.combinations(range(len(found.F)), count)
    index, best = min((collinearity(found, subset), subset) for subset in subsets)
    return best, index


def with_doubled_ranges(model: ParametricModel) -> ParametricModel:
    """The model with every range twice as wide about its middle: variances are a quarter."""
    middle = (model.high + model.low) / 2
    return replace(model, low=frozen(middle - 2 * model.gain), high=frozen(middle + 2 * model.gain))


def agreement(
    model: ParametricModel, trials: Sequence[Trial], theta: Array, bound: float
) -> dict[str, Selection | tuple[int, ...]]:
    """Selections by every rule, and those of the information with other ranges and points.

    `theta` (k,).
    """
    found = fisher_information(model, theta, trials)
    ours = largest_subsets([found.F], bound)
    size = max(ours.size, 2)
    wide = fisher_information(with_doubled_ranges(model), theta, trials, found.variance)
    rng = np.random.default_rng(0)
    t = normalised(model, theta)
    moved = physical(model, np.clip(t + 0.1 * rng.standard_normal(model.size), -1, 1))
    elsewhere = fisher_information(model, moved, trials, found.variance)
    return {
        "information": ours,
        "SVD and pivoted QR": subset_by_svd(found, size),
        "pivoted QR": tuple(sorted(pivoted_order(found)[:size])),
        "least collinearity": best_collinear(found, size)[0],
        "ranges doubled": largest_subsets([wide.F], bound),
        "a tenth of the range away": largest_subsets([elsewhere.F], bound),
    }


def fixed_bias(
    model: ParametricModel, trials: Sequence[Trial], fit: Estimate, moved: float = 0.1
) -> tuple[FixedBias, ...]:
    """Refit with each fixed parameter moved by a share of half its range."""
    base = normalised(model, np.array(fit.theta))
    told = []
    for index in range(model.size):
        if index in fit.free:
            continue
        t = base.copy()
        step = moved if t[index] + moved <= 1 else -moved
        t[index] += step
        again = estimate(model, trials, fit.free, physical(model, t))
        shift = normalised(model, np.array(again.theta))[list(fit.free)] - base[list(fit.free)]
        told.append(FixedBias(model.names[index], step, frozen(shift)))
    return tuple(told)


def profile_interval(
    model: ParametricModel, trials: Sequence[Trial], fit: Estimate, index: int, level: float = 0.95
) -> tuple[float, float]:
    """Profile likelihood of a free parameter: where the misfit grows by chi-squared's quantile.

    The parameter is held, the other free ones are fitted again; residuals are taken as white. An
    end that is not met inside the parameter's range is infinite.
    """
    others = tuple(item for item in fit.free if item != index)
    samples = sum(item.outputs.size for item in trials)
    noise = fit.misfit / (samples - len(fit.free))
    quantile = float(scipy.stats.chi2.ppf(level, 1))
    base = normalised(model, np.array(fit.theta))

    def excess(t: float) -> float:
        moved = base.copy()
        moved[index] = t
        held = physical(model, moved)
        misfit = (
            estimate(model, trials, others, held).misfit if others else _misfit(model, trials, held)
        )
        return (misfit - fit.misfit) / noise - quantile

    ends = []
    for edge in (-1.0, 1.0):
        if excess(edge) <= 0:
            ends.append(edge * np.inf)
            continue
        t = float(scipy.optimize.brentq(excess, base[index], edge, xtol=1e-4))
        moved = base.copy()
        moved[index] = t
        ends.append(float(physical(model, moved)[index]))
    return ends[0], ends[1]


def _misfit(model: ParametricModel, trials: Sequence[Trial], theta: Array) -> float:
    return sum(float(np.sum(part**2)) for part in residuals(model, theta, trials))
