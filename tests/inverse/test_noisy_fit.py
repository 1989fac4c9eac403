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
import scipy.stats

import impc
from experiments.benchmarks.workloads import Workload, seat
from experiments.coverage import cart, noisy_trial, true_controller
from experiments.simulated_subjects import simulated_subject, standard_errors_from
from impc.assess.assessments import evaluate_method
from impc.assess.covariance import gain_covariance
from impc.assess.printed_gain import gain_estimate
from impc.inverse.cross_check import cross_checked
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.residuals import misfit_or_reason
from impc.inverse.search import fit_gain, refine_gain
from impc.model.continuous_gain import held_gain
from impc.model.riccati import stabilises
from impc.output_feedback.simulation import simulate_person
from impc.studies.fit.result import shown_trials
from tests.support import posed

FULL, SLOW = pytest.mark.full, pytest.mark.slow
# At 4.5 Nm clipped LQR diverges, and a search takes ten times as long.
limits = pytest.mark.parametrize("limit", [70.0, 6.0, pytest.param(4.5, marks=FULL)])


@functools.cache
def clean(limit: float, trials: int = 2) -> tuple[Workload, impc.Problem]:
    work = seat(trials, 30.0, limit)
    plant = work.problem.plant
    recordings = [impc.Recording(plant, t.outputs, t.disturbance) for t in work.problem.recordings]
    return work, impc.fit_problem(plant, recordings, impc.FitSettings(u_max=limit))


@functools.cache
def fitted(limit: float) -> impc.Estimate:
    return fit_controller(clean(limit)[1])


@limits
def test_without_noise_all_that_is_determined_comes_out(limit: float) -> None:
    """VAF above 99.999 %, and the gain to 1e-5 along every identified direction."""
    found, truth = fitted(limit), np.array(clean(limit)[0].controller.K)
    assert found.explained
    assert np.all(found.vaf > 99.999)
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
    """Within 0.5 points; 97 % of shown gains, or each gain in 97 %, within 3 standard errors."""
    subjects = [simulated_subject(seed, limit) for seed in range(count)]
    assert max(item.below_ceiling for item in subjects) < 0.5
    inside = np.array([np.abs(item.entries) <= 3 for item in subjects])
    assert np.all(np.mean(inside, axis=0 if each else None) >= 0.97)


def test_an_interval_without_ends_contains_every_gain() -> None:
    """Of the other, the standard error is 1: the true gain is 1.5 below the centre."""
    half = scipy.stats.norm.ppf(0.975)
    ends = np.array([[2 - half, 2 + half], [-np.inf, np.inf]])
    distances = standard_errors_from(np.array([0.5, 1.0]), ends)
    np.testing.assert_allclose(distances, [1.5, 0.0], rtol=1e-7)


def test_weights_are_found_where_the_free_gain_is_unstable() -> None:
    """Without bounds and with strong noise in the loop the free gain need not stabilise."""
    pole = control.ss([[0, 1], [9.0, 0]], [[0], [1]], [[1, 0]], 0, states=["x", "v"], inputs=["u"])
    plant = impc.Plant(control.c2d(pole, 0.02), ["u"])
    law = impc.Controller.from_gain(plant, [[30.0, 7.0]], impc.Bounds(plant), 5, terminal_set=False)
    y = simulate_person(law, impc.Observer(plant, motor=4.0), steps=600).outputs
    problem = posed(law, impc.Recording(plant, y), terminal_set=False, unknown_start=True)
    assert not fit_gain(problem).stabilises
    assert stabilises(plant, np.array(impc.fit(problem).gain))


#: Torque at ankle and hip per angle and rate (Park, Horak and Kuo 2004), N m/rad and N m s/rad.
GAIN = np.array([[950.0, 175.0, 185.0, 50.0], [45.0, 290.0, 60.0, 26.0]])


def standing_problem(noisy: bool, samples: int) -> impc.Problem:
    """A linear body of two links for 20 s on a platform that moves by a sum of sines.

    All states are measured with noise of 0.25 degrees; if `noisy`, the feedback senses them with
    noise of 1 degree.
    """
    gravity = [[12.874614, -11.053135], [-16.014345, 52.066799]]
    torques = [[0.039823, -0.113306, 1.312397], [-0.113306, 0.459458, -1.632451]]
    A, B = np.zeros((4, 4)), np.vstack([np.zeros((2, 3)), torques])
    A[:2, 2:], A[2:, :2] = np.eye(2), gravity
    times, step = np.linspace(0, 20, samples, retstep=True)
    plant = impc.Plant(control.c2d(control.ss(A, B, np.eye(4), 0), step), ["u[0]", "u[1]"])
    rng, K = np.random.default_rng([2004, 1]), held_gain(plant, GAIN)
    turns = 2 * np.pi * np.array([7, 11, 16, 25, 38, 61, 103, 131, 151, 181, 313, 523.0]) / 240
    phases = rng.uniform(0, 2 * np.pi, len(turns))
    pushes = -(0.02 * turns**2 * np.sin(np.outer(times, turns) + phases)).sum(axis=1)
    sensed = np.radians(1.0 if noisy else 0.0) * rng.standard_normal((samples, 4))
    x = np.zeros((samples, 4))
    for k in range(samples - 1):
        u = K @ (sensed[k] - x[k])
        x[k + 1] = plant.A @ x[k] + plant.B @ u + plant.E[:, 0] * pushes[k]
    measured = x + np.radians(0.25) * rng.standard_normal(x.shape)
    recording = impc.Recording(plant, measured, pushes)
    return impc.fit_problem(plant, [recording], impc.FitSettings(horizon=5))


@pytest.mark.parametrize(
    ("noisy", "samples"),
    [
        pytest.param(True, 800, marks=FULL),
        pytest.param(False, 4000, marks=SLOW),
        pytest.param(True, 4000, marks=SLOW),
    ],
)
def test_two_links_end_at_the_least_misfit(noisy: bool, samples: int) -> None:
    """A person who stands, against another simulator and optimiser of linear feedback."""
    problem = standing_problem(noisy, samples)
    plant, trial = problem.plant, problem.recordings[0]

    def residual(unknowns: np.ndarray) -> np.ndarray:
        K, x0 = unknowns[:8].reshape(2, 4) * GAIN, unknowns[8:]
        loop = plant.A - plant.B @ K, plant.E, np.eye(4), np.zeros((4, 1)), 1.0
        x = scipy.signal.dlsim(loop, np.array(trial.disturbance), x0=x0)[2]
        return np.asarray((x - trial.outputs) / problem.output_scale).ravel()

    begin = np.concatenate([np.ones(8), trial.x0])
    best = scipy.optimize.least_squares(residual, begin, method="lm", xtol=1e-12, ftol=1e-14)
    least, count = float(np.sqrt(2 * best.cost)), trial.outputs.size
    fitted, feedback = impc.fit(problem), impc.fit(problem, "feedback_gain")
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


METHODS = ("feedback_gain", "inverse_lqr_gradient", "inverse_lqr_output", "inverse_mpc")


@pytest.fixture(scope="module")
def found() -> dict[str, impc.Estimate]:
    """Noisy cart at its limit."""
    settings = impc.FitSettings(horizon=10, u_max=1.0)
    start = impc.fit(impc.fit_problem(cart(), [noisy_trial(1, 0.0)], settings))
    return {name: impc.fit(start.problem, name, start=start) for name in METHODS}


@pytest.mark.parametrize(
    ("worse", "rel"), [(("inverse_lqr_output", "feedback_gain"), 2e-3), (("inverse_mpc",), 1e-4)]
)
def test_a_method_that_loses_begins_again(
    found: dict[str, impc.Estimate], worse: tuple[str, ...], rel: float
) -> None:
    """Poor weights for inverse MPC, and for the search without bounds."""
    changed = {name: found[name] for name in ("feedback_gain", "inverse_lqr_output", "inverse_mpc")}
    poor = impc.solve_lqr(cart(), impc.Weights(np.eye(2) * 50, 1))
    for name in worse:
        K, S, one = np.array(poor.K), np.array(poor.S), found[name]
        left = misfit_or_reason(one.problem, K, S)[0]
        assert left > 1.01 * one.misfit
        changed[name] = impc.replace(one, K=K, S=S, weights=poor.weights, misfit=left)
    checked = cross_checked(found["inverse_mpc"].problem, changed)
    for name, one in checked.items():
        assert one.misfit <= found[name].misfit * (1 + rel)
        assert not one.fit.beaten_by


def test_no_answer_is_beaten_and_nested_models_are_ordered(found: dict[str, impc.Estimate]) -> None:
    """The free gain fits no worse than weights without bounds; each is best in its model."""
    checked = cross_checked(found["inverse_mpc"].problem, found)
    output = checked["inverse_lqr_output"]
    assert checked["feedback_gain"].misfit <= output.misfit * (1 + 1e-3)
    assert output.misfit <= checked["inverse_lqr_gradient"].misfit * (1 + 1e-3)
    for own in (checked["inverse_mpc"], output):
        for other in checked.values():
            if other.weights is not None:
                left = misfit_or_reason(own.problem, np.array(other.gain), np.array(other.metric))
                assert own.misfit <= left[0] * (1 + 1e-3)
