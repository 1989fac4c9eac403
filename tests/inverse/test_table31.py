"""Table 3.1: the example of section 3.4, and problems with known solutions."""

from __future__ import annotations

import numpy as np
import pytest

import impc
from experiments.benchmarks.workloads import seat
from experiments.certificates import cholesky_parameters, weights_from_parameters
from impc.arrays import Array
from impc.control.closed_loop import simulate
from impc.inverse import table31
from impc.inverse.equivalent_weights import SLACK
from impc.inverse.laws import GainLaw
from impc.inverse.problem import controller_for
from impc.inverse.proximal_step import StepProgram, block_basis, solve_step
from impc.inverse.residuals import keeps_hard, residual_only
from impc.inverse.unknowns import linear_at
from impc.model.weights import condition_number
from impc.studies.example.cases import CASES, CaseResult
from tests import support
from tests.inverse.test_equivalent_weights import NO_WEIGHTS_GAIN
from tests.support import present

IDENTITY = impc.Weights(np.eye(2), 1)
TRUTH = impc.solve_lqr(support.example_plant(), IDENTITY).K
UNITS = [1.0, *(pytest.param(one, marks=pytest.mark.full) for one in (1e-12, 1e-5, 1e5, 1e12))]


def of_block(problem: impc.Problem, block: Array) -> Array:
    """Residual of the weights diag(Q, R)."""
    n = problem.plant.n
    solution = impc.solve_lqr(problem.plant, impc.Weights(block[:n, :n], block[n:, n:]))
    return residual_only(problem, solution.K, solution.S)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("unit", UNITS)
def test_table_3_1_recovers_the_weights(case: str, unit: float) -> None:
    problem = support.example_problem(case, unit)
    lines = impc.table_3_1(problem)
    assert lines["inverse_mpc"].explained
    np.testing.assert_allclose(lines["inverse_mpc"].gain, TRUTH, rtol=1e-9)
    for name in ("inverse_mpc", "inverse_mpc_reduced"):
        assert impc.weight_error(lines[name].stage_weights, IDENTITY) <= 1e-6
        assert keeps_hard(problem, lines[name].stage_weights)
    squared = table31.inverse_mpc(problem, table31.starting_weights(problem), squared=True)
    assert impc.weight_error(squared.stage_weights, IDENTITY) <= 1e-6
    assert (lines["inverse_lqr_lmi"].weights is None) == (case != "B")


def test_the_dissertations_comparison_shows_in_case_A(case_a: CaseResult) -> None:
    gain, output = case_a.method("feedback_gain"), case_a.method("inverse_lqr_output")
    assert case_a.branch == "gradient"
    np.testing.assert_allclose(present(gain.estimate.K), NO_WEIGHTS_GAIN, atol=1e-5)
    assert gain.estimate.misfit == pytest.approx(0.2333, abs=1e-4)
    assert gain.largest_input[0] == pytest.approx(1.2295, abs=1e-4)
    kept = {"inverse_mpc": True, "inverse_mpc_reduced": True}
    kept |= {"feedback_gain": False, "inverse_lqr_output": False}
    assert {name: case_a.method(name).keeps_bounds for name in kept} == kept
    assert output.estimate.misfit > gain.estimate.misfit
    assert case_a.method("inverse_lqr_lmi").estimate.K is None
    counts = case_a.identifiability
    assert (counts.rank, counts.free, counts.chosen) == (2, 3, 1)


@pytest.mark.parametrize("inputs", [0, 1, 2])
def test_singular_values_are_those_of_differences(inputs: int) -> None:
    """Of the example (0), and of random problems at bounds of inputs and states.

    Terminal set, gain and metric follow the weights.
    """
    problem, weights, rng = support.example_problem("A"), IDENTITY, np.random.default_rng(inputs)
    if inputs:
        plant = support.random_plant(rng, 3, inputs, 1.1)
        weights = impc.Weights(support.random_weights(rng, 3), support.random_weights(rng, inputs))
        bounds = impc.Bounds(plant, u_min=-0.3, u_max=0.4, x_min=-2, x_max=2)
        law = impc.Controller(plant, weights, bounds, 3)
        for size in 5 * 0.9 ** np.arange(60):
            run = simulate(law, impc.scenario(plant, size * np.ones(3), 15))
            if run.complete and impc.Status.ACTIVE in run.status:
                break
        problem = support.posed(law, impc.Recording(plant, 0.9 * run.x, x0=run.x[0]))
    (n, m), L = (problem.plant.n, problem.plant.m), np.linalg.cholesky(weights.block)
    basis = L @ block_basis(n, m) @ L.T
    columns = support.extrapolated_jacobian(
        lambda t: of_block(problem, weights.block + np.tensordot(t, basis, 1)),
        np.zeros(len(basis)), 1e-4,
    )  # fmt: skip
    expected = np.linalg.svd(columns, compute_uv=False)
    found = impc.identifiability(problem, weights).singular_values
    np.testing.assert_allclose(found, expected, atol=1e-9 * float(expected[0]))


def test_identifiability_of_the_example(monkeypatch: pytest.MonkeyPatch) -> None:
    """Other weights that explain the data, or no others found."""
    problem = support.example_problem("A")
    found = impc.identifiability(problem, IDENTITY)
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


def test_the_recording_of_the_seat_determines_ten_of_fifty_five_directions() -> None:
    work = seat()
    counts = impc.identifiability(work.problem, work.weights)
    assert (counts.free, counts.rank) == (55, 10)
    assert all(item.misfit < 1e-6 for item in counts.others)


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
    problem = support.posed(law, impc.Recording(plant, law.simulate([2, 3], 20).x))
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


def test_a_gain_no_weights_have_is_said_and_the_direct_form_continues() -> None:
    plant, bounds = support.example_plant(), support.example_problem("A").bounds
    law = impc.Controller.from_gain(plant, NO_WEIGHTS_GAIN, bounds, 3)
    problem = support.posed(law, impc.Recording(plant, law.simulate([0.5, 0.7], 20).x))
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
    run = true.simulate(0.2 * np.ones(3), disturbance=push)
    assert impc.Status.SOFTENED in run.status
    problem = support.posed(true, impc.Recording(plant, run.x, push), softening=1e6)
    found = table31.inverse_mpc_reduced(problem)
    assert not keeps_hard(problem, found.stage_weights)
    np.testing.assert_allclose(found.gain, true.K, atol=1e-6)


def test_iterates_that_do_not_stabilise_or_diverge_are_named_and_finite() -> None:
    """No gain at all, and one that makes too little use of the bounded input."""
    problem = support.example_problem("A")
    assert controller_for(problem, np.array([[1.5, -0.9]]), np.eye(1)).softening is not None
    outputs = np.vstack([2.5 * problem.recordings[0].outputs, np.zeros((200, 2))])
    trial = impc.Recording(problem.plant, outputs)
    far = impc.Problem(problem.plant, problem.bounds, 3, (trial,), terminal_set=False)
    for at, gain, said in (
        (problem, np.zeros((1, 2)), "does not stabilise the plant"),
        (far, np.array([[1.02, -0.72]]), "sample 60: "),
    ):
        law = GainLaw(at, gain, np.eye(1), whitened=False)
        found = linear_at(at, law, law.start)
        assert said in found.reason
        assert np.all(np.isfinite(found.residual))
        assert np.linalg.norm(found.residual) > 1e3


@pytest.mark.parametrize("squared", [False, True])
@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_a_step_does_not_depend_on_the_unit_of_the_residual(unit: float, squared: bool) -> None:
    """Regression: nearly exact recordings have residuals of 1e4 SD, and steps were 1e-8."""
    step = np.array([0.1, -0.05, 0.2, 0.1])  # of least residual; increases all eigenvalues
    X, jacobian = np.diag([3.0, 1.0, 2.0]), unit * np.random.default_rng(1).normal(size=(4, 4))
    program = StepProgram(
        X=X,
        L=np.sqrt(X),
        n=2,
        basis=block_basis(2, 1),
        jacobian=jacobian,
        residual=-jacobian @ step,
        rest=unit,
        fit_weight=1.0,
        condition_weight=1e-14 * unit ** (1 + squared),
        squared=squared,
    )
    np.testing.assert_allclose(solve_step(program, 0.5)[0], step, atol=1e-4)
