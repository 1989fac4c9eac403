"""Parameters behind plans and closed loops: known values, the linear case, noise, errors."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from experiments.peer_systems import SYSTEMS
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.simulation import Status, scenario
from impc.errors import DataError, InfeasibleError, InputError
from impc.inverse.methods import fit
from impc.inverse.problem import Problem
from impc.model.bounds import Bounds
from impc.model.recordings import Recording
from impc.model.weights import Weights
from impc.nonlinear.closed_loop import OptimalRecording
from impc.nonlinear.fit import fit_optimal_control
from impc.nonlinear.problem import OptimalControlProblem
from tests.nonlinear.linear_twin import linear_twin
from tests.support import random_plant

#: System -> sentences on unidentified combinations, from the mechanics (docs/howto/nonlinear.md).
UNIDENTIFIED = {
    "cart-pole": [],
    "robot arm": [{"max_q": 1.0}, {"l1": 1.0, "m1": -2.0, "l2": 1.0, "m2": -2.0}],
    "quadrotor": [{"max_r": 1.0}],
    "rocket": [{"Jx": 1.0}, {"Jy": 1.0, "Jz": 1.0, "l": 1.0}],
}


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_demonstration_gives_back_what_it_tells(name: str) -> None:
    system = SYSTEMS[name]()
    truth = system.problem.values(system.truth)
    demonstration = system.problem.plan(system.truth, system.x0, mu=1e-12)
    rng = np.random.default_rng(5)
    start = dict(zip(system.truth, truth * np.exp(0.1 * rng.normal(size=len(truth))), strict=True))
    found = fit_optimal_control(
        system.problem, [system.problem.recorded_plan(demonstration.x, demonstration.u)], start
    )
    assert found.settled
    assert found.loss < 1e-10
    identified = found.combinations
    assert [one.exponents for one in identified.unidentified] == UNIDENTIFIED[name]
    assert len(identified.identified) == len(truth) - len(identified.unidentified)
    for one in identified.identified:
        expected = np.prod([system.truth[key] ** power for key, power in one.exponents.items()])
        assert one.value == pytest.approx(expected, rel=1e-5)


@pytest.mark.full
@pytest.mark.parametrize("limit", [0.6, 50.0], ids=["saturated", "not saturated"])
def test_a_linear_loop_has_the_weights_of_the_linear_route(limit: float) -> None:
    """Two states, one input: the two entries of the gain determine the diagonal of Q."""
    plant = random_plant(np.random.default_rng(11), 2, 1, 1.05)
    weights = Weights(np.diag([2.0, 0.5]), 1)
    bounds = Bounds(plant, u_min=-limit, u_max=limit)
    controller = Controller(plant, weights, bounds, 6, terminal_set=False)
    run = simulate(controller, scenario(plant, [0.8, -0.5], 20))
    assert bool(np.any(run.status == Status.ACTIVE)) == (limit < 1)
    linear = fit(Problem(plant, bounds, 6, (Recording(plant, run.x),), terminal_set=False))
    problem, _ = linear_twin(controller, weights)
    found = fit_optimal_control(
        problem, [problem.recorded_loop(run.x, run.u)], {"q0": 1.5, "q1": 0.7}
    )
    Q = np.diag([2.0 * found.theta["q0"], 0.5 * found.theta["q1"]])
    again = Controller(plant, Weights(Q, 1), bounds, 6, terminal_set=False)
    np.testing.assert_allclose(again.K, linear.gain, rtol=1e-6)
    np.testing.assert_allclose([found.theta["q0"], found.theta["q1"]], 1, rtol=1e-6)


def point(disturbed: bool = False, size: float = 1.0) -> OptimalControlProblem:
    """A point with drag and limited force; its cost is multiplied by `size`."""
    x, u, d = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("d")
    drag, price, limit = ca.SX.sym("drag"), ca.SX.sym("price"), ca.SX.sym("limit")
    force = u + d if disturbed else u
    return OptimalControlProblem(
        x, u, {"drag": drag, "price": price, "limit": limit},
        next_state=x + 0.1 * ca.vertcat(x[1], force - drag * x[1] * ca.fabs(x[1])),
        stage_cost=size * (price * x[0] ** 2 + u**2), terminal_cost=size * price * x[0] ** 2,
        constraints={"force": ca.vertcat(u - limit, -u - limit)}, horizon=15,
        disturbances=d if disturbed else None, signed=["drag"],
    )  # fmt: skip


TRUTH = {"drag": 0.3, "price": 5.0, "limit": 1.2}
START = {"drag": 0.1, "price": 8.0, "limit": 1.0}


def recorded(problem: OptimalControlProblem) -> OptimalRecording:
    plan = problem.plan(TRUTH, [1.0, 0.5], mu=1e-12)
    return problem.recorded_plan(plan.x, plan.u)


@pytest.mark.full
def test_recordings_of_both_kinds_with_missing_samples_disturbances_and_unknown_starts() -> None:
    problem = point(disturbed=True)
    d = 0.5 * np.sin(np.arange(25.0))[:, None]
    loop = problem.closed_loop(TRUTH, [1.0, 0.5], 25, d=d)
    gap, late = loop.x.copy(), loop.x.copy()
    gap[5:9, 1] = late[0] = np.nan
    found = fit_optimal_control(
        problem,
        [problem.recorded_loop(gap, d=d), recorded(problem),
         problem.recorded_loop(late, loop.u, d=d, x0=[0.8, 0.8], unknown_start=True)],
        START,
    )  # fmt: skip
    for name, value in TRUTH.items():
        assert found.theta[name] == pytest.approx(value, rel=1e-6)
    assert found.combinations.unidentified == ()
    np.testing.assert_allclose(found.x0[2], [1.0, 0.5], atol=1e-7)


@pytest.mark.full
def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    """Thirty noisy plans, three parameters each: 95 % of 90, within three standard errors."""
    problem = point()
    plan = problem.plan(TRUTH, [1.0, 0.5])
    rng = np.random.default_rng(2)
    held = 0
    for _ in range(30):
        noisy = [
            item + 0.05 * np.sqrt(np.mean(item**2, axis=0)) * rng.normal(size=item.shape)
            for item in (plan.x, plan.u)
        ]
        recording = problem.recorded_plan(*noisy, x0=plan.x[0])
        intervals = fit_optimal_control(problem, [recording], TRUTH).intervals()
        held += sum(low < TRUTH[name] < high for name, (low, high) in intervals.items())
    assert 79 <= held <= 90


def test_what_cannot_be_fitted_is_refused_in_a_line() -> None:
    problem, arm = point(), SYSTEMS["robot arm"]()
    recording, plan = recorded(problem), arm.problem.plan(arm.truth, arm.x0)
    with pytest.raises(DataError, match="recordings: is empty; give at least one"):
        fit_optimal_control(problem, [], START)
    with pytest.raises(InputError, match="recordings: belong to another problem"):
        fit_optimal_control(point(), [recording], START)
    with pytest.raises(InputError, match="solver: got 'knitro'; choose one of"):
        fit_optimal_control(problem, [recording], START, solver="knitro")
    with pytest.raises(InputError, match="'mu_steps'; its arguments are problem, recordings, sta"):
        fit_optimal_control(problem, [recording], START, mu_steps=(0.1,))  # type: ignore[call-arg]
    with pytest.raises(InputError, match="starts: got 0; give a whole number of at least"):
        fit_optimal_control(problem, [recording], START, starts=0)
    with pytest.raises(InputError, match="level: got 95; give one between 0 and 1"):
        fit_optimal_control(problem, [recording], TRUTH).intervals(95)
    far, shown = arm.truth | {"max_q": 2.3}, arm.problem.recorded_plan(plan.x, plan.u)
    with pytest.raises(InfeasibleError, match=r"constraint angle\[1\]: no plan .* at sample 1"):
        fit_optimal_control(arm.problem, [shown], far)


@pytest.mark.full
def test_another_start_is_tried_where_the_first_has_no_plan() -> None:
    """The first start's limit is below the angle at which the arm begins; the second's is not."""
    arm = SYSTEMS["robot arm"]()
    plan = arm.problem.plan(arm.truth, arm.x0, mu=1e-12)
    recording = arm.problem.recorded_plan(plan.x, plan.u)
    start = arm.truth | {"max_q": 2.3}
    found = fit_optimal_control(arm.problem, [recording], start, starts=4)
    assert found.loss < 1e-10
    assert found.start == start


def test_the_size_of_the_cost_does_not_matter() -> None:
    """The cost times 1e-3 gives the same result, with a smaller mu."""
    problem = point(size=1e-3)
    found = fit_optimal_control(problem, [recorded(problem)], START | {"limit": 3.0})
    assert found.theta == pytest.approx(TRUTH, rel=1e-4)


def test_a_search_that_is_stopped_says_so() -> None:
    problem = point()
    found = fit_optimal_control(problem, [recorded(problem)], START, evaluations=3)
    assert not found.settled
    assert found.evaluations <= 3


def turned(bend: float) -> tuple[OptimalControlProblem, dict[str, float]]:
    """A point with force f (1 + bend f) and a mass: a scaling if bend is zero."""
    x, u = ca.SX.sym("x", 1), ca.SX.sym("u")
    force, mass, price = ca.SX.sym("force"), ca.SX.sym("mass"), ca.SX.sym("price")
    problem = OptimalControlProblem(
        x, u, {"force": force, "mass": mass, "price": price},
        next_state=0.9 * x + 0.1 * u * force * (1 + bend * force) / mass,
        stage_cost=price * x**2 + u**2, horizon=6,
    )  # fmt: skip
    return problem, {"force": 2.0, "mass": 1.5, "price": 4.0}


@pytest.mark.parametrize("bend", [0.0, 0.5])
def test_a_scaling_is_one_where_it_holds_far_from_the_estimate(bend: float) -> None:
    """Force and mass keep their ratio; with a bend the direction is only a tangent."""
    problem, truth = turned(bend)
    loop = problem.closed_loop(truth, [1.0], 12)
    recording = problem.recorded_loop(loop.x, loop.u)
    found = fit_optimal_control(problem, [recording], truth).combinations
    (one,) = found.unidentified
    assert set(one.exponents) == {"force", "mass"}
    assert one.scaling == (bend == 0.0)
    words = "any factor a is possible" if one.scaling else "Near these values"
    assert any(words in sentence for sentence in found.sentences)
    assert all(abs(item) <= 4 for said in found.identified for item in said.exponents.values())
