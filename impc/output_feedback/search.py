"""The largest likelihood, by Fisher's scoring in a box.

    maximise  g's - s'I s / 2    over  |s_i| <= radius

with g the gradient and I the expected information; the radius follows from what the step brings. A
step that is scaled as a whole, instead of a box, is held back by a level that slides to zero: it
crept for hundreds of rounds on the seat (docs/noisy-people.md).
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import lsq_linear

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.output_feedback.prior import Place, Prior

# A search ends when a step promises less, nats: a hundredth of a deviation along any direction
# without a prior, a tenth with it, for the slope that scores do not have is known no better.
_SETTLED, _ENOUGH = 1e-4, 5e-3
# The likelihood jumps where a later stage of a plan meets a bound, a seat's at its limit by half a
# nat in a step of a deviation. A step is judged as of a function known to so much (Sun and Nocedal
# 2023), and a search ends after so many steps that found nothing higher by so much: settled, if
# from the highest place no more than half a nat is promised.
_ROUGH, _PATIENCE, _PROGRESS = 0.5, 4, 0.05
# A round with that slope as found by differences is the last when it wins less.
_WON = 0.25
# Where a loop all but runs away the information of its first state has 35 digits: what of it is not
# rounding is still a matrix of its kind, with so much of each diagonal added.
_ROUNDING = 1e-12
# A place is beside the ridge of all but the levels when a step onto it promises more, nats.
_BESIDE = 0.05
# Step of the differences along a level, of its logarithm; square of one that teaches half.
_DIFFERENCE, _DAMPING = 0.1, 0.1
# Longest and shortest step of any coordinate; those of initial states may be longer by a factor: of
# them a likelihood without bounds is a parabola.
_STEP, _SHORTEST, _AFAR = 1.0, 1e-3, 100.0


def climb(
    prior: Prior,
    begin: Place,
    budget: int,
    along: Array | None = None,
    unseen: Array | None = None,
) -> tuple[Place, Array, int, bool]:
    """The best place near one, its `unseen` slope (q,), likelihoods spent, and whether settled."""
    way = np.eye(len(begin.theta)) if along is None else along
    others = way[:, ~np.any(way[prior.space.own :] != 0, axis=0)]
    reach = _reach(prior, way)
    enough, progress = (_ENOUGH, _PROGRESS) if prior.used else (_SETTLED, _SETTLED)
    here = best = begin
    differences = prior.used and unseen is None
    unseen = np.zeros(len(begin.theta)) if unseen is None else unseen
    # What was won when the slope that scores do not have was asked for last, nats.
    known = -np.inf
    radius, spent, stale, left = _STEP, 1, 0, np.inf
    while True:
        gradient, curvature = prior.parabola(here, unseen)
        down, curvature = way.T @ gradient, way.T @ curvature @ way
        promised = boxed_step(down, curvature, np.inf)[1]
        if here is best:
            left = promised
        if promised < enough or stale == _PATIENCE or radius < _SHORTEST or spent >= budget:
            if best.value <= known + _WON or spent >= budget or not differences:
                return best, unseen, spent, left < _ROUGH
            here, unseen, known = best, unseen_slope(prior, best), best.value
            # One or two likelihoods a level.
            radius, spent, stale = _STEP, spent + len(prior.scales), 0
            continue
        step, within = boxed_step(down, curvature, radius * reach)
        length = float(np.max(np.abs(step) / reach))
        there, spent = prior.tried(here.theta + way @ step), spent + 1
        if there is not None and prior.used and spent < budget:
            there, more = _followed(prior, there, others, unseen)
            spent += more
        # What came true of the promise, both as if they were larger by what is not smooth.
        share = -1.0 if there is None else (there.value - here.value + _ROUGH) / (within + _ROUGH)
        if there is None or share < 0.25:
            radius = length / 4
            continue
        if share > 0.75:
            radius = min(max(radius, 2 * length), _STEP)
        stale = 0 if there.value > best.value + progress else stale + 1
        best = there if there.value > best.value else best
        unseen, here = learned_slope(prior, unseen, here, there), there


def _reach(prior: Prior, way: Array) -> Array:
    """How much longer than others a step along each of some directions (q, r) may be (r,)."""
    mine = way[prior.space.shared : prior.space.after]
    return np.where(np.any(mine != 0, axis=0), _AFAR, 1.0)


def _followed(prior: Prior, here: Place, others: Array, unseen: Array) -> tuple[Place, int]:
    """All but the levels (q, r) where the slope puts it, and likelihoods spent."""
    # The ridge that all else makes bends with the levels, on the seat by many deviations.
    slope, bend = prior.parabola(here, unseen)
    radius = _STEP * _reach(prior, others)
    step, promised = boxed_step(others.T @ slope, others.T @ bend @ others, radius)
    if promised < _BESIDE:
        return here, 0
    there = prior.tried(here.theta + others @ step)
    if there is None or there.value + there.lost < here.value + here.lost:
        return here, 1
    return there, 1


def boxed_step(gradient: Array, curvature: Array, radius: Array | float) -> tuple[Array, float]:
    """The step that promises most, g's - s'C s / 2, and moves no coordinate by more than a radius.

    `gradient` (q,); `curvature` (q, q); `radius` (q,); returns (q,).
    """
    unit = 1 / np.sqrt(np.diag(curvature))
    scaled = unit[:, None] * curvature * unit + _ROUNDING * np.eye(len(unit))
    root = np.linalg.cholesky(scaled)
    goal = solve_triangular(root, unit * gradient, lower=True)
    step = unit * lsq_linear(root.T, goal, (-radius / unit, radius / unit), method="bvls").x
    return step, float(gradient @ step - step @ curvature @ step / 2)


def unseen_slope(prior: Prior, here: Place) -> Array:
    """Slope of what levels lose (q,), nats, which scores do not have: by differences."""
    slope = np.zeros(len(here.theta))
    if prior.used:
        slope[prior.space.own :] = _lost(prior, here)
    return slope


def learned_slope(prior: Prior, slope: Array, here: Place, there: Place) -> Array:
    """That slope (q,) after a step, by Broyden's update, damped: short steps say little.

    `slope` (q,).
    """
    own, slope = prior.space.own, slope.copy()
    moved = (there.theta - here.theta)[own:]
    missed = here.lost - there.lost - float(slope[own:] @ moved)
    slope[own:] += missed * moved / (float(moved @ moved) + _DAMPING)
    # Twice the noise are half the deviations, and no level is more than all of it.
    slope[own:] = np.clip(slope[own:], 0.0, float(own))
    return slope


def _lost(prior: Prior, here: Place) -> Array:
    """What levels lose along each (levels,), all else on its ridge; zero without a likelihood."""
    own, slopes = prior.space.own, np.zeros(len(prior.scales))
    information = here.identified.information + prior.slopes(here.theta)[1]
    ridges = -np.linalg.solve(information[:own, :own], information[:own, own:])
    ways = _DIFFERENCE * np.hstack([ridges.T, np.eye(len(slopes))])
    for (index, way), sign in itertools.product(enumerate(ways), (1, -1)):
        there = prior.tried(here.theta + sign * way) if slopes[index] == 0.0 else None
        if there is not None:
            slopes[index] = sign * (here.lost - there.lost) / _DIFFERENCE
    return slopes
