"""Least squares of a model's free parameters over several trials, within bounds (4.3) to (4.5).

Parameters are normalised; those that are not free stay where they are given. Search by a bounded
trust region with the model's Jacobian, from one start or several.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.optimize

from impc.arrays import Array, Frozen, IntArray, frozen
from impc.assess.variance_accounted_for import vaf as share_explained
from impc.errors import DataError, InputError
from impc.studies.selection.model import normalised, physical, sensitivity

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from impc.studies.selection.model import ParametricModel, Trial


@dataclass(frozen=True)
class Estimate(Frozen):
    """A fit."""

    theta: Array  # All parameters (k,), in their units
    free: tuple[int, ...]  # Which of them were fitted
    misfit: float  # Sum of squares
    vaf: Array  # (4.4) over all trials (p,), %
    evaluations: int  # Of the residual
    at_bound: tuple[int, ...]  # Free parameters that end on a bound


def free_indices(model: ParametricModel, names: Sequence[str]) -> tuple[int, ...]:
    """Indices of parameters by their `names`."""
    for name in names:
        if name not in model.names:
            raise InputError(f"parameter {name}", "is not one", f"known: {', '.join(model.names)}")
    return tuple(model.names.index(name) for name in names)


def estimate(
    model: ParametricModel, trials: Sequence[Trial], free: Sequence[int], start: Array
) -> Estimate:
    """Fit the free parameters to all trials at once; `start` (k,)."""
    if not trials:
        raise DataError("trials", "there are none", "give at least one")
    chosen: IntArray = np.asarray(free, dtype=np.int64)
    base = normalised(model, np.asarray(start, dtype=np.float64))
    residual, derivative = _evaluation(model, trials, base, chosen)
    begin = np.clip(base[chosen], -1 + 1e-9, 1 - 1e-9)
    if not np.all(np.isfinite(residual(begin))):
        raise DataError("model", "is not finite at the start", "start elsewhere")
    found = scipy.optimize.least_squares(
        residual, begin, jac=derivative, bounds=(-1.0, 1.0), ftol=1e-10, xtol=1e-10, gtol=1e-12,
        max_nfev=200,
    )  # fmt: skip
    full = base.copy()
    full[chosen] = found.x
    theta = physical(model, full)
    stuck = tuple(chosen[np.abs(found.x) > 1 - 1e-6].tolist())
    vaf, misfit = frozen(pooled_vaf(model, theta, trials)), 2 * float(found.cost)
    return Estimate(frozen(theta), tuple(chosen.tolist()), misfit, vaf, int(found.nfev), stuck)


def multi_start(
    model: ParametricModel, trials: Sequence[Trial], free: Sequence[int], starts: int, seed: int
) -> tuple[Estimate, ...]:
    """Fits from the typical values and points about them at which it is finite, best first."""
    rng = np.random.default_rng(seed)
    typical = normalised(model, np.asarray(model.typical))
    found: list[Estimate] = []
    begin = typical
    while len(found) < starts:
        try:
            found.append(estimate(model, trials, free, physical(model, begin)))
        except DataError:
            if not found:
                raise
        moved = typical.copy()
        chosen = np.asarray(free, dtype=int)
        moved[chosen] += 0.5 * rng.standard_normal(len(chosen))
        begin = np.clip(moved, -0.98, 0.98)
    return tuple(sorted(found, key=lambda item: item.misfit))


def residuals(model: ParametricModel, theta: Array, trials: Sequence[Trial]) -> list[Array]:
    """Outputs recorded minus simulated at theta (k,): (samples, p) for each trial."""
    return [np.asarray(item.outputs - model.simulate(theta, item.input)) for item in trials]


def pooled_vaf(model: ParametricModel, theta: Array, trials: Sequence[Trial]) -> Array:
    """VAF (4.4) over all trials, % (p,), at theta (k,) in its units."""
    recorded = np.concatenate([item.outputs for item in trials])
    simulated = np.concatenate([model.simulate(theta, item.input) for item in trials])
    return np.asarray(share_explained(recorded, simulated))


def _evaluation(
    model: ParametricModel, trials: Sequence[Trial], base: Array, chosen: IntArray
) -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
    """Residual and Jacobian of the chosen parameters; the last point is not computed twice."""
    last: tuple[bytes, Array, Array] | None = None

    def evaluated(t: Array) -> tuple[Array, Array]:
        nonlocal last
        if last is None or last[0] != t.tobytes():
            full = base.copy()
            full[chosen] = t
            theta, residuals, slopes = physical(model, full), [], []
            for trial in trials:
                outputs, derivative = sensitivity(model, theta, trial.input, chosen)
                residuals.append((outputs - trial.outputs).ravel())
                slopes.append(derivative.reshape(-1, len(chosen)))
            last = (t.tobytes(), np.concatenate(residuals), np.concatenate(slopes))
        return last[1], last[2]

    return lambda t: evaluated(t)[0], lambda t: evaluated(t)[1]
