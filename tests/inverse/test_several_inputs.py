"""Problems with two and three inputs: simulated weights reproduce the recordings."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import impc
from experiments.misfit_ceiling import short_of_truth
from experiments.printed_intervals import carts, fit, noisy_recording, random_recording
from experiments.printed_intervals import regulator as cart_regulator
from impc.assess.bounded_weights import weights_set
from impc.assess.covariance import gain_covariance
from impc.assess.printed_gain import gain_estimate
from impc.control.closed_loop import simulate
from impc.inverse.explaining_weights import weights_behind
from impc.inverse.inactive_samples import pair_of_inactive_samples
from impc.inverse.laws import GainLaw
from impc.inverse.metric_family import metric_family
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.search import fit_gain, refine_gain
from impc.inverse.solution_set import natural_coordinates
from impc.inverse.table31 import inverse_mpc_reduced
from impc.inverse.unknowns import Unknowns
from tests.support import extrapolated_jacobian, plant_of, posed, random_problem, regulator, slopes

FULL, SLOW = pytest.mark.full, pytest.mark.slow
# Largest misfit of reported weights relative to the recorded outputs.
REPRODUCED = 1e-7
PATHS: dict[str, Callable[[impc.Problem], impc.Estimate]] = {
    "fit": fit_controller,
    "reduced": inverse_mpc_reduced,
    "direct": lambda problem: impc.table_3_1(problem)["inverse_mpc"],
}


def missed(problem: impc.Problem, weights: impc.Weights) -> float:
    """Relative misfit of the controller built from the reported weights."""
    plant, (trial,) = problem.plant, problem.recordings
    kept = bool(problem.terminal_set)
    law = impc.Controller(plant, weights, problem.bounds, problem.horizon, terminal_set=kept)
    run = simulate(law, impc.scenario(plant, trial.x0, disturbance=trial.disturbance[:-1]))
    scale = np.asarray(problem.output_scale)
    error = (run.x @ plant.C.T - trial.outputs) / scale
    return float(np.linalg.norm(error) / np.linalg.norm(trial.outputs / scale))


def outcomes(path: str, m: int, seeds: range) -> dict[int, str]:
    """For problems that are not reproduced: "said so", or the misfit without a warning."""
    outcome = {}
    for seed in seeds:
        _, problem = random_problem(seed, m)
        try:
            found = PATHS[path](problem)
        except impc.ImpcError as error:
            outcome[seed] = f"said so: {error}"
            continue
        assert path != "reduced" or found.explained == (not found.reason)
        miss = missed(problem, found.stage_weights)
        if miss > REPRODUCED:
            outcome[seed] = f"missed by {miss:.2g}" if found.explained else "said so"
    return outcome


@pytest.mark.parametrize(
    ("path", "m", "seeds"),
    [
        # Seeds 0 to 4 had a misfit of 0.1 to 60 % and were reported as exact.
        ("fit", 2, range(5)),
        ("reduced", 2, range(5)),
        pytest.param("fit", 3, range(5), marks=FULL),
        pytest.param("reduced", 3, range(5), marks=FULL),
        # Seeds 2 and 8 converged to misfits of 8e-5 and 3e-5.
        pytest.param("direct", 2, range(2, 3), marks=SLOW),
        pytest.param("direct", 2, range(8, 9), marks=SLOW),
        pytest.param("direct", 3, range(1, 2), marks=FULL),
        # The last two started at an eigenvalue of -1e-9 and raised a WeightsError.
        pytest.param("direct", 2, range(96, 97), marks=FULL),
        ("direct", 3, range(70, 71)),
    ],
)
def test_reported_weights_reproduce_the_recording(path: str, m: int, seeds: range) -> None:
    assert outcomes(path, m, seeds) == {}


@pytest.mark.slow
@pytest.mark.parametrize("m", [2, 3])
@pytest.mark.parametrize("path", sorted(PATHS))
def test_ninety_nine_in_a_hundred_are_reproduced_and_no_miss_is_silent(path: str, m: int) -> None:
    found = outcomes(path, m, range(300))
    print(path, m, found)
    assert all(text.startswith("said so") for text in found.values())
    assert len(found) <= 3


@pytest.mark.parametrize(("m", "seed"), [(2, 3), (3, 2)])
def test_metric_is_kept_along_what_is_told_of_it(m: int, seed: int) -> None:
    """The recording leaves more than one S; consistency with K determines the rest."""
    controller, problem = random_problem(seed, m)
    found = refine_gain(problem, np.array(controller.K), np.array(controller.S))
    assert found.explained
    metrics = weights_behind(found).metrics
    assert len(metrics) == 1
    space = Unknowns(problem, GainLaw(problem, found.K, found.S))
    seen = space.evaluated(space.start)[0].parts(problem)[0][:, found.K.size :]
    values = np.linalg.svd(seen, compute_uv=False)
    assert np.count_nonzero(values > 1e-12 * values[0]) < m * (m + 1) // 2 - 1
    kept = impc.gain_fibre(problem.plant, controller.K, metrics)
    for one in (impc.least_condition_weights(kept), impc.other_weights(kept, 1)[0]):
        assert missed(problem, one.weights) < 1e-6
    free = impc.gain_fibre(problem.plant, controller.K)
    assert missed(problem, impc.least_condition_weights(free).weights) > 1e-3


def test_set_of_weights_has_the_metric_in_it() -> None:
    _, problem = random_problem(0, 2)
    fitted, (n, m) = fit_controller(problem), (problem.plant.n, problem.plant.m)
    assert len(fitted.metrics) == 1
    numbers = n * (n + 1) // 2 + m * (m + 1) // 2
    fibre = impc.gain_fibre(problem.plant, np.array(fitted.gain), np.array(fitted.metrics))
    # n m + m - 1 directions are identified; one further is the scale.
    assert len(weights_set(fibre).level) == numbers - (n * m + m - 1) - 1


def test_fibre_of_a_metric_in_a_span() -> None:
    """R + B'PB of every member is in the span; the span of all metrics is no restriction."""
    controller, problem = random_problem(2, 3)
    plant, K = problem.plant, controller.K
    pair = np.array([controller.S, np.diag([1.0, 0.0, 0.0])])
    fibre, span = impc.gain_fibre(plant, K, pair), pair.reshape(2, -1).T
    for one in (impc.least_condition_weights(fibre), *impc.other_weights(fibre, 2)):
        S = impc.solve_lqr(plant, one.weights).S.ravel()
        left = S - span @ np.linalg.lstsq(span, S)[0]
        assert np.linalg.norm(left) < 1e-8 * np.linalg.norm(S)
    every = np.array([np.outer(a, b) + np.outer(b, a) for a in np.eye(3) for b in np.eye(3)])
    assert impc.gain_fibre(plant, K, every).dimension == impc.gain_fibre(plant, K).dimension


def test_a_step_at_which_the_solver_breaks_off_is_tried_shorter() -> None:
    """Regression: Clarabel panics here on eigenvalues that LAPACK does not find."""
    controller = cart_regulator(carts(2))
    found = fit(controller, noisy_recording(controller, 111, 90.0, 0.0))
    assert found.converged
    assert found.misfit <= 1.05 * found.noise


def asymmetry(plant: impc.Plant, gain: np.ndarray, metric: np.ndarray) -> float:
    """Relative asymmetry of S K A^-1 B, which is B'PB for a pair of weights."""
    product = metric @ gain @ np.linalg.solve(plant.A, plant.B)
    return float(np.linalg.norm(product - product.T) / np.linalg.norm(product))


# At (3, 5) the inputs outnumber the states.
@pytest.mark.parametrize(("m", "seed"), [(2, 1), (2, 4), (3, 0), (3, 4), (3, 5)])
def test_the_family_of_metrics_is_that_of_weights(m: int, seed: int) -> None:
    """Every member is consistent with the gain, and the true metric is a member."""
    controller, problem = random_problem(seed, m)
    K, S = np.array(controller.K), np.array(controller.S)
    family = metric_family(problem.plant, K)
    assert family is not None
    rng = np.random.default_rng(seed)
    for _ in range(5):
        assert asymmetry(problem.plant, K, family.metric(rng.standard_normal(family.count))) < 1e-9
    np.testing.assert_allclose(family.metric(family.nearest(S)), S, rtol=1e-7, atol=1e-9)
    z = 0.3 * rng.standard_normal(family.count)
    found = np.reshape(family.changes(z), (family.count, -1)).T
    expected = extrapolated_jacobian(family.metric, z)
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-9)


# At (2, 12) inactive samples are a third of all; at (3, 5) inputs outnumber states.
@pytest.mark.parametrize(("m", "seed"), [(2, 4), (2, 12), (3, 5), (3, 40), (3, 67), (3, 89)])
def test_inactive_samples_determine_the_gain(m: int, seed: int) -> None:
    controller, problem = random_problem(seed, m)
    found = pair_of_inactive_samples(problem)
    assert found is not None
    truth = problem.plant.B @ controller.K
    assert np.max(np.abs(problem.plant.B @ found[0] - truth)) < 1e-7 * np.max(np.abs(truth))


@pytest.mark.parametrize("B", [[[0, 0], [1, 2]], [[0, 0], [1, 1]]])
@pytest.mark.parametrize("method", ["inverse_mpc", "inverse_mpc_reduced"])
def test_two_motors_of_one_joint(method: str, B: list[list[float]]) -> None:
    """The split between parallel inputs is a convention: Q = I and R = I explain all."""
    plant = plant_of([[1, 0.1], [0.2, 1]], B)
    law = regulator(plant, np.eye(2), 0.3, 10, np.eye(2), terminal_set=True)
    rng = np.random.default_rng(0)
    starts = [rng.uniform(-0.5, 0.5, 2) for _ in range(4)]
    trials = [impc.Recording(plant, law.simulate(x0, 40).x) for x0 in starts]
    found = impc.fit(posed(law, *trials), method)
    assert found.explained
    np.testing.assert_allclose(found.stage_weights.block, np.eye(4), atol=1e-4)


@pytest.mark.parametrize(("m", "seed"), [(2, 1), (3, 4)])
def test_coordinates_know_how_gain_and_metric_change(m: int, seed: int) -> None:
    controller, problem = random_problem(seed, m)
    space = Unknowns(problem, GainLaw(problem, np.array(controller.K), np.array(controller.S)))
    z = space.start + 0.1 * np.random.default_rng(seed).standard_normal(len(space.start))

    def point(z: np.ndarray) -> np.ndarray:
        moved = space.unpack(z)
        return np.concatenate([moved.K.ravel(), m * moved.S.ravel() / np.trace(moved.S)])

    found = np.hstack([np.reshape(part, (len(z), -1)) for part in space.changes(z)]).T
    np.testing.assert_allclose(found, extrapolated_jacobian(point, z), rtol=1e-7, atol=1e-8)


def test_weights_at_the_edge_of_those_that_a_program_finds() -> None:
    """Margin below 1e-9: known members are recovered, none is invented without one."""
    plant = random_problem(2, 2)[1].plant
    thin = impc.Weights(np.diag([1e-11, 1.0, 1.0, 1.0]), np.eye(2))
    solution = impc.solve_lqr(plant, thin)
    found = impc.least_condition_weights(impc.gain_fibre(plant, solution.K, solution.S), thin)
    assert found.gain_error < 1e-8


@pytest.mark.full
def test_a_noisy_fit_stays_where_it_ended() -> None:
    """Regression: restarted at its own solution, the gain moved by a fifth of its error."""
    controller, clean = random_problem(1, 2)
    (trial,) = clean.recordings
    scale = np.asarray(clean.output_scale)
    noise = 0.15 * scale * np.random.default_rng(1).standard_normal(trial.outputs.shape)
    noisy = impc.Recording(clean.plant, trial.outputs + noise, trial.disturbance, trial.x0)
    problem = impc.replace(clean, recordings=(noisy,))
    found = fit_controller(problem)
    again, free = fit_controller(problem, found.weights), fit_gain(problem)
    T, G = natural_coordinates(clean.plant, np.array(controller.K))
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
    (residual, on_entries, *_), linear = slopes(*at), gain_covariance(*at)
    T, G = natural_coordinates(clean.plant, np.array(printed.K))
    on_gain = on_entries @ np.kron(G, np.linalg.inv(T).T)
    along = on_gain @ linear.directions[linear.identified].T
    step = along @ np.linalg.lstsq(along, residual)[0]
    assert step @ step < 0.1 * printed.misfit**2 / len(residual)


@pytest.mark.parametrize(
    ("m", "seed"),
    [
        # Starts at the edge of the set of weights: two fits failed at the start's program; two
        # were 4 and 7 % above the truth.
        (3, 49),
        *(pytest.param(3, seed, marks=FULL) for seed in (82, 89, 92)),
        # Local minima of their starts, 1.4 to 29 % above the misfit of the truth.
        (2, 76),
        pytest.param(2, 88, marks=FULL),
        pytest.param(2, 59, marks=FULL),
        pytest.param(3, 55, marks=FULL),
        pytest.param(3, 24, marks=SLOW),
    ],
)
def test_a_noisy_fit_reaches_the_misfit_of_the_truth(m: int, seed: int) -> None:
    assert short_of_truth(*random_recording(seed, m, 90.0)) < 1
