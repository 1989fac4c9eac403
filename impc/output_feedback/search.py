"""Maximise the fit objective by Fisher scoring with box-shaped trust regions.

    maximise  g's - s'I s / 2    over  |s_i| <= radius

with the gradient g and the expected information I; the radius follows from the actual increase. A
step scaled as a whole is held back by a noise SD that tends to zero: on the seat it needed hundreds
of iterations.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg
from scipy.optimize import lsq_linear

from impc.arrays import Array

if TYPE_CHECKING:
    from impc.output_feedback.unknowns import Iterate, NoisyUnknowns

# Predicted increase in nats below which a search has converged: a hundredth of a standard error in
# any direction without prior, a tenth with it, as the gradient of the REML term is inexact.
_SETTLED, _ENOUGH = 1e-4, 5e-3
# The likelihood jumps where a later stage of a plan reaches a bound: for a seat at its limit by 0.5
# nat within one standard error. Steps are accepted as for a function with that error (Sun and
# Nocedal 2023), and a search stops after so many steps without an increase by so much: converged
# if the predicted increase at the best point is below 0.5 nat.
_ROUGH, _PATIENCE, _PROGRESS = 0.5, 4, 0.05
# A further round with the REML gradient by differences is skipped if the last gained less.
_WON = 0.25
# Close to instability the information of the first state spans 35 digits: adding this share of each
# diagonal keeps the matrix positive definite.
_ROUNDING = 1e-12
# Follow the ridge of coordinates that are no noise SDs above this predicted increase, nats.
_BESIDE = 0.05
# Difference step of a log noise SD; squared step at which Broyden's update is halved.
_DIFFERENCE, _DAMPING = 0.1, 0.1
# Largest and smallest step of any coordinate; factor for initial states, in which the likelihood
# without bounds is quadratic.
_STEP, _SHORTEST, _AFAR = 1.0, 1e-3, 100.0


def maximise(
    space: NoisyUnknowns,
    begin: Iterate,
    budget: int,
    along: Array | None = None,
    unseen: Array | None = None,
) -> tuple[Iterate, Array, int, bool]:
    """Best iterate, its REML gradient `unseen` (q,), evaluations used, and whether converged.

    `along` (q, r): directions of the search, by default all; with `unseen` (q,) given, the REML
    gradient is never computed by differences.
    """
    way = np.eye(len(begin.theta)) if along is None else along
    others = way[:, ~np.any(way[space.own :] != 0, axis=0)]
    reach = _reach(space, way)
    enough, progress = (_ENOUGH, _PROGRESS) if space.used else (_SETTLED, _SETTLED)
    here = best = begin
    differences = space.used and unseen is None
    unseen = np.zeros(len(begin.theta)) if unseen is None else unseen
    # Objective at the last evaluation of the REML gradient by differences, nats.
    known = -np.inf
    radius, spent, stale, left = _STEP, 1, 0, np.inf
    while True:
        gradient, curvature = space.parabola(here, unseen)
        down, curvature = way.T @ gradient, way.T @ curvature @ way
        predicted = boxed_step(down, curvature, np.inf)[1]
        if here is best:
            left = predicted
        if predicted < enough or stale == _PATIENCE or radius < _SHORTEST or spent >= budget:
            if best.value <= known + _WON or spent >= budget or not differences:
                return best, unseen, spent, left < _ROUGH
            here, unseen, known = best, reml_slope(space, best), best.value
            # One or two evaluations per noise SD.
            radius, spent, stale = _STEP, spent + len(space.scales), 0
            continue
        step, within = boxed_step(down, curvature, radius * reach)
        length = float(np.max(np.abs(step) / reach))
        there, spent = space.tried(here.theta + way @ step), spent + 1
        if there is not None and space.used and spent < budget:
            there, more = _followed(space, there, others, unseen)
            spent += more
        # Ratio of actual to predicted increase, both enlarged by the size of the jumps.
        share = -1.0 if there is None else (there.value - here.value + _ROUGH) / (within + _ROUGH)
        if there is None or share < 0.25:
            radius = length / 4
            continue
        if share > 0.75:
            radius = min(max(radius, 2 * length), _STEP)
        stale = 0 if there.value > best.value + progress else stale + 1
        best = there if there.value > best.value else best
        unseen, here = updated_slope(space, unseen, here, there), there


def _reach(space: NoisyUnknowns, way: Array) -> Array:
    """Factor (r,) for the largest step along each of some directions (q, r)."""
    return np.where(np.any(way[space.shared : space.after] != 0, axis=0), _AFAR, 1.0)


def _followed(
    space: NoisyUnknowns, here: Iterate, others: Array, unseen: Array
) -> tuple[Iterate, int]:
    """Step onto the ridge of the coordinates `others` (q, r), not noise SDs; evaluations used."""
    # The ridge bends with the noise SDs, on the seat by many standard errors.
    slope, bend = space.parabola(here, unseen)
    radius = _STEP * _reach(space, others)
    step, predicted = boxed_step(others.T @ slope, others.T @ bend @ others, radius)
    if predicted < _BESIDE:
        return here, 0
    there = space.tried(here.theta + others @ step)
    if there is None or there.value + there.lost < here.value + here.lost:
        return here, 1
    return there, 1


def boxed_step(gradient: Array, curvature: Array, radius: Array | float) -> tuple[Array, float]:
    """Step with the largest predicted increase g's - s'C s / 2 in the box |s_i| <= radius.

    `gradient` (q,); `curvature` (q, q); `radius` (q,); returns (q,).
    """
    unit = 1 / np.sqrt(np.diag(curvature))
    scaled = unit[:, None] * curvature * unit + _ROUNDING * np.eye(len(unit))
    root = np.linalg.cholesky(scaled)
    goal = scipy.linalg.solve_triangular(root, unit * gradient, lower=True)
    step = unit * lsq_linear(root.T, goal, (-radius / unit, radius / unit), method="bvls").x
    return step, float(gradient @ step - step @ curvature @ step / 2)


def reml_slope(space: NoisyUnknowns, here: Iterate) -> Array:
    """Gradient of the REML term (q,) in nats, by differences.

    Along each noise SD all else moves on its ridge; zero where the objective is undefined.
    """
    own, slope = space.own, np.zeros(len(here.theta))
    if not space.used:
        return slope
    information = here.identified.information + space.slopes(here.theta)[1]
    ridges = -np.linalg.solve(information[:own, :own], information[:own, own:])
    ways = _DIFFERENCE * np.hstack([ridges.T, np.eye(len(slope) - own)])
    for (index, way), sign in itertools.product(enumerate(ways, own), (1, -1)):
        there = space.tried(here.theta + sign * way) if slope[index] == 0.0 else None
        if there is not None:
            slope[index] = sign * (here.lost - there.lost) / _DIFFERENCE
    return slope


def updated_slope(space: NoisyUnknowns, slope: Array, here: Iterate, there: Iterate) -> Array:
    """REML gradient (q,) after a step, by Broyden's update, damped for short steps.

    `slope` (q,).
    """
    own, slope = space.own, slope.copy()
    moved = (there.theta - here.theta)[own:]
    missed = here.lost - there.lost - float(slope[own:] @ moved)
    slope[own:] += missed * moved / (float(moved @ moved) + _DAMPING)
    # Doubling the noise halves the standard errors, and a noise SD is at most all of the noise.
    slope[own:] = np.clip(slope[own:], 0.0, float(own))
    return slope
