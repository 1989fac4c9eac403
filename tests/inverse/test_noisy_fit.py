"""Fits with unknown initial states and parameters, with and without noise."""

from __future__ import annotations

import control
import numpy as np
import pytest

import plants
from experiments.benchmarks.workloads import Workload, seat
from experiments.simulated_subjects import simulated_subject
from impc.assess.assessments import evaluate_method
from impc.assess.covariance import gain_covariance
from impc.assess.printed_gain import gain_estimate
from impc.checking import replace
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.simulation import scenario
from impc.inverse.estimates import Estimate
from impc.inverse.laws import GainLaw
from impc.inverse.methods import fit
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.problem import Problem
from impc.inverse.residuals import evaluate
from impc.inverse.search import fit_gain, with_fitted_starts
from impc.inverse.unknowns import Unknowns
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.plant_family import PlantFamily, plant_at, plant_differential
from impc.model.recordings import Recording
from impc.model.riccati import stabilises
from impc.output_feedback.observer import Observer
from impc.output_feedback.simulation import simulate_person
from impc.studies.fit.settings import FitSettings
from impc.studies.fit.subject import fit_problem

OURS = "inverse_mpc"


def clean_problem(limit: float, trials: int = 2) -> tuple[Workload, Problem]:
    work = seat(trials, 30.0, limit)
    plant = work.problem.plant
    recordings = [Recording(plant, t.outputs, t.disturbance) for t in work.problem.recordings]
    return work, fit_problem(plant, recordings, FitSettings(u_max=limit))


# At 4.5 Nm clipped LQR diverges, and a search takes ten times as long.
LIMITS = [6.0, *(pytest.param(one, marks=pytest.mark.full) for one in (70.0, 4.5))]


@pytest.fixture(scope="module", params=LIMITS, ids="{}Nm".format)
def clean(request: pytest.FixtureRequest) -> tuple[Workload, Estimate]:
    work, problem = clean_problem(request.param)
    return work, fit_controller(problem)


def test_without_noise_all_that_is_determined_comes_out(
    clean: tuple[Workload, Estimate],
) -> None:
    """VAF above 99.999 %, and the gain to 1e-5 along every identified direction."""
    work, fitted = clean
    samples = sum(trial.outputs.size for trial in work.problem.recordings)
    assert fitted.explained
    assert 1 - fitted.misfit**2 / samples > 0.99999
    covariance = gain_estimate(fitted).covariance
    determined = covariance.singular_values > 1e-6 * covariance.singular_values[0]
    truth = np.array(work.controller.K)
    error = covariance.along(fitted.gain - truth)
    size = np.linalg.norm(truth @ covariance.T)
    assert np.count_nonzero(determined) >= 9
    assert np.max(np.abs(error[determined])) <= 1e-5 * size


def test_inverse_mpc_against_inverse_lqr(clean: tuple[Workload, Estimate]) -> None:
    """Inverse MPC fits better and keeps the limit if the subject saturates; else equal."""
    work, fitted = clean
    names = ("feedback_gain", "inverse_lqr", "inverse_lqr_output", "clipped_lqr", OURS)
    bounds = fitted.problem.bounds
    found = {name: fit(fitted.problem, name, start=fitted) for name in names[:-1]} | {OURS: fitted}
    methods = {name: evaluate_method(item, bounds) for name, item in found.items()}
    mpc = methods["inverse_mpc"]
    limit = float(work.controller.bounds.u_max[0])
    assert mpc.keeps_bounds
    for name in ("feedback_gain", "inverse_lqr", "inverse_lqr_output"):
        if limit == 70.0:
            np.testing.assert_allclose(methods[name].vaf, mpc.vaf, atol=1e-6)
        else:
            assert np.all(methods[name].vaf < mpc.vaf - 0.1)
            assert not methods[name].keeps_bounds
    fell = [time for time in methods["clipped_lqr"].fell if time is not None]
    assert bool(fell) == (limit == 4.5)
    assert mpc.fell == (None,) * 2


@pytest.mark.full
@pytest.mark.parametrize("count", [1, 3])
def test_noisy_subjects_reach_the_ceiling_within_their_deviations(count: int) -> None:
    """Seeds 0 to 2 at 6 Nm (experiments/simulated_subjects has a hundred)."""
    subjects = [simulated_subject(seed, 6.0) for seed in range(count)]
    assert max(item.below_ceiling for item in subjects) < 0.5
    inside = [np.abs(item.entries) <= 3 for item in subjects]
    assert np.mean(inside) >= 0.97


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
    work, _ = clean_problem(6.0, 1)
    controller, plant = work.controller, work.problem.plant
    rng = np.random.default_rng(7)
    x = simulate(controller, work.drives[0]).x
    x0 = x[500 + rng.integers(100)]
    drive = scenario(plant, x0, disturbance=work.drives[0].disturbance[500:1500])
    run = simulate(controller, drive)
    trial = Recording(plant, run.x @ plant.C.T, np.vstack([drive.disturbance, [[0.0]]]))
    problem = replace(work.problem, recordings=(trial,), unknown_start=True)
    K, S = np.array(controller.K), np.array(controller.S)
    (found,) = with_fitted_starts(problem, K, S).recordings
    size = np.sqrt(np.mean(x**2, axis=0))
    np.testing.assert_allclose(found.x0[:4], x0[:4], atol=1e-6 * float(np.max(size[:4])))
    seen = simulate(controller, scenario(plant, found.x0, disturbance=drive.disturbance))
    np.testing.assert_allclose(seen.x @ plant.C.T, trial.outputs, atol=1e-8)


def seat_family() -> tuple[Problem, Workload]:
    """Unknown moment of inertia and muscle time constant, nominal values 20 % off."""
    work, problem = clean_problem(6.0, 2)
    truth = plants.SeatedBalanceParameters()

    def make(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]):  # type: ignore[no-untyped-def]
        changed = replace(truth, J2=float(values[0]), tau_m=float(values[1]))
        return Plant(plants.seated_balance_plant(changed), ["command"])

    family = PlantFamily(make, ["J2", "tau_m"], [1.2 * truth.J2, 0.8 * truth.tau_m])
    start = plant_at(family, np.zeros(2))
    return replace(problem, plant=start, family=family, logarithms=np.zeros(2)), work


def test_plant_differential_equals_differences() -> None:
    problem, _ = seat_family()
    assert problem.family is not None
    here = np.array([0.05, -0.1])
    exact = plant_differential(problem.family, here)
    for index in range(2):
        step = np.zeros(2)
        step[index] = 1e-5
        ahead, behind = (plant_at(problem.family, here + sign * step) for sign in (1, -1))
        for name in ("A", "B", "E", "C"):
            rough = (getattr(ahead, name) - getattr(behind, name)) / 2e-5
            scale = max(1.0, float(np.max(np.abs(rough))))
            np.testing.assert_allclose(getattr(exact, name)[..., index], rough, atol=1e-7 * scale)


def test_every_column_of_the_search_equals_differences() -> None:
    """Gain, initial states and parameters together, in the coordinates of the search."""
    problem, work = seat_family()
    space = Unknowns(problem, GainLaw(problem, np.array(work.controller.K), np.eye(1)))
    rng = np.random.default_rng(3)
    z = space.start + 0.02 * rng.standard_normal(len(space.start))
    # Compression rotates the residual and keeps its norm: compare gradients of its square.
    gradient = space.at(z).jacobian.T @ space.at(z).residual
    for index in [*rng.choice(len(z), 12, replace=False).tolist(), len(z) - 1, len(z) - 2]:
        step = np.zeros(len(z))
        step[index] = 1e-6
        ahead, behind = (np.sum(space.at(z + sign * step).residual ** 2) / 2 for sign in (1, -1))
        rough = (ahead - behind) / 2e-6
        assert rough == pytest.approx(
            gradient[index], rel=2e-5, abs=1e-5 * np.max(np.abs(gradient))
        )


@pytest.mark.full
def test_physical_parameters_are_found_with_the_gain() -> None:
    problem, work = seat_family()
    fitted = fit_controller(problem)
    truth = plants.SeatedBalanceParameters()
    assert problem.family is not None
    found = problem.family.nominal * np.exp(fitted.problem.logarithms)
    np.testing.assert_allclose(found, [truth.J2, truth.tau_m], rtol=1e-5)
    samples = sum(trial.outputs.size for trial in work.problem.recordings)
    assert 1 - fitted.misfit**2 / samples > 0.99999


def test_an_evaluation_knows_what_a_problem_lacks() -> None:
    problem, work = seat_family()
    found = evaluate(problem, np.array(work.controller.K), np.eye(1))
    assert found.own.shape == (len(found.residual), 10)
    assert found.dparameters.shape == (len(found.residual), 2)
    known = replace(problem, unknown_start=False, family=None, logarithms=np.zeros(0))
    other = evaluate(known, np.array(work.controller.K), np.eye(1))
    assert other.own.shape == (len(found.residual), 0)
    np.testing.assert_array_equal(other.dK, found.dK)


def test_moved_changes_starts_and_plant() -> None:
    problem, _ = seat_family()
    starts = np.ones((2, 10))
    there = problem.at(starts, np.array([0.1, 0.0]))
    assert [trial.x0.tolist() for trial in there.recordings] == starts.tolist()
    assert not np.array_equal(there.plant.A, problem.plant.A)


@pytest.mark.full
def test_standard_deviations_of_a_linear_model_are_those_of_theory() -> None:
    """White noise, no bounds: the sandwich equals sigma^2 (J'J)^-1 of the full problem."""
    subject_noise = 1e-6
    work, problem = clean_problem(70.0, 1)
    rng = np.random.default_rng(11)
    trial = problem.recordings[0]
    noisy = trial.outputs + subject_noise * problem.output_scale * rng.standard_normal(
        trial.outputs.shape
    )
    here = replace(problem, recordings=(replace(trial, outputs=noisy),))
    K = np.array(work.controller.K)
    covariance = gain_covariance(here, K, np.array(fit_controller(problem).metric))
    found = evaluate(here, K, np.eye(1))
    J = np.hstack([found.dK.reshape(len(found.residual), -1), found.own])
    scale = np.linalg.norm(J, axis=0)
    inverse = np.linalg.pinv((J / scale).T @ (J / scale), rcond=1e-15)
    theory = subject_noise * np.sqrt(np.diag(inverse)) / scale
    usable = np.isfinite(covariance.entries[0])
    assert np.count_nonzero(usable) > 0
    np.testing.assert_allclose(covariance.entries[0][usable], theory[:10][usable], rtol=0.1)


def test_weights_are_found_where_the_free_gain_is_unstable() -> None:
    """Without bounds and with strong noise in the loop the free gain need not stabilise."""
    pole = control.ss([[0, 1], [9.0, 0]], [[0], [1]], [[1, 0]], 0, states=["x", "v"], inputs=["u"])
    plant = Plant(control.c2d(pole, 0.02), ["u"])
    law = Controller.from_gain(plant, [[30.0, 7.0]], Bounds(plant), 5, terminal_set=False)
    y = simulate_person(law, Observer(plant, motor=4.0), steps=600).outputs
    trial = Recording(plant, y)
    problem = Problem(plant, Bounds(plant), 5, (trial,), terminal_set=False, unknown_start=True)
    assert not fit_gain(problem).stabilises
    assert stabilises(plant, np.array(fit(problem).gain))
