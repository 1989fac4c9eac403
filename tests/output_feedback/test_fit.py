"""Maximum likelihood fits: noise-free limit, derivatives, a known subject, cost weights."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace as replaced

import control
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from impc.arrays import Array
from impc.checking import replace
from impc.control.controller import Controller
from impc.errors import ImpcError, InputError, SolverError
from impc.inverse.estimates import Estimate
from impc.inverse.methods import fit
from impc.inverse.problem import Problem
from impc.inverse.search import refine_gain
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.structure import Structure
from impc.model.weights import Weights
from impc.output_feedback import likelihood
from impc.output_feedback.covariance import person_covariance
from impc.output_feedback.fit import OutputFeedbackFit, fit_output_feedback
from impc.output_feedback.observer import Observer
from impc.output_feedback.search import unseen_slope
from impc.output_feedback.simulation import simulate_person
from tests.support import extrapolated_slope

pytestmark = pytest.mark.full


def cart() -> Plant:
    system = control.ss(
        [[1, 0.05], [0, 0.98]], [[0, 0], [0.05, 0.05]], [[1, 0]], 0, 0.05,
        states=["x", "v"], inputs=["u", "d"], outputs=["x"],
    )  # fmt: skip
    return Plant(system, ["u"])


def posed(person: Observer, recorder: float, limit: float, trials: int = 2) -> Problem:
    plant = cart()
    bounds = Bounds(plant, u_min=-limit, u_max=limit)
    weights = Weights(np.diag([8.0, 1.0]), 1)
    law = Controller(plant, weights, bounds, 5, terminal_set=False)
    rng, recordings = np.random.default_rng(3), []
    for seed in range(trials):
        push = np.repeat(rng.choice([-0.7, 0.0, 0.7], 40), 10)
        found = simulate_person(law, person, push, recorder=recorder, seed=seed)
        assert found.reached == len(push)
        recordings.append(Recording(plant, found.outputs, push))
    return Problem(plant, bounds, 5, recordings, terminal_set=False, unknown_start=True)


@pytest.fixture(scope="module")
def noisy() -> tuple[Observer, Estimate]:
    person = Observer(cart(), ["x"], motor=0.15, sensory=0.02)
    return person, fit(posed(person, 0.01, 0.9))


@pytest.fixture(scope="module")
def fitted(noisy: tuple[Observer, Estimate]) -> OutputFeedbackFit:
    return fit_output_feedback(noisy[1], noisy[0])


def test_the_gradient_is_that_of_the_likelihood(noisy: tuple[Observer, Estimate]) -> None:
    """Along gain, initial states of both trials, and noise SDs together."""
    space = fit_output_feedback(noisy[1], noisy[0], max_evaluations=1).space
    identified = space.identified(space.start)
    assert identified.value == pytest.approx(space.value(space.start), rel=1e-12)
    for step in np.random.default_rng(1).normal(size=(3, len(space.start))):

        def moved(t: float, step: Array = step) -> Array:
            return np.array([space.value(space.start + t * step)])

        slope = extrapolated_slope(moved, 1e-3)
        assert identified.gradient @ step == pytest.approx(slope[0], rel=1e-6)


def test_trials_side_by_side_say_what_they_say_one_after_the_other(
    noisy: tuple[Observer, Estimate], monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = posed(noisy[0], 0.01, 0.9, trials=6)
    found = replaced(noisy[1], problem=problem)
    space = fit_output_feedback(found, noisy[0], max_evaluations=1).space
    beside = [space.identified(space.start) for _ in range(5)]
    monkeypatch.setattr(likelihood, "ThreadPoolExecutor", lambda _: ThreadPoolExecutor(1))
    alone = space.identified(space.start)
    for identified in beside:
        assert identified.value == alone.value
        for ours, theirs in zip(identified.scores, alone.scores, strict=True):
            assert_array_equal(ours, theirs)


def test_a_person_is_found_and_told_better_than_without_the_noise(
    noisy: tuple[Observer, Estimate], fitted: OutputFeedbackFit
) -> None:
    person, first = noisy
    truth = Controller(cart(), Weights(np.diag([8.0, 1.0]), 1), first.problem.bounds, 5).K
    assert fitted.converged
    np.testing.assert_allclose(fitted.observer.motor, person.motor, rtol=0.2)
    np.testing.assert_allclose(fitted.recorder, 0.01, rtol=0.1)
    np.testing.assert_allclose(fitted.K, truth, rtol=0.15)
    # With prior and REML term, the gradient is zero to 0.1 standard errors.
    slope, bend = fitted.prior.slopes(np.array(fitted.theta))
    unseen = unseen_slope(fitted.prior, fitted.prior.at(np.array(fitted.theta)))
    gradient = fitted.identified.gradient + slope + unseen
    assert gradient @ np.linalg.solve(fitted.identified.information + bend, gradient) < 1e-2


def test_the_barrier_is_how_far_noise_drives_the_loop(noisy: tuple[Observer, Estimate]) -> None:
    """Against a sum over all samples after a push; its gradient against differences."""
    space = fit_output_feedback(noisy[1], noisy[0], max_evaluations=1).space
    theta = space.start + np.array([0.1, -0.2, *np.zeros(len(space.start) - 2)])
    plant, T = space.space.problem.plant, space.space.T
    closed = plant.A - plant.B @ space.unpack(theta).point.K
    column, total = plant.B @ space.space.G, 0.0
    for _ in range(3000):  # the slowest mode has 0.9
        total += float(np.sum(np.linalg.solve(T, column) ** 2))
        column = closed @ column
    value, gradient = space.noise_growth(theta)
    assert value == pytest.approx(np.log(total / plant.n), rel=1e-9)
    for step in np.random.default_rng(1).normal(size=(2, len(theta))):

        def moved(t: float, step: Array = step) -> Array:
            return np.array([space.noise_growth(theta + t * step)[0]])

        assert gradient @ step == pytest.approx(extrapolated_slope(moved, 1e-3)[0], rel=1e-6)
    assert space.noise_growth(space.start - 100 * (np.arange(len(theta)) < 2))[0] == np.inf


def test_a_level_of_zero_is_not_searched(noisy: tuple[Observer, Estimate]) -> None:
    seeing = fit_output_feedback(noisy[1], Observer(cart(), motor=0.4))
    assert seeing.observer.share[0] == 0
    assert np.all(seeing.observer.process == 0)
    assert seeing.space.names == ["motor u", "recorder x"]


def test_a_level_that_is_known_is_not_searched(noisy: tuple[Observer, Estimate]) -> None:
    held = fit_output_feedback(noisy[1], noisy[0], held=["sensory"])
    assert held.observer.sensory[0] == noisy[0].sensory[0]
    assert held.space.names == ["motor u", "recorder x"]
    free = fit_output_feedback(noisy[1], noisy[0])
    assert free.count == held.count + 1
    assert 0 <= free.log_likelihood - held.log_likelihood < 4  # chi-squared with 1 d.o.f.
    with pytest.raises(InputError, match="held: got 'noise'; give some of motor, share"):
        fit_output_feedback(noisy[1], noisy[0], held=["noise"])


def test_a_trial_of_which_nothing_is_told_is_refused(noisy: tuple[Observer, Estimate]) -> None:
    """All samples would be conditioned on, and the fit would be the prior."""
    with pytest.raises(InputError, match="counted: got 400, but the shortest trial has 400"):
        fit_output_feedback(noisy[1], noisy[0], counted=400)


@pytest.mark.parametrize("logarithm", [400.0, -400.0, 1000.0, np.nan])
def test_a_level_that_cannot_be_squared_has_no_likelihood(
    fitted: OutputFeedbackFit, logarithm: float
) -> None:
    """Regression: a profile reached such an SD along its ridge, with a warning of numpy."""
    space = fitted.space
    theta = space.start.copy()
    theta[space.own] = logarithm
    for said in (space.identified, space.value):
        with pytest.raises(SolverError, match="noise SD: is out of range"):
            said(theta)


def test_without_noise_in_the_loop_it_is_the_fit_of_least_squares() -> None:
    """W, V -> 0: the same gain to 1e-6, if neither has a prior."""
    problem = posed(Observer(cart()), 0.01, 0.9)
    found = fit(problem)
    least = refine_gain(found.problem, np.array(found.gain), np.array(found.metric))
    start = replace(found, K=least.K, problem=least.problem)
    tiny = Observer(cart(), ["x", "v"], motor=1e-9, sensory=1e-9)
    for person in (Observer(cart()), tiny):
        likely = fit_output_feedback(start, person, recorder=np.array([0.01]), spread=np.inf)
        assert likely.converged
        np.testing.assert_allclose(likely.K, least.K, rtol=1e-6)
        np.testing.assert_allclose(likely.problem.starts, least.problem.starts, atol=1e-6)


@pytest.mark.parametrize(("along", "units"), [(0, 3.0), (1, 3.0), (1, 5.0)])
def test_a_gain_that_cannot_be_the_persons_is_left_behind(
    noisy: tuple[Observer, Estimate], fitted: OutputFeedbackFit, along: int, units: float
) -> None:
    """Regression: started 3 whitened units away, a search ended at 10 times the gain."""
    far = np.array(noisy[1].gain) + units * fitted.space.space.gains[along]
    found = fit_output_feedback(replaced(noisy[1], K=far), noisy[0])
    assert found.converged
    deviations = np.array(person_covariance(fitted, "expected").entries)
    assert np.all(np.abs(np.array(found.K) - fitted.K) < 0.1 * deviations)


def test_prices_of_a_structure_are_searched() -> None:
    person = Observer(cart(), ["x"], motor=0.15, sensory=0.02)
    given = posed(person, 0.01, 0.9)
    problem = Problem(
        given.plant, given.bounds, 5, given.recordings, terminal_set=False, unknown_start=True,
        structure=Structure(given.plant, ["x", "v"]),
    )  # fmt: skip
    found = fit_output_feedback(fit(problem, "structured"), person)
    assert found.cost_weights is not None
    assert found.converged
    weights = found.problem.structure.weights(found.cost_weights)  # type: ignore[union-attr]
    law = Controller(given.plant, weights, given.bounds, 5, terminal_set=False)
    np.testing.assert_allclose(law.K, found.K, rtol=1e-9)
    # In two trials of 20 s cost weights are known to within a factor of two.
    assert np.all(np.abs(np.array(found.cost_weights) - np.log([8.0, 1.0])) < 1.0)


def test_what_cannot_be_estimated_is_an_error(noisy: tuple[Observer, Estimate]) -> None:
    with pytest.raises(ImpcError, match="no start has a likelihood"):
        fit_output_feedback(noisy[1], Observer(cart(), ["v"], sensory=0.1, motor=0.4))
