"""Plans against independent solutions, and their derivatives against differences."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import casadi as ca
import numpy as np
import pytest

from experiments.peer_systems import SYSTEMS, PeerSystem
from impc.arrays import Array
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.simulation import Status, scenario
from impc.model.bounds import Bounds
from impc.model.weights import Weights
from impc.nonlinear.closed_loop import closed_loop_from
from impc.nonlinear.plan import SOLVERS, Plan, nearby_plan
from impc.nonlinear.problem import OptimalControlProblem
from tests.nonlinear.linear_twin import linear_twin
from tests.support import extrapolated_slope, random_plant, random_weights


@pytest.mark.parametrize("limit", [0.3, 50.0], ids=["saturated", "not saturated"])
@pytest.mark.parametrize("solver", SOLVERS)
def test_a_linear_plant_has_the_loop_of_the_linear_route(limit: float, solver: str) -> None:
    rng = np.random.default_rng(7)
    plant = random_plant(rng, 3, 2, 1.05)
    weights = Weights(random_weights(rng, 3), random_weights(rng, 2))
    controller = Controller(plant, weights, Bounds(plant, u_min=-limit, u_max=limit), 6,
                            terminal_set=False)  # fmt: skip
    expected = simulate(controller, scenario(plant, [0.8, -0.5, 0.4], 15))
    assert bool(np.any(expected.status == Status.ACTIVE)) == (limit < 1)
    problem, theta = linear_twin(controller, weights)
    found = problem.closed_loop(theta, [0.8, -0.5, 0.4], 15, solver=solver)
    # 3e-10 at mu = 1e-10: the distance from a bound is mu over its multiplier.
    np.testing.assert_allclose(found.x, expected.x, atol=1e-8)
    np.testing.assert_allclose(found.u, expected.u, atol=1e-8)


@pytest.fixture(scope="module", params=list(SYSTEMS))
def system(request: pytest.FixtureRequest) -> PeerSystem:
    return SYSTEMS[request.param]()


@pytest.fixture(scope="module")
def plan(system: PeerSystem) -> Plan:
    return system.problem.plan(system.truth, system.x0)


#: Constraint -> samples at which it is active in the demonstration, as in Safe-PDP.
ACTIVE = {
    "cart-pole": {"force": 6, "position": 2},
    "robot arm": {"torque": 13},
    "quadrotor": {"thrust": 11},
    "rocket": {"thrust": 12, "tilt": 3},
}


def test_the_demonstrations_have_the_active_constraints_of_the_peer(
    system: PeerSystem, plan: Plan
) -> None:
    assert Counter(row.split("[")[0] for row, _ in plan.active) == ACTIVE[system.name]
    assert plan.weakly_active == ()


def assert_differences(moved: Callable[[float], Array], slope: Array) -> None:
    """Measured: 1e-8 to 2e-7 of the largest, by rounding in the differences."""
    for column, exact in zip(slope.T, extrapolated_slope(moved, 1e-4).T, strict=True):
        np.testing.assert_allclose(column, exact, atol=1e-6 * np.max(np.abs(exact)))


def test_derivatives_are_those_of_differences_with_active_constraints(
    system: PeerSystem, plan: Plan
) -> None:
    """Along random directions of the logarithms and the initial state, all parameters at once."""
    rng, p = np.random.default_rng(3), len(plan.theta)
    for _ in range(3):
        direction = rng.normal(size=p + system.problem.n)
        change = direction * np.r_[plan.theta, np.full(system.problem.n, 0.1)]

        def moved(t: float, change: Array = change) -> Array:
            there = nearby_plan(
                plan, plan.theta + t * change[:p], system.x0 + t * change[p:], 1e-10
            )
            assert there is not None
            return np.hstack([there.x[1:], there.u])

        assert_differences(moved, np.concatenate([plan.dx[1:], plan.du], axis=1) @ change)


def test_a_closed_loop_has_the_derivatives_of_differences(system: PeerSystem, plan: Plan) -> None:
    """Largest difference, over the largest of its signal: 6e-8 (rocket), 9e-11 of the others."""
    d, p = np.zeros((5, 0)), len(plan.theta)
    loop = system.problem.closed_loop(system.truth, system.x0, 5)
    assert any(one.active for one in loop.plans)
    sizes = np.where(system.x0 == 0, 0.01, np.abs(system.x0))
    change = np.random.default_rng(4).normal(size=p + len(sizes)) * np.r_[plan.theta, sizes]

    def moved(t: float) -> Array:
        theta, x0 = plan.theta + t * change[:p], system.x0 + t * change[p:]
        there = closed_loop_from(loop.plans[0], theta, x0, d, 1e-10, loop)
        return np.hstack([there.x[1:], there.u])

    assert_differences(moved, np.concatenate([loop.dx[1:], loop.du], axis=1) @ change)


def one_step(constraints: dict[str, ca.SX], u: ca.SX, p: ca.SX) -> OptimalControlProblem:
    """Minimise (u - p)^2 and nothing else."""
    x = ca.SX.sym("x")
    return OptimalControlProblem(
        x, u, {"p": p}, next_state=x + u, stage_cost=(u - p) ** 2, horizon=1,
        constraints=constraints,
    )  # fmt: skip


def test_a_weakly_active_row_is_named_and_has_a_slope_between_its_sides() -> None:
    """u = min(p, 1) at p = 1: slopes 1 and 0."""
    u, p = ca.SX.sym("u"), ca.SX.sym("p")
    problem = one_step({"cap": u - 1}, u, p)
    plan = problem.plan({"p": 1.0}, [0.0])
    assert plan.weakly_active == (("cap", 0),)
    assert plan.du[0, 0, 0] == pytest.approx(0.5, abs=1e-4)
    for value, slope in ((0.9, 1.0), (1.1, 0.0)):
        side = problem.plan({"p": value}, [0.0])
        assert side.weakly_active == ()
        assert side.du[0, 0, 0] == pytest.approx(slope, abs=1e-7)


def test_dependent_rows_do_no_harm() -> None:
    """A limit that is written twice: the plan is determined, the single multipliers are not."""
    u, p = ca.SX.sym("u"), ca.SX.sym("p")
    plan = one_step({"cap": u - 1, "again": 2 * u - 2}, u, p).plan({"p": 2.0}, [0.0])
    assert plan.u[0, 0] == pytest.approx(1)
    assert plan.active == (("cap", 0), ("again", 0))
    assert plan.du[0, 0, 0] == pytest.approx(0, abs=1e-7)


def test_a_row_at_the_end_is_kept_and_differentiated() -> None:
    """A final position x_N >= p: the least effort is p / N at every sample."""
    x, u, p = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("p")
    problem = OptimalControlProblem(
        x, u, {"p": p}, next_state=x + u, stage_cost=u**2, horizon=5,
        terminal_constraints={"away": p - x},
    )  # fmt: skip
    plan = problem.plan({"p": 2.0}, [0.0])
    np.testing.assert_allclose(plan.u[:, 0], 0.4, atol=1e-9)
    np.testing.assert_allclose(plan.du[:, 0, 0], 0.2, atol=1e-8)


def test_a_solver_writes_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    u, p = ca.SX.sym("u"), ca.SX.sym("p")
    for name in SOLVERS:
        one_step({"cap": u - 1}, u, p).plan({"p": 2.0}, [2.0], solver=name)
    assert capfd.readouterr() == ("", "")
