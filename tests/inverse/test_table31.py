"""Table 3.1: the example of section 3.4, and problems with known solutions."""

from __future__ import annotations

import numpy as np
import pytest

import impc
from experiments.certificates import cholesky_parameters, weights_from_parameters
from impc.arrays import Array
from impc.control.closed_loop import simulate
from impc.inverse import table31
from impc.inverse.equivalent_weights import SLACK
from impc.inverse.explaining_weights import weights_behind
from impc.inverse.laws import GainLaw
from impc.inverse.problem import controller_for
from impc.inverse.proximal_search import weight_jacobian
from impc.inverse.proximal_step import block_basis
from impc.inverse.residuals import Linear, keeps_hard, residual_only
from impc.inverse.search import fit_gain
from impc.inverse.unknowns import linear_at
from impc.model.weights import condition_number
from impc.studies.example.cases import CASES, CaseResult, run_case
from plants import yalmip_example
from tests import support

IDENTITY = impc.Weights(np.eye(2), 1)
NO_WEIGHTS_GAIN = np.array([[1.21183, -0.71277]])


def of_block(problem: impc.Problem, block: Array) -> Array:
    """Residual of the weights diag(Q, R)."""
    n = problem.plant.n
    solution = impc.solve_lqr(problem.plant, impc.Weights(block[:n, :n], block[n:, n:]))
    return residual_only(problem, solution.K, solution.S)


def linear(problem: impc.Problem, gain: Array) -> Linear:
    law = GainLaw(problem, gain, np.eye(1), whitened=False)
    return linear_at(problem, law, law.start)


@pytest.mark.parametrize("case", CASES)
def test_table_3_1_recovers_the_weights(case: str) -> None:
    problem = support.example_problem(case)
    lines = impc.table_3_1(problem)
    for name in ("inverse_mpc", "inverse_mpc_reduced"):
        assert impc.weight_error(lines[name].stage_weights, IDENTITY) <= 1e-6
        assert keeps_hard(problem, lines[name].stage_weights)
    squared = table31.inverse_mpc(problem, table31.starting_weights(problem), squared=True)
    assert impc.weight_error(squared.stage_weights, IDENTITY) <= 1e-6
    assert (lines["inverse_lqr_lmi"].weights is None) == (case != "B")


def test_the_dissertations_comparison_shows_in_case_A(case_a: CaseResult) -> None:
    gain, output = case_a.method("feedback_gain"), case_a.method("inverse_lqr_output")
    assert case_a.branch == "gradient"
    assert run_case(impc.Plant(yalmip_example()), "B").branch == "LMI"
    assert gain.K is not None
    np.testing.assert_allclose(gain.K, NO_WEIGHTS_GAIN, atol=1e-5)
    assert gain.state_misfit == pytest.approx(0.2333, abs=1e-4)
    assert gain.max_abs_u == pytest.approx(1.2295, abs=1e-4)
    kept = {"inverse_mpc": True, "inverse_mpc_reduced": True}
    kept |= {"feedback_gain": False, "inverse_lqr_output": False}
    assert {name: case_a.method(name).bound_kept for name in kept} == kept
    assert output.state_misfit is not None
    assert gain.state_misfit is not None
    assert output.state_misfit > gain.state_misfit
    assert not case_a.method("inverse_lqr_lmi").feasible
    counts = case_a.identifiability
    assert (counts.rank, counts.free, counts.chosen) == (2, 3, 1)


def test_identifiability_of_the_example(monkeypatch: pytest.MonkeyPatch) -> None:
    """Singular values by differences, other weights that explain the data, or no others found."""
    problem = support.example_problem("A")
    found = impc.identifiability(problem, IDENTITY)
    basis = block_basis(2, 1)
    columns = support.differences(
        lambda t: of_block(problem, np.eye(3) + np.tensordot(t, basis, 1)), np.zeros(4), 1e-5
    )
    expected = np.linalg.svd(columns, compute_uv=False)
    # Finite differences are accurate to 1e-10 of the largest.
    np.testing.assert_allclose(found.singular_values, expected, atol=1e-7 * float(expected[0]))
    assert found.singular_values[2] < 1e-10 * found.singular_values[0]
    first, second = (np.array(item.weights.Q) for item in found.others)
    for one, other in ((first, second), (first, np.eye(2)), (second, np.eye(2))):
        assert np.linalg.norm(one - other) > 0.1
    assert max(item.misfit for item in found.others) < 1e-9

    # At a condition number of 5e10 no program proves anything; the count must still be made.
    def undecided(*_: object) -> None:
        raise impc.SolverError("least condition number", "proven only to 0.89", "scale the states")

    monkeypatch.setattr("impc.assess.weights_test.other_weights", undecided)
    bare = impc.identifiability(problem, IDENTITY)
    assert bare.others == ()
    assert (bare.rank, bare.free) == (found.rank, found.free)


def test_output_penalty_reaches_what_a_derivative_free_search_reaches() -> None:
    linear = support.example_problem("A").without_bounds()

    def objective(weights: impc.Weights) -> float:
        distance = np.linalg.norm(of_block(linear, weights.block))
        return float(distance + table31.CONDITION_WEIGHT * condition_number(weights))

    found = table31.inverse_mpc(linear, IDENTITY, explain=False)
    start = cholesky_parameters(found.stage_weights) + 0.03
    search = support.nelder_mead(lambda z: objective(weights_from_parameters(z, 2, 1)), start, 1500)
    assert objective(found.stage_weights) <= search + 1e-8


@pytest.mark.full
def test_direct_form_tends_to_the_reduced_one_with_noise() -> None:
    clean = support.example_problem("B")
    noise = 0.01 * np.random.default_rng(0).normal(size=(21, 2))
    noisy = impc.Recording(clean.plant, clean.recordings[0].outputs + noise, x0=[2, 3])
    problem = impc.Problem(clean.plant, clean.bounds, 3, (noisy,))
    reduced = table31.inverse_mpc_reduced(problem)
    distances = []
    for weight in (1e-2, 1e-3, 1e-4, 1e-5):
        direct = table31.inverse_mpc(problem, IDENTITY, condition_weight=weight)
        distances.append(impc.weight_error(direct.stage_weights, reduced.stage_weights))
    assert np.all(np.diff(distances) < 0)
    assert distances[-1] < np.sqrt(SLACK)


def test_squared_misfit_trades_and_the_norm_does_not() -> None:
    """Exact data, true weights away from the identity (docs/why/theory.md)."""
    plant, Q = support.example_plant(), [[4.0, 0.5], [0.5, 1.0]]
    law = support.regulator(plant, Q, 1, 3, R=2.0, terminal_set=True)
    run = impc.require_complete(law, simulate(law, impc.scenario(plant, [2, 3], 20)))
    problem = support.posed(law, impc.Recording(plant, run.x))
    reduced = table31.inverse_mpc_reduced(problem)
    assert np.linalg.norm(reduced.gain - law.K) < 1e-9
    true = condition_number(impc.Weights(Q, 2.0))
    assert condition_number(reduced.stage_weights) <= true * (1 + 2 * SLACK)
    norm = table31.inverse_mpc(problem, IDENTITY)
    square = table31.inverse_mpc(problem, IDENTITY, squared=True)
    assert norm.misfit < 1e-9
    assert impc.weight_error(norm.stage_weights, reduced.stage_weights) < np.sqrt(SLACK)
    assert square.misfit > 1e-6
    assert condition_number(square.stage_weights) < condition_number(norm.stage_weights)


def test_two_inputs_recover_gain_and_metric_while_bounds_are_active() -> None:
    rng = np.random.default_rng(3)
    plant = support.random_plant(rng, 3, 2, 1.1)
    true = impc.Weights(support.random_weights(rng, 3), support.random_weights(rng, 2))
    law = support.regulator(plant, true.Q, 0.3, 4, true.R, terminal_set=True)
    runs = [simulate(law, impc.scenario(plant, rng.normal(size=3), 15)) for _ in range(40)]
    recordings = [
        impc.Recording(plant, run.x)
        for run in runs
        if run.complete and impc.Status.ACTIVE in run.status
    ]
    problem = support.posed(law, *recordings)
    found = table31.inverse_mpc_reduced(problem)
    np.testing.assert_allclose(found.gain, law.K, atol=1e-6)
    assert len(found.metrics) == 1
    S, metric = np.array(law.S), found.metric
    np.testing.assert_allclose(metric / np.trace(metric), S / np.trace(S), atol=1e-6)
    best = impc.least_condition_weights(impc.gain_fibre(plant, law.K, S)).condition
    assert condition_number(found.stage_weights) == pytest.approx(best, rel=1e-4)
    counts = impc.identifiability(problem, found.stage_weights)
    assert (counts.free, counts.rank) == (8, 3 * 2 + 2 - 1)  # docs/why/theory.md: n m + m - 1
    # Without an active bound the metric is not identified, only the gain.
    calm = simulate(law, impc.scenario(plant, [1e-3, 0, 0], 15))
    quiet = support.posed(law, impc.Recording(plant, calm.x))
    assert len(weights_behind(fit_gain(quiet)).metrics) > 1


@pytest.mark.parametrize("inputs", [1, 2])
def test_jacobian_in_the_weights_equals_central_differences(inputs: int) -> None:
    """Terminal set, gain and metric follow the weights; bounds are active."""
    rng = np.random.default_rng(inputs)
    plant = support.random_plant(rng, 3, inputs, 1.1)
    weights = impc.Weights(support.random_weights(rng, 3), support.random_weights(rng, inputs))
    bounds = impc.Bounds(plant, u_min=-0.3, u_max=0.4, x_min=-2, x_max=2)
    law = impc.Controller(plant, weights, bounds, 3)
    for size in 5 * 0.9 ** np.arange(60):
        run = simulate(law, impc.scenario(plant, size * np.ones(3), 15))
        if run.complete and impc.Status.ACTIVE in run.status:
            break
    problem = support.posed(law, impc.Recording(plant, 0.9 * run.x, x0=run.x[0]))
    solution, basis = impc.solve_lqr(plant, weights), block_basis(3, inputs)
    at, _ = table31.closed_loop_residual(problem, solution)
    exact, errors = weight_jacobian(solution, at, basis), []
    for step in (1e-5, 1e-6):
        rough = support.differences(
            lambda t: of_block(problem, weights.block + np.tensordot(t, basis, 1)),
            np.zeros(len(basis)),
            step,
        )
        size = np.maximum(1.0, np.max(np.abs(rough), axis=0))
        errors.append(np.max(np.abs(exact - rough), axis=0) / size)
    assert np.max(np.min(errors, axis=0)) < 1e-6


def test_a_gain_no_weights_have_is_said_and_the_direct_form_continues() -> None:
    plant, bounds = support.example_plant(), support.example_problem("A").bounds
    law = impc.Controller.from_gain(plant, NO_WEIGHTS_GAIN, bounds, 3)
    run = impc.require_complete(law, simulate(law, impc.scenario(plant, [0.5, 0.7], 20)))
    problem = support.posed(law, impc.Recording(plant, run.x))
    found = table31.inverse_mpc_reduced(problem)
    np.testing.assert_allclose(found.gain, NO_WEIGHTS_GAIN, atol=1e-7)
    assert "weights" in found.reason
    assert not found.explained
    assert np.linalg.norm(of_block(problem, found.stage_weights.block)) > 1e-3


@pytest.mark.full
def test_a_recording_that_breaks_a_state_bound_is_fitted_softly_and_said_so() -> None:
    """Push beyond the bound: infeasible for a hard controller, explained by the soft one."""
    rng = np.random.default_rng(5)
    plant = support.random_plant(rng, 3, 1, 1.1, d=1)
    bounds = impc.Bounds(plant, u_min=-1, u_max=1, x_min=-0.5, x_max=0.5)
    true = impc.Controller(plant, impc.Weights(np.eye(3), 1), bounds, 6, softening=1e6)
    push = 0.8 * rng.normal(size=40)
    run = simulate(true, impc.scenario(plant, 0.2 * np.ones(3), disturbance=push))
    assert impc.Status.SOFTENED in run.status
    problem = support.posed(true, impc.Recording(plant, run.x, np.append(push, 0.0)), softening=1e6)
    found = table31.inverse_mpc_reduced(problem)
    assert not keeps_hard(problem, found.stage_weights)
    np.testing.assert_allclose(found.gain, true.K, atol=1e-6)


def test_iterates_that_do_not_stabilise_or_diverge_are_named_and_finite() -> None:
    """No gain at all, and one that makes too little use of the bounded input."""
    problem = support.example_problem("A")
    found = linear(problem, np.zeros((1, 2)))
    assert "does not stabilise the plant" in found.reason
    assert np.all(np.isfinite(found.residual))
    assert np.linalg.norm(found.residual) > 1e3
    assert controller_for(problem, np.array([[1.5, -0.9]]), np.eye(1)).softening is not None
    outputs = np.vstack([2.5 * problem.recordings[0].outputs, np.zeros((200, 2))])
    trial = impc.Recording(problem.plant, outputs)
    far = impc.Problem(problem.plant, problem.bounds, 3, (trial,), terminal_set=False)
    found = linear(far, np.array([[1.02, -0.72]]))
    assert found.reason.startswith("sample 60: ")
    assert np.all(np.isfinite(found.residual))


def solved(seed: int) -> bool:
    """Misfit below 1e-8, the metric as far as identified, least condition number to 1e-4."""
    rng = np.random.default_rng([11, seed])
    weights, _, problem = support.saturated_problem(rng, 2 + seed % 5, 1 + seed % 2)
    found, true = table31.inverse_mpc_reduced(problem), impc.solve_lqr(problem.plant, weights)
    span = found.metrics.reshape(len(found.metrics), -1).T
    beyond = true.S.ravel() - span @ np.linalg.lstsq(span, true.S.ravel())[0]
    # Of the true gain with a metric that the recording cannot distinguish.
    fibre = impc.gain_fibre(problem.plant, true.K, found.metrics)
    best = impc.least_condition_weights(fibre).condition
    size = np.linalg.norm(problem.recordings[0].outputs / problem.output_scale)
    return bool(
        found.misfit < 1e-8 * size
        and np.linalg.norm(beyond) < 1e-6 * np.linalg.norm(true.S)
        and abs(condition_number(found.stage_weights) / best - 1) < 1e-4
    )


@pytest.mark.parametrize("count", [20, pytest.param(200, marks=pytest.mark.slow)])
def test_ninety_nine_in_a_hundred_end_at_the_true_gain_and_the_least_condition(count: int) -> None:
    missed = [seed for seed in range(count) if not solved(seed)]
    print("missed", missed)
    assert len(missed) <= count // 100
