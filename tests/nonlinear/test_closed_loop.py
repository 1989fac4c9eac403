"""Derivatives of closed loops against differences: the four systems of Safe-PDP, and the seat."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
import pytest

from experiments.peer_systems import SYSTEMS
from impc.arrays import Array
from impc.model.plant import Plant
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights
from impc.nonlinear.closed_loop import ClosedLoop, closed_loop_from
from impc.nonlinear.problem import OptimalControlProblem
from plants import seated_balance_for
from tests.support import extrapolated_slope

STEPS = 5


@dataclass(frozen=True)
class Case:
    """A loop: its problem, parameters (p,), first state (n,) and disturbance (steps, d)."""

    problem: OptimalControlProblem
    theta: Array
    x0: Array
    d: Array

    def change(self, seed: int) -> Array:
        """A random direction of the logarithms and of the first state (p + n,)."""
        direction = np.random.default_rng(seed).normal(size=len(self.theta) + len(self.x0))
        sizes = np.where(self.x0 == 0, 0.01, np.abs(self.x0))
        return np.asarray(direction * np.r_[self.theta, sizes])


def seat_case() -> Case:
    """Tilted by 4 degrees: the torque is at its limit in part of every plan."""
    system = seated_balance_for()
    plant = Plant(system, ["command"])
    v = np.array([0.70, 0.65, 0.22, 0.20])
    truth = {"line": 6e5, "angle1": 2e4, "angle2": 2e4, "limit": 40.0}
    line, *angles, limit = (ca.SX.sym(name) for name in truth)
    x, u, d = ca.SX.sym("x", plant.n), ca.SX.sym("command"), ca.SX.sym("perturbation")
    cost = line * ca.dot(ca.DM(v), x[:4]) ** 2 + ca.dot(ca.vertcat(*angles), x[:2] ** 2)
    Q = np.zeros((plant.n, plant.n))
    Q[:4, :4] = truth["line"] * np.outer(v, v)
    Q[:2, :2] += np.diag([truth["angle1"], truth["angle2"]])
    problem = OptimalControlProblem(
        x,
        u,
        dict(zip(truth, (line, *angles, limit), strict=True)),
        system.body()(x, ca.vertcat(u, d)),
        cost + u**2,
        20,
        terminal_cost=ca.bilin(ca.DM(np.array(solve_lqr(plant, Weights(Q, 1)).P)), x, x),
        constraints={"torque": ca.vertcat(u - limit, -u - limit)},
        disturbances=d,
        dt=plant.dt,
    )
    x0 = np.zeros(plant.n)
    x0[0] = np.radians(4)
    return Case(problem, problem.values(truth), x0, np.full((STEPS, 1), 5.0))


def case_of(name: str) -> Case:
    if name == "seat":
        return seat_case()
    system = SYSTEMS[name]()
    return Case(
        system.problem, system.problem.values(system.truth), system.x0, np.zeros((STEPS, 0))
    )


@pytest.fixture(scope="module", params=[*SYSTEMS, "seat"])
def case(request: pytest.FixtureRequest) -> Case:
    return case_of(request.param)


@pytest.fixture(scope="module")
def loop(case: Case) -> ClosedLoop:
    theta = dict(zip(case.problem.parameter_names, case.theta, strict=True))
    return case.problem.closed_loop(theta, case.x0, STEPS, d=case.d)


def test_a_closed_loop_has_the_derivatives_of_differences(case: Case, loop: ClosedLoop) -> None:
    """Along a random direction of all parameters and the first state, constraints active.

    Largest difference found, over the largest of its signal: 6e-8 (rocket), 9e-11 of the others.
    """
    assert any(plan.active for plan in loop.plans)
    change, p = case.change(4), len(case.theta)

    def moved(t: float) -> Array:
        there = closed_loop_from(
            loop.plans[0], case.theta + t * change[:p], case.x0 + t * change[p:], case.d, 1e-10,
            loop,
        )  # fmt: skip
        assert isinstance(there, ClosedLoop)
        return np.hstack([there.x[1:], there.u])

    expected = extrapolated_slope(moved, 1e-4)
    slope = np.concatenate([loop.dx[1:], loop.du], axis=1) @ change
    for column, exact in zip(slope.T, expected.T, strict=True):
        np.testing.assert_allclose(column, exact, atol=1e-6 * np.max(np.abs(exact)))
