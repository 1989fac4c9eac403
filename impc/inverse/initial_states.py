"""The states in which trials start, when the controller is known (docs/fitting.md)."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import numpy as np
import scipy.optimize

from impc.arrays import Array, frozen
from impc.checking import replace
from impc.inverse.coordinates import start_unit
from impc.inverse.residuals import start_residual

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.inverse.problem import Problem

_EVALUATIONS = 20
# The first round also counts as noise what saturation keeps from being linear; a second, which does
# not, is worth its simulations where that was more than a share of it.
_ROUNDS, _SHARE = 2, 1e-4


def with_fitted_starts(
    problem: Problem, gain: Array, metric: Array, samples: int | None = None
) -> Problem:
    """Return the problem with each trial's x0 fitted to its first samples under a controller.

    From the given x0, by trust-region least squares. Where the samples leave x0 free it stays: it
    is given a normal prior of the size of the trial's other states (`start_unit`), which weighs as
    the residual's own noise does.

    `gain` (m, n); `metric` (m, m).
    """
    fitted = []
    for trial in problem.recordings:
        seen = trial.samples if samples is None else min(samples, trial.samples)
        short = replace(trial, outputs=trial.outputs[:seen], disturbance=trial.disturbance[:seen])
        one = replace(problem, recordings=(short,), unknown_start=True)
        fitted.append(replace(trial, x0=frozen(_fit(one, gain, metric))))
    return replace(problem, recordings=tuple(fitted))


def _fit(problem: Problem, gain: Array, metric: Array) -> Array:
    unit = start_unit(problem, gain)
    (trial,) = problem.recordings
    simulated = start_residual(problem, gain, metric)

    @functools.lru_cache(maxsize=1)  # the search asks for residual and derivative one by one
    def seen(z: tuple[float, ...]) -> tuple[Array, Array]:
        residual, slope = simulated(trial.x0 + unit @ np.array(z))
        return residual, slope @ unit

    def at(z: Array) -> tuple[Array, Array]:
        return seen(tuple(z))

    z: Array = np.zeros(problem.plant.n)
    before = np.inf
    for _ in range(_ROUNDS):
        noise = _noise(*at(z))
        if abs(noise - before) <= _SHARE * noise:
            break
        z, before = _round(at, z, noise), noise
    return np.asarray(trial.x0 + unit @ z)


def _noise(residual: Array, derivative: Array) -> float:
    """What no x0 explains: to first order, the residual beside the derivative's columns."""
    left = residual - derivative @ np.linalg.lstsq(derivative, residual)[0]
    return float(np.linalg.norm(left) / np.sqrt(len(left)))


def _round(at: Callable[[Array], tuple[Array, Array]], z: Array, noise: float) -> Array:
    """One fit from z, with that noise."""

    def residual(z: Array) -> Array:
        return np.concatenate([at(z)[0], noise * z])

    def derivative(z: Array) -> Array:
        return np.vstack([at(z)[1], noise * np.eye(len(z))])

    found = scipy.optimize.least_squares(
        residual,
        z,
        jac=derivative,
        ftol=1e-10,
        xtol=1e-12,
        gtol=1e-15,
        max_nfev=_EVALUATIONS,
    )
    return np.asarray(found.x)
