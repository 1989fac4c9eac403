"""Fit the cost weights of a structure, starting near a gain that fits.

    fitted gain  ->  cost weights with the nearest gain, from many starts  ->  searches

The misfit of trajectories has local minima in the cost weights. Near a gain that fits it is almost
the quadratic form |J (K(z) - K)|^2, J the derivative of the residual with respect to the gain after
projection on initial states and parameters. This form is minimised from starts by Bryson's rule
over a range of command weights; the distinct solutions start searches on the recordings.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.optimize

from impc.arrays import Array
from impc.checking import replace
from impc.errors import SolverError, WeightsError
from impc.inverse.coordinates import Coordinates
from impc.inverse.estimates import Estimate, simulated_estimate
from impc.inverse.problem import EXPLAINED, recorded_size, simulated
from impc.inverse.residuals import misfit_or_reason
from impc.inverse.structured_search import StructuredEnd, regulator_slopes, search_from
from impc.model.riccati import solve_lqr

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.inverse.problem import Problem
    from impc.model.structure import Structure

# Natural logarithms of the command weight relative to Bryson's rule: -6 to 6 decades.
_EFFORTS = np.log(10.0) * np.arange(-6, 7, 2)
# Prior SD of a log cost weight about Bryson's (factor 150), if the nearest gain leaves it free.
_SPREAD = 5.0
_ATTEMPTS = 3
# Relative difference of two misfits that count as equal: 1/3 chi-squared unit at 18000 samples.
_AGREE = 1e-5
# A log parameter beyond this has compensated for the free gain; the search restarts at its nominal.
_RUNAWAY = 3.0
# Gains closer than this, in noise SDs of the recordings, count as equal.
_ALIKE = 0.5


def fit_structure(
    problem: Problem, structure: Structure, gain: Array, metric: Array, *starts: Array
) -> StructuredEnd:
    """Fit a structure near a `gain` (m, n), `metric` (m, m), and from `*starts` (count,)."""
    target = _Target(problem, structure, gain, metric)
    ladder = bryson_cost_weights(problem, structure, gain, metric)
    ends = _distinct([target.nearest(cost_weights) for cost_weights in ladder])
    ranked = _ranked(
        problem, structure, [*starts, *(cost_weights for _, cost_weights in ends), *ladder]
    )
    best, spent = None, 0
    for cost_weights in ranked[:_ATTEMPTS]:
        found = search_from(problem, structure, cost_weights)
        spent += found.evaluations
        again = best is not None and abs(found.misfit - best.misfit) < _AGREE * best.misfit
        if best is None or found.misfit < best.misfit:
            best = found
        if again or best.misfit <= EXPLAINED * recorded_size(problem):
            break
    if best is None:
        raise SolverError(
            f"structure {structure.name}",
            "no controller of this structure can be simulated on the recordings",
            "penalise other features",
        )
    return dataclasses.replace(best, evaluations=spent)


def fit_structured(problem: Problem, structure: Structure, near: Estimate) -> Estimate:
    """Fit a structure, starting from an estimate with its initial states and parameters."""
    own = (np.array(getattr(near.problem, name)) for name in ("starts", "logarithms", "shifts"))
    posed = problem.at(*own)
    end = fit_structure(posed, structure, np.array(near.gain), np.array(near.metric))
    given = np.array(problem.logarithms)
    if np.any(np.abs(near.problem.logarithms - given) > _RUNAWAY):
        there = problem.at(np.array(end.problem.starts), given, np.array(end.problem.shifts))
        with contextlib.suppress(WeightsError):  # a zero cost weight may have no Riccati solution
            again = search_from(there, structure, end.cost_weights)
            spent = end.evaluations + again.evaluations
            best = min(end, again, key=lambda one: one.misfit)
            end = dataclasses.replace(best, evaluations=spent)
    return structured_estimate(posed, structure, end)


def feature_sizes(problem: Problem, structure: Structure, gain: Array, metric: Array) -> Array:
    """RMS of each feature (k,), in its unit, under a `gain` (m, n) and `metric` (m, m).

    A feature that never moves gets the least of the others.
    """
    runs = simulated(problem, gain, metric)
    x = np.concatenate([run.x[: run.reached + 1] for run in runs])
    sizes = np.sqrt(np.mean((x @ structure.features.T) ** 2, axis=0))
    return np.asarray(np.maximum(sizes, np.min(sizes[sizes > 0], initial=np.inf)))


def bryson_cost_weights(
    problem: Problem, structure: Structure, gain: Array, metric: Array
) -> list[Array]:
    """Unknowns (count,) at which every feature costs a multiple of the command, at its RMS."""
    sizes = feature_sizes(problem, structure, gain, metric)
    runs = simulated(problem, gain, metric)
    u = np.concatenate([run.u[: max(run.reached, 1)] for run in runs])
    efforts = np.mean((u @ structure.input_features.T) ** 2, axis=0)
    efforts = np.maximum(efforts, np.max(efforts, initial=1e-300) * 1e-12)
    k, first = len(structure.labels), np.zeros(structure.count)
    states = np.log(efforts[0]) - 2 * np.log(sizes)
    first[:k] = states / (2 if structure.coupled else 1)
    inputs = np.flatnonzero(structure.is_cost_weight)[k:]
    first[inputs] = np.log(efforts[0] / efforts[1:]) / (2 if structure.input_coupled else 1)
    step = np.zeros(structure.count)
    step[:k] = 1 / (2 if structure.coupled else 1)
    return [first + effort * step for effort in _EFFORTS]


@dataclass(frozen=True)
class _Nearest:
    distance: float
    gain: Array


class _Target:
    """Quadratic approximation of the misfit as a function of the gain, near a fit."""

    def __init__(self, problem: Problem, structure: Structure, gain: Array, metric: Array) -> None:
        self.problem, self.structure = problem, structure
        self.space = Coordinates(problem, gain, metric)
        start = self.space.start
        seen = self.space.without_nuisance(start)
        samples = problem.recorded_numbers
        self.noise = float(np.linalg.norm(self.space.at(start).residual)) / np.sqrt(samples)
        # Only the gain: the metric has an effect only while bounds are active.
        count = len(self.space.gains)
        here = self.space.natural(self.space.changes(self.space.unpack(start), start)[0][:count])
        self.form = np.linalg.qr(seen[:, :count], mode="r") @ here.reshape(count, -1)
        self.gain = self.space.natural(gain)

    def nearest(self, cost_weights: Array) -> tuple[_Nearest, Array] | None:
        """Weights with the nearest gain, from a start; None if no Riccati solution exists."""
        weight = max(self.noise, 1e-9) / _SPREAD

        @functools.lru_cache(maxsize=1)  # scipy asks for residual and derivative separately
        def regulated(step: tuple[float, ...]) -> tuple[Array, Array]:
            z = cost_weights + np.array(step)
            solution = solve_lqr(self.problem.plant, self.structure.weights(z))
            dK, _ = regulator_slopes(self.problem, self.structure, z, solution)
            far = self.space.natural(np.array(solution.K)) - self.gain
            slopes = self.space.natural(dK[: len(z)]).reshape(len(z), -1)
            return self.form @ far.ravel(), self.form @ slopes.T

        def residual(step: Array) -> Array:
            try:
                return np.concatenate([regulated(tuple(step))[0], weight * step])
            except WeightsError:
                return np.full(len(self.form) + len(step), 1e6 * max(self.noise, 1.0))

        def derivative(step: Array) -> Array:
            return np.vstack([regulated(tuple(step))[1], weight * np.eye(len(step))])

        try:
            found = scipy.optimize.least_squares(
                residual, np.zeros(len(cost_weights)), jac=derivative, ftol=1e-6, max_nfev=40
            )
            far, _ = regulated(tuple(found.x))
        except WeightsError:
            return None
        scale = max(self.noise, 1e-9)
        return _Nearest(float(np.linalg.norm(far)) / scale, far / scale), cost_weights + found.x


def _distinct(
    found: Sequence[tuple[_Nearest, Array] | None],
) -> list[tuple[_Nearest, Array]]:
    """Solutions with different gains, nearest first."""
    kept: list[tuple[_Nearest, Array]] = []
    for item in sorted((one for one in found if one is not None), key=lambda one: one[0].distance):
        if all(np.linalg.norm(item[0].gain - other.gain) > _ALIKE for other, _ in kept):
            kept.append(item)
    return kept


def _ranked(problem: Problem, structure: Structure, starts: Sequence[Array]) -> list[Array]:
    """Starts that can be simulated, least misfit first."""
    usable = []
    for cost_weights in starts:
        try:
            solution = solve_lqr(problem.plant, structure.weights(cost_weights))
        except WeightsError:
            continue
        size, reason = misfit_or_reason(problem, np.array(solution.K), np.array(solution.S))
        if not reason:
            usable.append((size, cost_weights))
    usable.sort(key=lambda item: item[0])
    return [cost_weights for _, cost_weights in usable]


def structured_estimate(problem: Problem, structure: Structure, end: StructuredEnd) -> Estimate:
    """Estimate of the method "structured" from the end of a search."""
    return simulated_estimate(
        "structured",
        replace(end.problem, structure=structure),
        np.array(end.K),
        np.array(end.S),
        weights=structure.weights(np.array(end.cost_weights)),
        noise=max(end.misfit, EXPLAINED * recorded_size(problem)),
        evaluations=end.evaluations,
        settled=end.settled,
        cost_weights=np.array(end.cost_weights),
    )
