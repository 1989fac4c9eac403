"""Bounded least-squares fit of a model's free parameters to several trials (4.3) to (4.5).

Parameters are normalised; the others are fixed. The search is a bounded trust-region method with
the model's Jacobian, from one or several starts.

Alternatively the other parameters have a prior, the typical value with the SD d between people,
and are fitted too (maximum a posteriori):

    minimise  |e|^2 / s^2 + sum_q ((t_q - typical_q) / d_q)^2
    cov(t) = H^-1 (cov(J'e) / s^4 + P) H^-1,    H = J'J / s^2 + P,    P = diag(1 / d^2)

where s^2 is the mean variance of the residuals e along the columns of J: their variance if they are
white, their long-run variance if they are autocorrelated.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from impc.arrays import Array, Frozen, IntArray, frozen
from impc.assess.covariance import TWO_SIDED
from impc.assess.long_run_covariance import ResidualNoise, spread_of_sum
from impc.assess.variance_accounted_for import vaf as share_explained
from impc.errors import DataError, InputError
from impc.inverse.columns import TrialSpan
from impc.studies.selection.model import ParametricModel, Trial, normalised, physical, stacked

# Fits with the prior, each with the noise of the previous one; it then changes by less than 1 %.
_ROUNDS = 3
# Precision of free parameters in the covariance, which keeps it invertible without any effect.
_FREE = 1e-6


@dataclass(frozen=True)
class Estimate(Frozen):
    """Result of a fit."""

    theta: Array  # All parameters (k,), in their units
    free: tuple[int, ...]  # Indices of the fitted parameters
    misfit: float  # Sum of squares, including the prior
    vaf: Array  # VAF (4.4) over all trials (p,), %


def free_indices(model: ParametricModel, names: Sequence[str]) -> tuple[int, ...]:
    """Indices of parameters by their `names`."""
    for name in names:
        if name not in model.names:
            raise InputError(f"parameter {name}", "unknown name", f"use {', '.join(model.names)}")
    return tuple(model.names.index(name) for name in names)


@dataclass(frozen=True)
class PriorFit(Frozen):
    """Fit of free parameters and of uncertain ones with a prior; 95 % intervals."""

    fit: Estimate  # Free parameters first, then the uncertain ones
    value: Array  # Free parameters (free,), in their units
    low: Array  # 95 % intervals, clipped to the bounds
    high: Array
    variance: Array  # In normalised units (free,)


def estimate(
    model: ParametricModel,
    trials: Sequence[Trial],
    free: Sequence[int],
    start: Array,
    pull: Array | None = None,
) -> Estimate:
    """Fit from `start` (k,); `pull` (free,) weighs distances from the typical values."""
    if not trials:
        raise DataError("trials", "the list is empty", "pass at least one trial")
    chosen: IntArray = np.asarray(free, dtype=np.int64)
    base = normalised(model, np.asarray(start, dtype=np.float64))
    weights = np.zeros(len(chosen)) if pull is None else pull
    residual, derivative = _evaluation(model, trials, base, chosen, weights)
    begin = np.clip(base[chosen], -1 + 1e-9, 1 - 1e-9)
    if not np.all(np.isfinite(residual(begin))):
        raise DataError("model", "outputs are not finite at the start", "pass another start")
    found = scipy.optimize.least_squares(
        residual, begin, jac=derivative, bounds=(-1.0, 1.0), ftol=1e-10, xtol=1e-10, gtol=1e-12,
        max_nfev=200,
    )  # fmt: skip
    full = base.copy()
    full[chosen] = found.x
    theta = physical(model, full)
    vaf, misfit = frozen(pooled_vaf(model, theta, trials)), 2 * float(found.cost)
    return Estimate(frozen(theta), tuple(chosen.tolist()), misfit, vaf)


def multi_start(
    model: ParametricModel, trials: Sequence[Trial], free: Sequence[int], starts: int, seed: int
) -> tuple[Estimate, ...]:
    """Fits from the typical values and random points around them, best first."""
    rng = np.random.default_rng(seed)
    typical = model.usual
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


def estimate_with_prior(
    model: ParametricModel,
    trials: Sequence[Trial],
    free: Sequence[int],
    start: Array,
    noise_of: Callable[[list[Array], TrialSpan], ResidualNoise],
) -> PriorFit:
    """Fit the free parameters, with a prior on the others, from `start` (k,)."""

    def noise_along(at: Array) -> tuple[Array, Array]:
        """R of the QR factorisation J = U R of the Jacobian, and the covariance of U'e."""
        errors, J = stacked(model, at, trials, along)
        U, R = np.linalg.qr(J)
        span = TrialSpan(tuple(np.zeros((part.size, 0)) for part in errors), U)
        parts = np.split(U, np.cumsum([part.size for part in errors])[:-1])
        columns = [part.reshape(*own.shape, -1) for part, own in zip(parts, errors, strict=True)]
        return R, spread_of_sum(noise_of(errors, span), columns)

    stated = np.asarray(model.deviation / model.gain)
    uncertain = [index for index in range(model.size) if index not in free and stated[index] > 0]
    along: IntArray = np.array([*free, *uncertain], dtype=np.int64)
    precision = np.concatenate([np.zeros(len(free)), stated[uncertain] ** -2.0])
    theta = np.asarray(start)
    for _ in range(_ROUNDS):
        _, spread = noise_along(theta)
        pull = np.sqrt(np.trace(spread) / len(along) * precision)
        fit = estimate(model, trials, [*free, *uncertain], theta, pull)
        theta = np.array(fit.theta)
    R, spread = noise_along(theta)
    s2, P = np.trace(spread) / len(along), np.diag(np.maximum(precision, _FREE))
    inverse = np.linalg.inv(R.T @ R / s2 + P)
    covariance = inverse @ (R.T @ spread @ R / s2**2 + P) @ inverse
    variance = np.diag(covariance)[: len(free)]
    value, least, most, gain = (
        np.asarray(item)[along[: len(free)]] for item in (theta, model.low, model.high, model.gain)
    )
    low, high = (
        frozen(np.clip(value + side * gain * np.sqrt(variance), least, most))
        for side in (-TWO_SIDED, TWO_SIDED)
    )
    return PriorFit(fit, frozen(value), low, high, frozen(variance))


def residuals(model: ParametricModel, theta: Array, trials: Sequence[Trial]) -> list[Array]:
    """Recorded minus simulated outputs (samples, p) at theta (k,) for each trial."""
    return [np.asarray(item.outputs - model.simulate(theta, item.input)) for item in trials]


def pooled_vaf(model: ParametricModel, theta: Array, trials: Sequence[Trial]) -> Array:
    """VAF (4.4) over all trials, % (p,), at theta (k,) in its units."""
    recorded = np.concatenate([item.outputs for item in trials])
    simulated = np.concatenate([model.simulate(theta, item.input) for item in trials])
    return np.asarray(share_explained(recorded, simulated))


def _evaluation(
    model: ParametricModel, trials: Sequence[Trial], base: Array, chosen: IntArray, pull: Array
) -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
    """Residual and Jacobian of the chosen parameters; the last point is cached."""
    typical = model.usual[chosen]
    held = pull > 0

    @functools.lru_cache(maxsize=1)
    def evaluated(*t: float) -> tuple[Array, Array]:
        full = base.copy()
        full[chosen] = t
        errors, slopes = stacked(model, physical(model, full), trials, chosen)
        rows = [(pull * (t - typical))[held], *(part.ravel() for part in errors)]
        return np.concatenate(rows), np.vstack([np.diag(pull)[held], slopes])

    return lambda t: evaluated(*t.tolist())[0], lambda t: evaluated(*t.tolist())[1]
