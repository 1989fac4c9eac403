"""Table 3.1: the example of section 3.4, and problems with known solutions."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.certificates import cholesky_parameters, weights_from_parameters
from impc.assess.weights_test import identifiability
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.feasibility import require_complete
from impc.control.simulation import Status, scenario
from impc.errors import SolverError
from impc.inverse.equivalent_weights import SLACK, least_condition_weights
from impc.inverse.explaining_weights import weights_behind
from impc.inverse.problem import Problem, controller_for
from impc.inverse.proximal_search import Residual, weight_jacobian
from impc.inverse.proximal_step import block_basis
from impc.inverse.residuals import evaluate, keeps_hard, residual_only
from impc.inverse.search import fit_gain
from impc.inverse.solution_set import gain_fibre
from impc.inverse.table31 import (
    CONDITION_WEIGHT,
    inverse_mpc,
    inverse_mpc_reduced,
    starting_weights,
    table_3_1,
)
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.riccati import solve_lqr
from impc.model.weights import (
    Weights,
    condition_number,
    weight_error,
)
from impc.studies.example.cases import CASES, run_case
from tests.support import nelder_mead, random_plant, random_weights

IDENTITY = Weights(np.eye(2), 1)


def example(plant: Plant, bounds: Bounds, case: str) -> Problem:
    controller = Controller(plant, IDENTITY, bounds, 3)
    run = require_complete(controller, simulate(controller, scenario(plant, CASES[case], 20)))
    return Problem(plant, bounds, 3, (Recording(plant, run.x),))


@pytest.mark.parametrize("case", CASES)
def test_table_3_1_recovers_the_weights(
    example_plant: Plant, example_bounds: Bounds, case: str
) -> None:
    problem = example(example_plant, example_bounds, case)
    lines = table_3_1(problem)
    for name in ("inverse_mpc", "inverse_mpc_reduced"):
        assert weight_error(lines[name].stage_weights, IDENTITY) <= 1e-6
        assert keeps_hard(problem, lines[name].stage_weights)
    squared = inverse_mpc(problem, starting_weights(problem), squared=True)
    assert weight_error(squared.stage_weights, IDENTITY) <= 1e-6
    assert (lines["inverse_lqr_lmi"].weights is None) == (case != "B")


def test_the_dissertations_comparison_shows_in_case_A(example_plant: Plant) -> None:
    result = run_case(example_plant, "A")
    gain, output = result.method("feedback_gain"), result.method("inverse_lqr_output")
    assert result.branch == "gradient"
    assert run_case(example_plant, "B").branch == "LMI"
    assert gain.K is not None
    np.testing.assert_allclose(gain.K, [[1.21183, -0.71277]], atol=1e-5)
    assert gain.state_misfit == pytest.approx(0.2333, abs=1e-4)
    assert gain.max_abs_u == pytest.approx(1.2295, abs=1e-4)
    assert not gain.bound_kept
    assert not output.bound_kept
    assert output.state_misfit is not None
    assert gain.state_misfit is not None
    assert output.state_misfit > gain.state_misfit
    for name in ("inverse_mpc", "inverse_mpc_reduced"):
        assert result.method(name).bound_kept
    assert not result.method("inverse_lqr_lmi").feasible
    assert result.identifiability.rank == 2
    assert result.identifiability.free == 3
    assert result.identifiability.chosen == 1


def test_example_identifiability_shows_other_weights_that_explain_the_data(
    example_plant: Plant, example_bounds: Bounds
) -> None:
    problem = example(example_plant, example_bounds, "A")
    found = identifiability(problem, IDENTITY)
    assert found.singular_values[2] < 1e-10 * found.singular_values[0]
    assert len(found.others) == 2
    first, second = (item.weights.Q for item in found.others)
    assert np.linalg.norm(first - second) > 0.1
    for item in found.others:
        assert item.misfit < 1e-9
        assert np.linalg.norm(item.weights.Q - np.eye(2)) > 0.1


def test_what_is_determined_is_told_where_no_other_weights_can_be_found(
    example_plant: Plant, example_bounds: Bounds, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At a condition number of 5e10 no program proves anything; the count must still be made."""
    problem = example(example_plant, example_bounds, "A")
    expected = identifiability(problem, IDENTITY)

    def undecided(*_: object) -> None:
        raise SolverError("least condition number", "proven only to 0.89", "scale the states")

    monkeypatch.setattr("impc.assess.weights_test.other_weights", undecided)
    found = identifiability(problem, IDENTITY)
    assert found.others == ()
    assert (found.rank, found.free) == (expected.rank, expected.free)


def test_singular_values_are_those_of_differences(
    example_plant: Plant, example_bounds: Bounds
) -> None:
    """Derivative of the outputs by relative changes of Q and R: three directions, scale."""
    problem = example(example_plant, example_bounds, "A")
    columns = []
    for direction in block_basis(2, 1):
        pair = []
        for step in (1e-5, -1e-5):
            block = np.eye(3) + step * direction
            solution = solve_lqr(problem.plant, Weights(block[:2, :2], block[2:, 2:]))
            pair.append(evaluate(problem, solution.K, solution.S).residual)
        columns.append((pair[0] - pair[1]) / 2e-5)
    expected = np.linalg.svd(np.column_stack(columns), compute_uv=False)
    found = identifiability(problem, IDENTITY).singular_values
    # Finite differences are accurate to 1e-10 of the largest.
    np.testing.assert_allclose(found, expected, atol=1e-7 * float(expected[0]))


def test_output_penalty_reaches_what_a_derivative_free_search_reaches(
    example_plant: Plant, example_bounds: Bounds
) -> None:
    problem = example(example_plant, example_bounds, "A")
    linear = problem.without_bounds()

    def objective(weights: Weights) -> float:
        solution = solve_lqr(example_plant, weights)
        distance = np.linalg.norm(residual_only(linear, solution.K, solution.S))
        return float(distance + CONDITION_WEIGHT * condition_number(weights))

    found = inverse_mpc(linear, IDENTITY, explain=False)
    search = nelder_mead(
        lambda z: objective(weights_from_parameters(z, 2, 1)),
        cholesky_parameters(found.stage_weights) + 0.03,
        1500,
    )
    assert objective(found.stage_weights) <= search + 1e-8


@pytest.mark.full
def test_direct_form_tends_to_the_reduced_one_with_noise(
    example_plant: Plant, example_bounds: Bounds
) -> None:
    clean = example(example_plant, example_bounds, "B")
    rng = np.random.default_rng(0)
    noisy = clean.recordings[0].outputs + 0.01 * rng.normal(size=(21, 2))
    problem = Problem(
        example_plant, example_bounds, 3, (Recording(example_plant, noisy, x0=[2, 3]),)
    )
    reduced = inverse_mpc_reduced(problem)
    distances = []
    for weight in (1e-2, 1e-3, 1e-4, 1e-5):
        direct = inverse_mpc(problem, IDENTITY, condition_weight=weight)
        distances.append(weight_error(direct.stage_weights, reduced.stage_weights))
    assert np.all(np.diff(distances) < 0)
    assert distances[-1] < np.sqrt(SLACK)


def test_squared_misfit_trades_and_the_norm_does_not(
    example_plant: Plant, example_bounds: Bounds
) -> None:
    """Exact data, true weights away from the identity (docs/why/theory.md)."""
    true = Weights([[4.0, 0.5], [0.5, 1.0]], 2.0)
    controller = Controller(example_plant, true, example_bounds, 3)
    run = require_complete(controller, simulate(controller, scenario(example_plant, [2, 3], 20)))
    problem = Problem(example_plant, example_bounds, 3, (Recording(example_plant, run.x),))
    reduced = inverse_mpc_reduced(problem)
    assert np.linalg.norm(reduced.gain - controller.K) < 1e-9
    assert condition_number(reduced.stage_weights) <= condition_number(true) * (1 + 2 * SLACK)
    norm = inverse_mpc(problem, IDENTITY)
    square = inverse_mpc(problem, IDENTITY, squared=True)
    assert norm.misfit < 1e-9
    assert weight_error(norm.stage_weights, reduced.stage_weights) < np.sqrt(SLACK)
    assert square.misfit > 1e-6
    assert condition_number(square.stage_weights) < condition_number(norm.stage_weights)


def test_two_inputs_recover_gain_and_metric_while_bounds_are_active() -> None:
    rng = np.random.default_rng(3)
    plant = random_plant(rng, 3, 2, 1.1)
    true = Weights(random_weights(rng, 3), random_weights(rng, 2))
    bounds = Bounds(plant, u_min=-0.3, u_max=0.3)
    controller = Controller(plant, true, bounds, 4)
    recordings = []
    for _ in range(40):
        run = simulate(controller, scenario(plant, rng.normal(size=3), 15))
        if run.complete and Status.ACTIVE in run.status:
            recordings.append(Recording(plant, run.x))
    problem = Problem(plant, bounds, 4, tuple(recordings))
    found = inverse_mpc_reduced(problem)
    np.testing.assert_allclose(found.gain, controller.K, atol=1e-6)
    assert len(found.metrics) == 1
    np.testing.assert_allclose(
        found.metric / np.trace(found.metric), controller.S / np.trace(controller.S), atol=1e-6
    )
    fibre = gain_fibre(plant, controller.K, solve_lqr(plant, true).S)
    best = least_condition_weights(fibre).condition
    assert condition_number(found.stage_weights) == pytest.approx(best, rel=1e-4)
    counts = identifiability(problem, found.stage_weights)
    assert counts.free == 8
    assert counts.rank == 3 * 2 + 2 - 1  # docs/why/theory.md: n m + m - 1
    # Without an active bound the metric is not identified, only the gain.
    calm = simulate(controller, scenario(plant, [1e-3, 0, 0], 15))
    quiet = Problem(plant, bounds, 4, (Recording(plant, calm.x),))
    assert len(weights_behind(fit_gain(quiet)).metrics) > 1


@pytest.mark.parametrize("inputs", [1, 2])
def test_jacobian_in_the_weights_equals_central_differences(inputs: int) -> None:
    """Terminal set, gain and metric follow the weights; bounds are active."""
    rng = np.random.default_rng(inputs)
    plant = random_plant(rng, 3, inputs, 1.1)
    Q, R = random_weights(rng, 3), random_weights(rng, inputs)
    bounds = Bounds(plant, u_min=-0.3, u_max=0.4, x_min=-2, x_max=2)
    controller = Controller(plant, Weights(Q, R), bounds, 3)
    for size in 5 * 0.9 ** np.arange(60):
        run = simulate(controller, scenario(plant, size * np.ones(3), 15))
        if run.complete and Status.ACTIVE in run.status:
            break
    problem = Problem(plant, bounds, 3, (Recording(plant, 0.9 * run.x, x0=run.x[0]),))
    solution = solve_lqr(plant, Weights(Q, R))
    found = evaluate(problem, solution.K, solution.S)
    basis = block_basis(3, inputs)
    exact = weight_jacobian(
        solution, Residual(found.residual, found.dK, found.dS, usable=True), basis
    )
    for index, member in enumerate(basis):
        errors = []
        for step in (1e-5, 1e-6):
            sides = [
                solve_lqr(plant, Weights(Q + s * member[:3, :3], R + s * member[3:, 3:]))
                for s in (step, -step)
            ]
            up, down = (residual_only(problem, side.K, side.S) for side in sides)
            difference = (up - down) / (2 * step)
            scale = max(1.0, float(np.max(np.abs(difference))))
            errors.append(float(np.max(np.abs(exact[:, index] - difference))) / scale)
        assert min(errors) < 1e-6


def test_a_gain_no_weights_have_is_said_and_the_direct_form_continues(
    example_plant: Plant, example_bounds: Bounds
) -> None:
    """Recording made by a gain that no weights have."""
    gain = np.array([[1.21183, -0.71277]])
    controller = Controller.from_gain(example_plant, gain, example_bounds, 3)
    run = require_complete(
        controller, simulate(controller, scenario(example_plant, [0.5, 0.7], 20))
    )
    problem = Problem(example_plant, example_bounds, 3, (Recording(example_plant, run.x),))
    found = inverse_mpc_reduced(problem)
    np.testing.assert_allclose(found.gain, gain, atol=1e-7)
    assert "weights" in found.reason
    assert not found.explained
    near = solve_lqr(problem.plant, found.stage_weights)
    assert np.linalg.norm(residual_only(problem, near.K, near.S)) > 1e-3


def test_a_search_steps_back_from_gains_that_do_not_stabilise(
    example_plant: Plant, example_bounds: Bounds
) -> None:
    problem = example(example_plant, example_bounds, "A")
    found = evaluate(problem, np.zeros((1, 2)), np.eye(1))
    assert "does not stabilise the plant" in found.reason
    assert np.all(np.isfinite(found.residual))
    assert np.linalg.norm(found.residual) > 1e3
    assert controller_for(problem, np.array([[1.5, -0.9]]), np.eye(1)).softening is not None


@pytest.mark.full
def test_a_recording_that_breaks_a_state_bound_is_fitted_softly_and_said_so(
    example_plant: Plant,
) -> None:
    """Push beyond the bound: infeasible for a hard controller, explained by the soft one."""
    rng = np.random.default_rng(5)
    plant = random_plant(rng, 3, 1, 1.1, d=1)
    bounds = Bounds(plant, u_min=-1, u_max=1, x_min=-0.5, x_max=0.5)
    true = Controller(plant, Weights(np.eye(3), 1), bounds, 6, softening=1e6)
    push = 0.8 * rng.normal(size=40)
    run = simulate(true, scenario(plant, 0.2 * np.ones(3), disturbance=push))
    assert Status.SOFTENED in run.status
    trial = Recording(plant, run.x, np.append(push, 0.0))
    problem = Problem(plant, bounds, 6, (trial,), softening=1e6)
    found = inverse_mpc_reduced(problem)
    assert not keeps_hard(problem, found.stage_weights)
    np.testing.assert_allclose(found.gain, true.K, atol=1e-6)


def test_an_iterate_that_diverges_is_named_and_finite(
    example_plant: Plant, example_bounds: Bounds
) -> None:
    """Gain that makes too little use of the bounded input for this initial state."""
    problem = example(example_plant, example_bounds, "A")
    outputs = np.vstack([2.5 * problem.recordings[0].outputs, np.zeros((200, 2))])
    far = Problem(
        example_plant,
        example_bounds,
        3,
        (Recording(example_plant, outputs),),
        terminal_set=False,
    )
    found = evaluate(far, np.array([[1.02, -0.72]]), np.eye(1))
    assert found.reason.startswith("sample 60: ")
    assert np.all(np.isfinite(found.residual))
