"""Fits with unknown initial states and parameters, with and without noise."""

from __future__ import annotations

import functools

import control
import numpy as np
import pytest

import impc
import plants
from experiments.benchmarks.workloads import Workload, seat
from experiments.simulated_subjects import simulated_subject
from impc.assess.assessments import evaluate_method
from impc.assess.covariance import gain_covariance
from impc.assess.printed_gain import gain_estimate
from impc.control.closed_loop import simulate
from impc.inverse.laws import GainLaw
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.search import fit_gain, with_fitted_starts
from impc.inverse.unknowns import Unknowns
from impc.model.plant_family import plant_at, plant_differential
from impc.model.riccati import stabilises
from impc.output_feedback.simulation import simulate_person
from tests.support import differences, posed, slopes

FULL = pytest.mark.full
TRUTH = plants.SeatedBalanceParameters()
# At 4.5 Nm clipped LQR diverges, and a search takes ten times as long.
limits = pytest.mark.parametrize(
    "limit", [6.0, *(pytest.param(one, marks=FULL) for one in (70.0, 4.5))]
)


@functools.cache
def clean(limit: float, trials: int = 2) -> tuple[Workload, impc.Problem]:
    work = seat(trials, 30.0, limit)
    plant = work.problem.plant
    recordings = [impc.Recording(plant, t.outputs, t.disturbance) for t in work.problem.recordings]
    return work, impc.fit_problem(plant, recordings, impc.FitSettings(u_max=limit))


@functools.cache
def fitted(limit: float, trials: int = 2) -> impc.Estimate:
    return fit_controller(clean(limit, trials)[1])


def explained(found: impc.Estimate) -> float:
    samples = sum(trial.outputs.size for trial in found.problem.recordings)
    return 1 - found.misfit**2 / samples


@limits
def test_without_noise_all_that_is_determined_comes_out(limit: float) -> None:
    """VAF above 99.999 %, and the gain to 1e-5 along every identified direction."""
    found, truth = fitted(limit), np.array(clean(limit)[0].controller.K)
    assert found.explained
    assert explained(found) > 0.99999
    covariance = gain_estimate(found).covariance
    determined = covariance.singular_values > 1e-6 * covariance.singular_values[0]
    error = covariance.along(found.gain - truth)
    assert np.count_nonzero(determined) >= 9
    assert np.max(np.abs(error[determined])) <= 1e-5 * np.linalg.norm(truth @ covariance.T)


@limits
def test_inverse_mpc_against_inverse_lqr(limit: float) -> None:
    """Inverse MPC fits better and keeps the limit if the subject saturates; else equal."""
    mpc = fitted(limit)
    unbounded = ("feedback_gain", "inverse_lqr", "inverse_lqr_output")
    found = {name: impc.fit(mpc.problem, name, start=mpc) for name in (*unbounded, "clipped_lqr")}
    methods = {
        name: evaluate_method(one, mpc.problem.bounds)
        for name, one in (found | {"inverse_mpc": mpc}).items()
    }
    best = methods["inverse_mpc"]
    assert best.keeps_bounds
    for name in unbounded:
        if limit == 70.0:
            np.testing.assert_allclose(methods[name].vaf, best.vaf, atol=1e-6)
        else:
            assert np.all(methods[name].vaf < best.vaf - 0.1)
            assert not methods[name].keeps_bounds
    fell = [time for time in methods["clipped_lqr"].fell if time is not None]
    assert bool(fell) == (limit == 4.5)
    assert best.fell == (None,) * 2


@pytest.mark.full
@pytest.mark.parametrize("count", [1, 3])
def test_noisy_subjects_reach_the_ceiling_within_their_deviations(count: int) -> None:
    """Seeds 0 to 2 at 6 Nm (experiments/simulated_subjects has a hundred)."""
    subjects = [simulated_subject(seed, 6.0) for seed in range(count)]
    assert max(item.below_ceiling for item in subjects) < 0.5
    assert np.mean([np.abs(item.entries) <= 3 for item in subjects]) >= 0.97


@pytest.mark.slow
@pytest.mark.parametrize("limit", [70.0, 6.0, 4.5])
def test_a_hundred_noisy_subjects(limit: float) -> None:
    """Seeds 0 to 99: within 0.5 points of the ceiling; all entries covered for 97 of 100."""
    subjects = [simulated_subject(seed, limit) for seed in range(100)]
    assert max(item.below_ceiling for item in subjects) < 0.5
    inside = np.array([np.abs(item.entries) <= 3 for item in subjects])
    assert np.all(np.mean(inside, axis=0) >= 0.97)


def test_initial_states_are_found() -> None:
    """True controller, initial guess at rest: found to the rounding of a short trial."""
    work, _ = clean(6.0, 1)
    controller, plant = work.controller, work.problem.plant
    x = simulate(controller, work.drives[0]).x
    x0 = x[500 + np.random.default_rng(7).integers(100)]
    drive = impc.scenario(plant, x0, disturbance=work.drives[0].disturbance[500:1500])
    run = simulate(controller, drive)
    trial = impc.Recording(plant, run.x @ plant.C.T, np.vstack([drive.disturbance, [[0.0]]]))
    problem = impc.replace(work.problem, recordings=(trial,), unknown_start=True)
    (found,) = with_fitted_starts(
        problem, np.array(controller.K), np.array(controller.S)
    ).recordings
    size = np.sqrt(np.mean(x**2, axis=0))
    np.testing.assert_allclose(found.x0[:4], x0[:4], atol=1e-6 * float(np.max(size[:4])))
    seen = simulate(controller, impc.scenario(plant, found.x0, disturbance=drive.disturbance))
    np.testing.assert_allclose(seen.x @ plant.C.T, trial.outputs, atol=1e-8)


@functools.cache
def seat_family() -> tuple[impc.Problem, impc.PlantFamily, np.ndarray]:
    """Unknown moment of inertia and muscle time constant, nominal values 20 % off; the gain."""
    work, problem = clean(6.0)

    def make(values: np.ndarray) -> impc.Plant:
        changed = impc.replace(TRUTH, J2=float(values[0]), tau_m=float(values[1]))
        return impc.Plant(plants.seated_balance_plant(changed), ["command"])

    family = impc.PlantFamily(make, ["J2", "tau_m"], [1.2 * TRUTH.J2, 0.8 * TRUTH.tau_m])
    nominal = plant_at(family, np.zeros(2))
    asked = impc.replace(problem, plant=nominal, family=family, logarithms=np.zeros(2))
    return asked, family, np.array(work.controller.K)


def test_plant_differential_equals_differences() -> None:
    _, family, _ = seat_family()
    here = np.array([0.05, -0.1])
    exact = plant_differential(family, here)
    for name in ("A", "B", "E", "C"):
        found = getattr(exact, name)

        def matrix(q: np.ndarray, name: str = name) -> np.ndarray:
            return np.asarray(getattr(plant_at(family, q), name))

        rough = differences(matrix, here, 1e-5)
        for index in range(2):
            scale = max(1.0, float(np.max(np.abs(rough[:, index]))))
            np.testing.assert_allclose(
                found[..., index].ravel(), rough[:, index], atol=1e-7 * scale
            )


def test_every_column_of_the_search_equals_differences() -> None:
    """Gain, initial states and parameters together, in the coordinates of the search."""
    problem, _, K = seat_family()
    space = Unknowns(problem, GainLaw(problem, K, np.eye(1)))
    rng = np.random.default_rng(3)
    z = space.start + 0.02 * rng.standard_normal(len(space.start))
    # Compression rotates the residual and keeps its norm: compare gradients of its square.
    gradient = space.at(z).jacobian.T @ space.at(z).residual
    chosen = [*rng.choice(len(z), 12, replace=False).tolist(), len(z) - 1, len(z) - 2]
    along = np.eye(len(z))[chosen]
    (rough,) = differences(
        lambda t: np.sum(space.at(z + t @ along).residual ** 2) / 2, np.zeros(len(chosen))
    )
    size = 1e-5 * np.max(np.abs(gradient))
    assert rough == pytest.approx(gradient[chosen], rel=2e-5, abs=size)


@pytest.mark.full
def test_physical_parameters_are_found_with_the_gain() -> None:
    problem, family, _ = seat_family()
    found = fit_controller(problem)
    values = family.nominal * np.exp(found.problem.logarithms)
    np.testing.assert_allclose(values, [TRUTH.J2, TRUTH.tau_m], rtol=1e-5)
    assert explained(found) > 0.99999


def test_an_evaluation_knows_what_a_problem_lacks() -> None:
    problem, _, K = seat_family()
    residual, on_gain, on_parameters, own = slopes(problem, K, np.eye(1))
    assert own.shape == (len(residual), 10)
    assert on_parameters.shape == (len(residual), 2)
    known = impc.replace(problem, unknown_start=False, family=None, logarithms=np.zeros(0))
    other = slopes(known, K, np.eye(1))
    assert other[3].shape == (len(residual), 0)
    np.testing.assert_array_equal(other[1], on_gain)
    there = problem.at(np.ones((2, 10)), np.array([0.1, 0.0]))
    assert [trial.x0.tolist() for trial in there.recordings] == np.ones((2, 10)).tolist()
    assert not np.array_equal(there.plant.A, problem.plant.A)


@pytest.mark.full
def test_standard_deviations_of_a_linear_model_are_those_of_theory() -> None:
    """White noise, no bounds: the sandwich equals sigma^2 (J'J)^-1 of the full problem."""
    work, problem = clean(70.0, 1)
    (trial,), K = problem.recordings, np.array(work.controller.K)
    white = np.random.default_rng(11).standard_normal(trial.outputs.shape)
    noisy = trial.outputs + 1e-6 * problem.output_scale * white
    here = impc.replace(problem, recordings=(impc.replace(trial, outputs=noisy),))
    covariance = gain_covariance(here, K, np.array(fitted(70.0, 1).metric))
    _, on_gain, _, own = slopes(here, K, np.eye(1))
    J = np.hstack([on_gain, own])
    scale = np.linalg.norm(J, axis=0)
    inverse = np.linalg.pinv((J / scale).T @ (J / scale), rcond=1e-15)
    theory = 1e-6 * np.sqrt(np.diag(inverse)) / scale
    usable = np.isfinite(covariance.entries[0])
    assert np.count_nonzero(usable) > 0
    np.testing.assert_allclose(covariance.entries[0][usable], theory[:10][usable], rtol=0.1)


def test_weights_are_found_where_the_free_gain_is_unstable() -> None:
    """Without bounds and with strong noise in the loop the free gain need not stabilise."""
    pole = control.ss([[0, 1], [9.0, 0]], [[0], [1]], [[1, 0]], 0, states=["x", "v"], inputs=["u"])
    plant = impc.Plant(control.c2d(pole, 0.02), ["u"])
    law = impc.Controller.from_gain(plant, [[30.0, 7.0]], impc.Bounds(plant), 5, terminal_set=False)
    y = simulate_person(law, impc.Observer(plant, motor=4.0), steps=600).outputs
    problem = posed(law, impc.Recording(plant, y), terminal_set=False, unknown_start=True)
    assert not fit_gain(problem).stabilises
    assert stabilises(plant, np.array(impc.fit(problem).gain))
