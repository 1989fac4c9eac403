"""Fits with unknown initial states and parameters, with and without noise."""

from __future__ import annotations

import functools
import tracemalloc
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import control
import numpy as np
import pytest
import scipy.optimize
import scipy.signal

import impc
import plants
from experiments.benchmarks.workloads import Workload, seat
from experiments.coverage import cart, true_controller
from experiments.simulated_subjects import simulated_subject
from experiments.two_link_standing import GAIN, standing_problem
from impc.assess.assessments import evaluate_method
from impc.assess.covariance import gain_covariance
from impc.assess.printed_gain import gain_estimate
from impc.control.closed_loop import simulate
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.search import fit_gain, refine_gain, with_fitted_starts
from impc.model.riccati import stabilises
from impc.output_feedback.simulation import simulate_person
from impc.studies.fit.result import shown_trials
from tests.support import posed

FULL, SLOW = pytest.mark.full, pytest.mark.slow
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
    return 1 - found.misfit**2 / sum(trial.outputs.size for trial in found.problem.recordings)


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
    methods = {name: evaluate_method(one, mpc.problem.bounds) for name, one in found.items()}
    best = evaluate_method(mpc, mpc.problem.bounds)
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


@pytest.mark.parametrize(
    ("limit", "count", "each"),
    [
        pytest.param(6.0, 1, False, marks=FULL),
        pytest.param(6.0, 3, False, marks=FULL),
        *(pytest.param(limit, 100, True, marks=SLOW) for limit in (70.0, 6.0, 4.5)),
    ],
)
def test_noisy_subjects_reach_the_ceiling(limit: float, count: int, each: bool) -> None:
    """Within 0.5 points; 97 % of all entries, or each entry in 97 %, within 3 standard errors."""
    subjects = [simulated_subject(seed, limit) for seed in range(count)]
    assert max(item.below_ceiling for item in subjects) < 0.5
    inside = np.array([np.abs(item.entries) <= 3 for item in subjects])
    assert np.all(np.mean(inside, axis=0 if each else None) >= 0.97)


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


@pytest.mark.full
def test_physical_parameters_are_found_with_the_gain() -> None:
    """Moment of inertia and muscle time constant, nominal values 20 % off."""
    truth = plants.SeatedBalanceParameters()

    def make(values: np.ndarray) -> impc.Plant:
        changed = impc.replace(truth, J2=float(values[0]), tau_m=float(values[1]))
        return impc.Plant(plants.seated_balance_plant(changed), ["command"])

    family = impc.PlantFamily(make, ["J2", "tau_m"], [1.2 * truth.J2, 0.8 * truth.tau_m])
    nominal = {"plant": family.make(family.nominal), "family": family, "logarithms": np.zeros(2)}
    found = fit_controller(impc.replace(clean(6.0)[1], **nominal))
    np.testing.assert_allclose(found.problem.parameters, [truth.J2, truth.tau_m], rtol=1e-5)
    assert explained(found) > 0.99999


def test_weights_are_found_where_the_free_gain_is_unstable() -> None:
    """Without bounds and with strong noise in the loop the free gain need not stabilise."""
    pole = control.ss([[0, 1], [9.0, 0]], [[0], [1]], [[1, 0]], 0, states=["x", "v"], inputs=["u"])
    plant = impc.Plant(control.c2d(pole, 0.02), ["u"])
    law = impc.Controller.from_gain(plant, [[30.0, 7.0]], impc.Bounds(plant), 5, terminal_set=False)
    y = simulate_person(law, impc.Observer(plant, motor=4.0), steps=600).outputs
    problem = posed(law, impc.Recording(plant, y), terminal_set=False, unknown_start=True)
    assert not fit_gain(problem).stabilises
    assert stabilises(plant, np.array(impc.fit(problem).gain))


def least_misfit(problem: impc.Problem, start: np.ndarray) -> float:
    """Least misfit of linear feedback, by another simulator and optimiser."""
    plant, trial = problem.plant, problem.recordings[0]
    drive, scale = np.array(trial.disturbance), np.array(problem.output_scale)

    def residual(unknowns: np.ndarray) -> np.ndarray:
        K, x0 = unknowns[:8].reshape(2, 4) * GAIN, unknowns[8:]
        loop = plant.A - plant.B @ K, plant.E, np.eye(4), np.zeros((4, 1)), 1.0
        x = scipy.signal.dlsim(loop, drive, x0=x0)[2]
        return np.asarray((x - trial.outputs) / scale).ravel()

    begin = np.concatenate([(start / GAIN).ravel(), trial.x0])
    found = scipy.optimize.least_squares(residual, begin, method="lm", xtol=1e-12, ftol=1e-14)
    return float(np.sqrt(2 * found.cost))


@pytest.mark.parametrize(
    ("noisy", "samples"),
    [
        pytest.param(True, 800, marks=FULL),
        pytest.param(False, 4000, marks=SLOW),
        pytest.param(True, 4000, marks=SLOW),
    ],
)
def test_two_links_end_at_the_least_misfit(noisy: bool, samples: int) -> None:
    """A person who stands: fits are at the minimum of the misfit."""
    problem = standing_problem(1, noisy=noisy, samples=samples)
    least = least_misfit(problem, GAIN)
    count = problem.recordings[0].outputs.size
    fitted = impc.fit(problem)
    feedback = impc.fit(problem, "feedback_gain")
    for misfit in (gain_estimate(fitted).misfit, feedback.misfit):
        assert abs(count * ((misfit / least) ** 2 - 1)) < 0.1
    assert fitted.noise <= least * (1 + 0.05 / count)


def test_trials_that_are_explained_least_are_drawn() -> None:
    def shown(explained: list[float]) -> list[int]:
        trials: Any = [SimpleNamespace(vaf=np.full(2, value)) for value in explained]
        return shown_trials(SimpleNamespace(trials=trials))  # type: ignore[arg-type]

    assert shown([90.0, 20.0, 50.0]) == [0, 1, 2]
    explained = np.random.default_rng(0).uniform(0, 100, 500)
    found = shown(explained.tolist())
    assert found == sorted(found)
    assert len(found) == 24
    assert max(explained[found]) == np.sort(explained)[23]


WORK: dict[str, Callable[[impc.Problem], object]] = {
    "search": lambda problem: refine_gain(
        problem, np.array([[1.6, 1.4]]), np.eye(1), max_evaluations=3, prior=2.0
    ),
    "covariance": lambda problem: gain_covariance(problem, np.array([[1.6, 1.4]]), np.eye(1)),
}


@pytest.mark.full
@pytest.mark.parametrize("name", WORK)
def test_memory_grows_as_the_trials_do(name: str) -> None:
    """Three times the trials need about three times the memory, not nine times."""
    law, rng = true_controller(), np.random.default_rng(1)

    def peak(count: int) -> int:
        """Peak memory of numpy, bytes, with short noisy trials and unknown initial states."""
        trials = []
        for _ in range(count):
            push = np.repeat(rng.choice([-0.8, 0.0, 0.8], 6), 10)
            outputs = law.simulate(0.1 * rng.standard_normal(2), disturbance=push).outputs[:60]
            noise = 0.02 * rng.standard_normal((60, 1))
            trials.append(impc.Recording(cart(), outputs + noise, push))
        problem = posed(law, *trials, terminal_set=False, unknown_start=True)
        tracemalloc.start()
        try:
            WORK[name](problem)
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    peak(60)  # warm-up: compiled code and caches do not count
    assert peak(180) < 4.5 * peak(60)
