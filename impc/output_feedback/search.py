"""Maximise the fit objective: the minimiser of inverse MPC, with Fisher information as curvature.

The REML term has no exact gradient: the search learns it along the noise SDs by Broyden's update,
and computes it by differences where it ends.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from impc.arrays import Array
from impc.inverse.minimiser import Prior, Rows, Stop, minimise

if TYPE_CHECKING:
    from impc.output_feedback.unknowns import Iterate, NoisyUnknowns

# Promised decrease of -2 log posterior below which a search has converged: a hundredth of a
# standard error in any direction without prior, a tenth with it, as the gradient of the REML term
# is inexact.
_SETTLED, _ENOUGH = 2e-4, 1e-2
#: The likelihood jumps where a later stage of a plan reaches a bound, for a seat at its limit by
#: 0.5 nat within one standard error: a search that is stuck has converged below this promise.
ROUGH = 1.0
# A further round with the REML gradient by differences is skipped if the last gained less.
_WON = 0.25
# Close to instability the information of the first state spans 35 digits: adding this share of each
# diagonal keeps the matrix positive definite.
_ROUNDING = 1e-12
# Difference step of a log noise SD; squared step at which Broyden's update is halved.
_DIFFERENCE, _DAMPING = 0.1, 0.1


def maximise(
    space: NoisyUnknowns,
    begin: Iterate,
    budget: int,
    along: Array | None = None,
    unseen: Array | None = None,
    promise: float | None = None,
) -> tuple[Iterate, Array, int, bool]:
    """Best iterate, its REML gradient `unseen` (q,), evaluations used, and whether converged.

    `along` (q, r): directions of the search, by default all; with `unseen` (q,) given, the REML
    gradient is never computed by differences.
    """
    way = np.eye(len(begin.theta)) if along is None else along
    promise = promise or (_ENOUGH if space.used else _SETTLED)
    differences, evaluated = space.used and unseen is None, len(space.scales)
    here, spent, u, v = begin, 1, np.zeros(way.shape[1]), np.zeros((1, 0))
    unseen = np.zeros(len(way)) if unseen is None else unseen
    while True:
        if differences and spent + evaluated < budget:
            unseen, spent = reml_slope(space, here), spent + evaluated
        model, known = Objective(space, here, way, unseen), here.value
        stop = Stop(promise, 0.0, budget - spent + 1, costly=True)
        end = minimise(model, Prior(u, v, u, 0.0), (u, v), stop)
        here, unseen, spent = model.found(end.u), model.unseen, spent + model.spent
        if not differences or here.value <= known + _WON or spent >= budget:
            return here, unseen, spent, end.converged or end.promised < ROUGH


class Objective:
    """-2 log posterior along directions `way` (q, r) from a point, for the minimiser."""

    def __init__(self, space: NoisyUnknowns, begin: Iterate, way: Array, unseen: Array) -> None:
        self.space, self.begin, self.way, self.unseen = space, begin, way, unseen
        #: Iterate of the last rows, and the one evaluated last; evaluations.
        self.here, self.last, self.spent = begin, begin, 0

    def found(self, u: Array) -> Iterate:
        """Iterate at `u` (r,), evaluated before."""
        theta = self.begin.theta + self.way @ u
        return next(one for one in (self.last, self.here) if np.array_equal(one.theta, theta))

    def rows(self, u: Array, v: Array) -> Rows | None:
        """Factor F of the curvature, F'F, and the residual r of the gradient, F'r."""
        if not np.isfinite(self.value(u, v)):
            return None
        here = self.found(u)
        self.unseen = updated_slope(self.space, self.unseen, self.here, here)
        self.here = here
        gradient, curvature = self.space.parabola(here, self.unseen)
        gradient, curvature = self.way.T @ gradient, self.way.T @ curvature @ self.way
        unit = np.sqrt(np.diag(curvature))
        scaled = curvature / np.outer(unit, unit) + _ROUNDING * np.eye(len(unit))
        root = np.linalg.cholesky(scaled)
        residual = -scipy.linalg.solve_triangular(root, gradient / unit, lower=True)
        none = np.zeros((1, len(unit), 0))
        return Rows(residual[None], (root.T * unit)[None], none, -2 * here.value, 1.0)

    def value(self, u: Array, _v: Array) -> float:
        """-2 log posterior; infinite where it is undefined."""
        theta = self.begin.theta + self.way @ u
        if not any(np.array_equal(one.theta, theta) for one in (self.last, self.here)):
            self.spent += 1
            there = self.space.tried(theta)
            if there is None:
                return np.inf
            self.last = there
        return -2 * self.found(u).value

    def bend(self, _du: Array, _dv: Array, _share: float) -> None:
        """No geodesic acceleration: it needs a second derivative of the residual."""


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
