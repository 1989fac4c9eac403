"""Maximum likelihood fits: no noise, derivatives, a known subject, storage, and doubts."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace as replaced

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import impc
from impc.arrays import Array
from impc.inverse.search import refine_gain
from impc.inverse.structured import fit_structured
from impc.output_feedback import likelihood
from impc.output_feedback.doubts import driven
from impc.output_feedback.fit import OutputFeedbackFit, reml_slope
from impc.output_feedback.intervals import person_covariance
from impc.output_feedback.models import PersonModel, decode_model, encode_model
from impc.output_feedback.unknowns import NoisyUnknowns
from tests.output_feedback.fits import cart, fitted, law, least_squares, posed
from tests.support import extrapolated_slope, named_plant, present

pytestmark = pytest.mark.full


def unknowns() -> NoisyUnknowns:
    """Gain, initial states of both trials, and noise SDs, at the start of a search."""
    person, first = least_squares("limited")
    return impc.fit_output_feedback(first, person, max_evaluations=1).space


def check_slope(value: Callable[[Array], float], gradient: Array, theta: Array) -> None:
    for step in np.random.default_rng(1).normal(size=(2, len(theta))):

        def moved(t: float, step: Array = step) -> Array:
            return np.array([value(theta + t * step)])

        slope = extrapolated_slope(moved, 1e-3)[0]
        assert gradient @ step == pytest.approx(slope, rel=1e-6)


def unknowns_with_free_parameters() -> NoisyUnknowns:
    """The same, and friction, the scale of the output, and the rate of an observer."""

    def make(values: Array) -> impc.Plant:
        friction, scale, rate = map(float, values)
        A, B = [[1, 0.05], [0, 1 - friction]], [[0, 0], [0.05, 0.05]]
        plant = named_plant(A, B, [[scale, 0]], 0.05, "x v", "u d", "x")
        return impc.with_observer(plant, [rate])

    first = least_squares("limited")[1]
    family = impc.PlantFamily(make, ["friction", "scale", "rate"], [0.02, 1.0, 0.5])
    plant = make(family.nominal)
    posed = impc.replace(first.problem, plant=plant, family=family, logarithms=np.zeros(3))
    person = impc.Observer(cart(), ["x"], motor=0.15, sensory=0.02, walk=0.2)
    return impc.fit_output_feedback(
        impc.replace(first, problem=posed), person, max_evaluations=1
    ).space


@pytest.mark.parametrize("make", [unknowns, unknowns_with_free_parameters])
def test_the_gradient_is_that_of_likelihood_and_prior(make: Callable[[], NoisyUnknowns]) -> None:
    space = make()
    identified = space.identified(space.start)
    assert identified.value == pytest.approx(space.value(space.start), rel=1e-12)
    check_slope(space.value, identified.gradient, space.start)
    check_slope(space.log_prior, space.slopes(space.start)[0], space.start)


def test_the_barrier_is_how_far_noise_drives_the_loop() -> None:
    """Against a sum over all samples after a push; its gradient against differences."""
    space = unknowns()
    theta = space.start + np.array([0.1, -0.2, *np.zeros(len(space.start) - 2)])
    plant, T = space.space.problem.plant, space.gain_law.T
    closed = plant.A - plant.B @ space.unpack(theta)[0].K
    column, total = plant.B @ space.gain_law.G, 0.0
    for _ in range(3000):  # the slowest mode has 0.9
        total += float(np.sum(np.linalg.solve(T, column) ** 2))
        column = closed @ column
    value, gradient = space.noise_growth(theta)
    assert value == pytest.approx(np.log(total / plant.n), rel=1e-9)
    check_slope(lambda at: space.noise_growth(at)[0], gradient, theta)
    assert space.noise_growth(space.start - 100 * (np.arange(len(theta)) < 2))[0] == np.inf


def test_trials_side_by_side_say_what_they_say_one_after_the_other(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    person, first = least_squares("limited")
    found = replaced(first, problem=posed(person, 0.01, 0.9, 6))
    space = impc.fit_output_feedback(found, person, max_evaluations=1).space
    beside = [space.identified(space.start) for _ in range(5)]
    monkeypatch.setattr(likelihood, "ThreadPoolExecutor", lambda _: ThreadPoolExecutor(1))
    alone = space.identified(space.start)
    for identified in beside:
        assert identified.value == alone.value
        for ours, theirs in zip(identified.scores, alone.scores, strict=True):
            assert_array_equal(ours, theirs)


def test_a_person_is_found_and_told_better_than_without_the_noise() -> None:
    found, (person, _) = fitted("limited"), least_squares("limited")
    assert found.converged
    np.testing.assert_allclose(found.observer.motor, person.motor, rtol=0.2)
    np.testing.assert_allclose(found.recorder, 0.01, rtol=0.1)
    np.testing.assert_allclose(found.K, law(0.9).K, rtol=0.15)
    # With prior and REML term, the gradient is zero to 0.1 standard errors.
    space, theta = found.space, np.array(found.theta)
    slope, bend = space.slopes(theta)
    gradient = found.identified.gradient + slope + reml_slope(space, space.at(theta))
    assert gradient @ np.linalg.solve(found.identified.information + bend, gradient) < 1e-2


def test_a_level_that_is_zero_or_known_is_not_searched() -> None:
    person, first = least_squares("limited")
    seeing = impc.fit_output_feedback(first, impc.Observer(cart(), motor=0.4))
    assert seeing.observer.share[0] == 0
    assert np.all(seeing.observer.process == 0)
    held, free = impc.fit_output_feedback(first, person, held=["sensory"]), fitted("limited")
    assert held.observer.sensory[0] == person.sensory[0]
    assert held.space.names == seeing.space.names == ["motor u", "recorder x"]
    assert free.count == held.count + 1
    assert 0 <= free.log_likelihood - held.log_likelihood < 4  # chi-squared with 1 d.o.f.


@pytest.mark.parametrize("logarithm", [400.0, -400.0, 1000.0, np.nan])
def test_a_level_that_cannot_be_squared_has_no_likelihood(logarithm: float) -> None:
    """Regression: a profile reached such an SD along its ridge, with a warning of numpy."""
    space = fitted("limited").space
    theta = space.start.copy()
    theta[space.own] = logarithm
    for said in (space.identified, space.value):
        with pytest.raises(impc.SolverError, match="noise SD: is out of range"):
            said(theta)


def test_without_noise_in_the_loop_it_is_the_fit_of_least_squares() -> None:
    """W, V -> 0: the same gain to 1e-6, if neither has a prior."""
    found = impc.fit(posed(impc.Observer(cart()), 0.01, 0.9))
    least = refine_gain(found.problem, np.array(found.gain), np.array(found.metric))
    start = impc.replace(found, K=least.K, problem=least.problem)
    tiny = impc.Observer(cart(), ["x", "v"], motor=1e-9, sensory=1e-9)
    for person in (impc.Observer(cart()), tiny):
        likely = impc.fit_output_feedback(start, person, recorder=np.array([0.01]), spread=np.inf)
        assert likely.converged
        np.testing.assert_allclose(likely.K, least.K, rtol=1e-6)
        np.testing.assert_allclose(likely.problem.starts, least.problem.starts, atol=1e-6)


@pytest.mark.parametrize(("along", "units"), [(0, 3.0), (1, 3.0), (1, 5.0)])
def test_a_gain_that_cannot_be_the_persons_is_left_behind(along: int, units: float) -> None:
    """Regression: started 3 whitened units away, a search ended at 10 times the gain."""
    near, (person, first) = fitted("limited"), least_squares("limited")
    far = np.array(first.gain) + units * near.space.gain_law.gains[along]
    found = impc.fit_output_feedback(replaced(first, K=far), person)
    assert found.converged
    deviations = np.array(person_covariance(near, "expected").entries)
    assert np.all(np.abs(np.array(found.K) - near.K) < 0.1 * deviations)


def test_what_cannot_be_estimated_is_an_error() -> None:
    person, first = least_squares("limited")
    with pytest.raises(impc.ImpcError, match="no start has a likelihood"):
        impc.fit_output_feedback(first, impc.Observer(cart(), ["v"], sensory=0.1, motor=0.4))
    with pytest.raises(impc.InputError, match="held: got 'noise'; give some of motor, share"):
        impc.fit_output_feedback(first, person, held=["noise"])
    # All samples would be conditioned on, and the fit would be the prior.
    with pytest.raises(impc.InputError, match="counted: got 400, but the shortest trial has 400"):
        impc.fit_output_feedback(first, person, counted=400)


def test_prices_of_a_structure_are_searched_and_stored() -> None:
    person, first = least_squares("limited")
    structure = impc.Structure(cart(), ["x", "v"])
    problem = impc.replace(first.problem, structure=structure)
    found = impc.fit_output_feedback(fit_structured(problem, structure, first), person)
    assert found.cost_weights is not None
    assert found.converged
    weights = structure.weights(found.cost_weights)
    there = impc.Controller(cart(), weights, first.problem.bounds, 5, terminal_set=False)
    np.testing.assert_allclose(there.K, found.K, rtol=1e-9)
    # In two trials of 20 s cost weights are known to within a factor of two.
    assert np.all(np.abs(np.array(found.cost_weights) - np.log([8.0, 1.0])) < 1.0)
    check_stored(found)


def test_a_stored_fit_is_the_one_that_was_fitted() -> None:
    check_stored(fitted("limited"))


def check_stored(fit: OutputFeedbackFit) -> None:
    kept = json.loads(json.dumps(encode_model(PersonModel("one", fit, ""))))
    again = present(decode_model("one", fit.problem, fit.space.request.observer, kept).fit)
    for name in ("K", "S", "recorder", "theta", "unseen"):
        assert_array_equal(getattr(again, name), getattr(fit, name))
    assert (again.value, again.log_likelihood) == (fit.value, fit.log_likelihood)
    assert (again.converged, again.evaluations) == (fit.converged, fit.evaluations)
    assert_array_equal(again.problem.starts, fit.problem.starts)
    ours, theirs = person_covariance(again), person_covariance(fit)
    assert_array_equal(ours.entries, theirs.entries)
    assert_array_equal(ours.levels, theirs.levels)
    assert np.all(np.isfinite(ours.entries))


@functools.cache
def machine(late: int) -> OutputFeedbackFit:
    """Fit, without delay, of a machine that acts on the states of `late` samples ago."""
    plant, K, trials = cart(), law(np.inf).K, []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        push, states = np.repeat(rng.choice([-0.7, 0.0, 0.7], 40), 10), [np.zeros(2)]
        for t in range(len(push) - 1):
            u = -K @ states[max(t - late, 0)] + 0.15 * rng.standard_normal(1)
            states.append(plant.A @ states[-1] + plant.B @ u + plant.E @ push[t : t + 1])
        y = np.array(states)[:, :1] + 0.01 * rng.standard_normal((len(push), 1))
        trials.append(impc.Recording(plant, y, push))
    problem = impc.Problem(
        plant, law(np.inf).bounds, 5, trials, terminal_set=False, unknown_start=True
    )
    return impc.fit_output_feedback(
        impc.fit(problem), impc.Observer(plant, ["x"], motor=0.15, sensory=0.02)
    )


def deviations(found: OutputFeedbackFit) -> float:
    """Largest error of a gain entry in standard errors."""
    apart = np.abs(np.array(found.K) - law(np.inf).K) / person_covariance(found).entries
    return float(np.max(apart))


def test_a_true_model_has_no_doubts() -> None:
    for found in (machine(0), fitted("free")):
        assert found.converged
        assert deviations(found) < 3
        assert found.doubts == ()
        assert str(found).startswith("output feedback: K = [[")


def test_a_recording_that_is_not_of_the_model_is_doubted() -> None:
    """A delay of 0.4 s: narrow intervals, white errors, and another gain."""
    found = machine(8)
    assert found.converged
    assert deviations(found) > 10
    assert np.all(found.whiteness > 0.01)
    (doubt,) = found.doubts
    assert doubt.startswith("Prediction errors of x follow the perturbation: the model is incompl")
    assert doubt in str(found)


def test_errors_of_a_machine_without_perturbation_follow_none() -> None:
    found = machine(0)
    still = [impc.replace(one, disturbance=0 * one.disturbance) for one in found.problem.recordings]
    quiet = impc.replace(found, problem=impc.replace(found.problem, recordings=tuple(still)))
    assert driven(quiet) == pytest.approx([1.0])


def test_scores_that_vary_more_than_the_model_says_are_doubted() -> None:
    """Scores of three times the size: standard errors by the sandwich are three times as large."""
    found = machine(0)
    wild = [3 * one for one in found.identified.scores]
    said = impc.replace(found, identified=replaced(found.identified, scores=wild)).doubts
    assert any("Standard errors that allow for a wrong model are up to" in one for one in said)
