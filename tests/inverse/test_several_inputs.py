"""Problems with two and three inputs: simulated weights reproduce the recordings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import control
import numpy as np
import pytest

from experiments.misfit_ceiling import short_of_truth
from experiments.printed_intervals import carts, fit, noisy_recording, random_recording, regulator
from impc.assess.bounded_weights import weights_set
from impc.assess.covariance import gain_covariance
from impc.assess.printed_gain import gain_estimate
from impc.checking import replace
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.simulation import scenario
from impc.errors import ImpcError
from impc.inverse.equivalent_weights import least_condition_weights, other_weights
from impc.inverse.explaining_weights import weights_behind
from impc.inverse.inactive_samples import pair_of_inactive_samples
from impc.inverse.laws import GainLaw
from impc.inverse.metric_family import metric_family
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.problem import Problem
from impc.inverse.residuals import evaluate
from impc.inverse.search import fit_gain, refine_gain
from impc.inverse.solution_set import gain_fibre, natural_coordinates
from impc.inverse.table31 import inverse_mpc_reduced, table_3_1
from impc.inverse.unknowns import Unknowns
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights
from tests.support import extrapolated_slope, saturated_problem

if TYPE_CHECKING:
    from collections.abc import Callable

# Largest misfit of reported weights relative to the recorded outputs.
REPRODUCED = 1e-7


def random_problem(seed: int, m: int) -> tuple[Controller, Problem]:
    """2 to 6 states, m inputs, one random disturbance, 2 to 30 % of the inputs saturated."""
    rng = np.random.default_rng([14, m, seed])
    _, controller, problem = saturated_problem(rng, 2 + seed % 5, m)
    return controller, problem


def missed(problem: Problem, weights: Weights) -> float:
    """Relative misfit of the controller built from the reported weights."""
    plant = problem.plant
    controller = Controller(
        plant, weights, problem.bounds, problem.horizon, terminal_set=bool(problem.terminal_set)
    )
    (trial,) = problem.recordings
    run = simulate(controller, scenario(plant, trial.x0, disturbance=trial.disturbance[:-1]))
    scale = np.asarray(problem.output_scale)
    error = (run.x @ plant.C.T - trial.outputs) / scale
    return float(np.linalg.norm(error) / np.linalg.norm(trial.outputs / scale))


def by_fit(problem: Problem) -> tuple[Weights, bool]:
    found = fit_controller(problem)
    return found.stage_weights, found.explained


def by_reduced(problem: Problem) -> tuple[Weights, bool]:
    found = inverse_mpc_reduced(problem)
    assert found.explained == (not found.reason)
    return found.stage_weights, found.explained


def by_direct(problem: Problem) -> tuple[Weights, bool]:
    found = table_3_1(problem)["inverse_mpc"]
    return found.stage_weights, found.explained


PATHS = {"fit": by_fit, "reduced": by_reduced, "direct": by_direct}


def outcomes(
    path: Callable[[Problem], tuple[Weights, bool]], m: int, seeds: range
) -> dict[int, str]:
    """For problems that are not reproduced: "said so", or the misfit without a warning."""
    found = {}
    for seed in seeds:
        _, problem = random_problem(seed, m)
        try:
            weights, explained = path(problem)
        except ImpcError as error:
            found[seed] = f"said so: {error}"
            continue
        miss = missed(problem, weights)
        if miss > REPRODUCED:
            found[seed] = f"missed by {miss:.2g}" if explained else "said so"
    return found


@pytest.mark.parametrize("m", [2, pytest.param(3, marks=pytest.mark.full)])
@pytest.mark.parametrize("path", ["fit", "reduced"])
def test_reported_weights_reproduce_the_recording(path: str, m: int) -> None:
    """Regression: seeds 0 to 4 had a misfit of 0.1 to 60 % and were reported as exact."""
    assert outcomes(PATHS[path], m, range(5)) == {}


@pytest.mark.parametrize(
    ("m", "seed"),
    [
        pytest.param(2, 2, marks=pytest.mark.slow),
        pytest.param(2, 8, marks=pytest.mark.slow),
        pytest.param(3, 1, marks=pytest.mark.full),
        pytest.param(2, 96, marks=pytest.mark.full),
        (3, 70),
    ],
)
def test_direct_form_reproduces_the_recording(m: int, seed: int) -> None:
    """Regression: seeds 2 and 8 converged to misfits of 8e-5 and 3e-5.

    The last two started at an eigenvalue of -1e-9 and raised a WeightsError.
    """
    assert outcomes(by_direct, m, range(seed, seed + 1)) == {}


@pytest.mark.slow
@pytest.mark.parametrize("m", [2, 3])
@pytest.mark.parametrize("path", sorted(PATHS))
def test_ninety_nine_in_a_hundred_are_reproduced_and_no_miss_is_silent(path: str, m: int) -> None:
    found = outcomes(PATHS[path], m, range(300))
    print(path, m, found)
    assert all(text.startswith("said so") for text in found.values())
    assert len(found) <= 3


@pytest.mark.parametrize(("m", "seed"), [(2, 3), (3, 2)])
def test_metric_is_kept_along_what_is_told_of_it(m: int, seed: int) -> None:
    """The recording leaves more than one S; consistency with K determines the rest."""
    controller, problem = random_problem(seed, m)
    plant = problem.plant
    fit = refine_gain(problem, np.array(controller.K), np.array(controller.S))
    assert fit.explained
    metrics = weights_behind(fit).metrics
    assert len(metrics) == 1
    seen = evaluate(problem, fit.K, fit.S).dS.reshape(-1, m * m)
    values = np.linalg.svd(seen, compute_uv=False)
    assert np.count_nonzero(values > 1e-12 * values[0]) < m * (m + 1) // 2 - 1
    kept = gain_fibre(plant, controller.K, metrics)
    for weights in (least_condition_weights(kept).weights, other_weights(kept, 1)[0].weights):
        assert missed(problem, weights) < 1e-6
    dropped = least_condition_weights(gain_fibre(plant, controller.K)).weights
    assert missed(problem, dropped) > 1e-3


def test_set_of_weights_has_the_metric_in_it() -> None:
    _, problem = random_problem(0, 2)
    fitted = fit_controller(problem)
    assert len(fitted.metrics) == 1
    plant, K = problem.plant, np.array(fitted.gain)
    numbers = plant.n * (plant.n + 1) // 2 + plant.m * (plant.m + 1) // 2
    found = weights_set(gain_fibre(plant, K, np.array(fitted.metrics)))
    # n m + m - 1 directions are identified; one further is the scale.
    assert len(found.level) == numbers - (plant.n * plant.m + plant.m - 1) - 1


def test_fibre_of_a_metric_in_a_span() -> None:
    """R + B'PB of every member is in the span; the span of all metrics is no restriction."""
    controller, problem = random_problem(2, 3)
    plant = problem.plant
    metric = np.array(controller.S)
    other = np.diag([1.0, 0.0, 0.0])
    fibre = gain_fibre(plant, controller.K, np.array([metric, other]))
    span = np.array([metric.ravel(), other.ravel()]).T
    for weights in (least_condition_weights(fibre), *other_weights(fibre, 2)):
        S = solve_lqr(plant, weights.weights).S.ravel()
        left = S - span @ np.linalg.lstsq(span, S)[0]
        assert np.linalg.norm(left) < 1e-8 * np.linalg.norm(S)
    every = [np.outer(a, b) + np.outer(b, a) for a in np.eye(3) for b in np.eye(3)]
    free = gain_fibre(plant, controller.K)
    assert gain_fibre(plant, controller.K, np.array(every)).dimension == free.dimension


def test_a_step_at_which_the_solver_breaks_off_is_tried_shorter() -> None:
    """Regression: Clarabel panics here on eigenvalues that LAPACK does not find."""
    controller = regulator(carts(2))
    found = fit(controller, noisy_recording(controller, 111, 90.0, 0.0))
    assert found.converged
    assert found.misfit <= 1.05 * found.noise


def asymmetry(plant: Plant, gain: np.ndarray, metric: np.ndarray) -> float:
    """Relative asymmetry of S K A^-1 B, which is B'PB for a pair of weights."""
    product = metric @ gain @ np.linalg.solve(plant.A, plant.B)
    return float(np.linalg.norm(product - product.T) / np.linalg.norm(product))


@pytest.mark.parametrize(("m", "seed"), [(2, 1), (2, 4), (3, 0), (3, 4), (3, 5)])
def test_the_family_of_metrics_is_that_of_weights(m: int, seed: int) -> None:
    """Every member is consistent with the gain, and the true metric is a member.

    At (3, 5) the inputs outnumber the states.
    """
    controller, problem = random_problem(seed, m)
    K, S = np.array(controller.K), np.array(controller.S)
    family = metric_family(problem.plant, K)
    assert family is not None
    rng = np.random.default_rng(seed)
    for _ in range(5):
        assert asymmetry(problem.plant, K, family.metric(rng.standard_normal(family.count))) < 1e-9
    np.testing.assert_allclose(family.metric(family.nearest(S)), S, rtol=1e-7, atol=1e-9)
    z = 0.3 * rng.standard_normal(family.count)
    for unit, change in zip(np.eye(family.count), family.changes(z), strict=True):

        def moved(t: float, unit: np.ndarray = unit) -> np.ndarray:
            return family.metric(z + t * unit).ravel()

        expected = extrapolated_slope(moved)
        np.testing.assert_allclose(change.ravel(), expected, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize(("m", "seed"), [(2, 4), (2, 12), (3, 5), (3, 40), (3, 67), (3, 89)])
def test_inactive_samples_determine_the_gain(m: int, seed: int) -> None:
    """Also if these are a third of all samples (2, 12) or inputs outnumber states (3, 5)."""
    controller, problem = random_problem(seed, m)
    found = pair_of_inactive_samples(problem)
    assert found is not None
    truth = problem.plant.B @ controller.K
    assert np.max(np.abs(problem.plant.B @ found[0] - truth)) < 1e-7 * np.max(np.abs(truth))


@pytest.mark.parametrize("B", [[[0, 0], [1, 2]], [[0, 0], [1, 1]]])
def test_two_motors_that_do_the_same(B: list[list[float]]) -> None:
    """The split between equal inputs is a convention; weights explain the recordings."""
    plant = Plant(control.ss([[1, 0.1], [0.2, 1]], B, np.eye(2), np.zeros((2, 2)), 1))
    bounds = Bounds(plant, u_min=-0.3, u_max=0.3)
    truth = Controller(plant, Weights(np.eye(2), np.eye(2)), bounds, 10)
    rng = np.random.default_rng(0)
    trials = [Recording(plant, truth.simulate(rng.uniform(-0.5, 0.5, 2), 40).x) for _ in range(4)]
    problem = Problem(plant, bounds, 10, trials)
    for path in (by_fit, by_reduced):
        weights, explained = path(problem)
        assert explained
        assert np.linalg.cond(weights.R) < 10


@pytest.mark.parametrize(("m", "seed"), [(2, 1), (3, 4)])
def test_coordinates_know_how_gain_and_metric_change(m: int, seed: int) -> None:
    controller, problem = random_problem(seed, m)
    law = GainLaw(problem, np.array(controller.K), np.array(controller.S))
    space = Unknowns(problem, law)
    z = space.start + 0.1 * np.random.default_rng(seed).standard_normal(len(space.start))
    dK, dS = space.changes(z)

    for index, unit in enumerate(np.eye(len(z))):

        def point(offset: float, unit: np.ndarray = unit) -> np.ndarray:
            moved = space.unpack(z + offset * unit)
            return np.concatenate([moved.K.ravel(), m * moved.S.ravel() / np.trace(moved.S)])

        expected = extrapolated_slope(point)
        found = np.concatenate([dK[index].ravel(), dS[index].ravel()])
        np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-8)


def test_weights_at_the_edge_of_those_that_a_program_finds() -> None:
    """Margin below 1e-9: known members are recovered, none is invented without one."""
    _, problem = random_problem(2, 2)
    plant = problem.plant
    thin = Weights(np.diag([1e-11, 1.0, 1.0, 1.0]), np.eye(2))
    solution = solve_lqr(plant, thin)
    fibre = gain_fibre(plant, solution.K, solution.S)
    found = least_condition_weights(fibre, thin)
    assert found.gain_error < 1e-8


@pytest.mark.full
def test_a_noisy_fit_stays_where_it_ended() -> None:
    """Regression: restarted at its own solution, the gain moved by a fifth of its error."""
    controller, clean = random_problem(1, 2)
    (trial,) = clean.recordings
    scale = np.asarray(clean.output_scale)
    noise = 0.15 * scale * np.random.default_rng(1).standard_normal(trial.outputs.shape)
    noisy = Recording(clean.plant, trial.outputs + noise, trial.disturbance, trial.x0)
    problem = replace(clean, recordings=(noisy,))
    found = fit_controller(problem)
    again = fit_controller(problem, found.weights)
    T, G = natural_coordinates(clean.plant, np.array(controller.K))
    free = fit_gain(problem)
    moved, error = (
        float(np.linalg.norm(np.linalg.solve(G, difference @ T)))
        for difference in (again.gain - found.gain, free.K - controller.K)
    )
    assert found.converged
    assert not found.explained
    assert moved < 0.1 * error
    # The reported gain is at the minimum over the identified directions: a Gauss-Newton step along
    # them would lower chi-squared by less than 0.1.
    printed = gain_estimate(found)
    at = printed.problem, np.array(printed.K), np.array(printed.S)
    here, linear = evaluate(*at), gain_covariance(*at)
    T, G = natural_coordinates(clean.plant, np.array(printed.K))
    on_gain = here.dK.reshape(len(here.residual), -1) @ np.kron(G, np.linalg.inv(T).T)
    along = on_gain @ linear.directions[linear.identified].T
    step = along @ np.linalg.lstsq(along, here.residual)[0]
    assert step @ step < 0.1 * printed.misfit**2 / len(here.residual)


@pytest.mark.parametrize(
    "seed", [49, *(pytest.param(seed, marks=pytest.mark.full) for seed in (82, 89, 92))]
)
def test_a_start_at_the_edge_of_what_weights_can_have(seed: int) -> None:
    """Regression: two fits failed at the start's program; two were 4 and 7 % above the truth."""
    assert short_of_truth(*random_recording(seed, 3, 90.0)) < 1


@pytest.mark.parametrize(
    ("m", "seed"),
    [
        (2, 76),
        pytest.param(2, 88, marks=pytest.mark.full),
        pytest.param(2, 59, marks=pytest.mark.full),
        pytest.param(3, 55, marks=pytest.mark.full),
        pytest.param(3, 24, marks=pytest.mark.slow),
    ],
)
def test_a_noisy_fit_leaves_the_local_minimum_of_its_start(m: int, seed: int) -> None:
    """Regression: these ended 1.4 to 29 % above the misfit of the truth."""
    assert short_of_truth(*random_recording(seed, m, 90.0)) < 1
