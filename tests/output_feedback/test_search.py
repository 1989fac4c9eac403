"""The search for the maximum: its step, convergence, and noise SDs that tend to zero."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import impc
from impc.checking import replace
from impc.control.controller import Controller
from impc.model.weights import Weights
from impc.output_feedback.fit import OutputFeedbackFit, fit_output_feedback
from impc.output_feedback.observer import Observer
from impc.output_feedback.prior import Prior
from impc.output_feedback.search import boxed_step, climb, learned_slope, unseen_slope
from tests.output_feedback.test_fit import cart, posed

pytestmark = pytest.mark.full


def sliding_person() -> OutputFeedbackFit:
    """A subject whose sensory noise is so small that it is not identified."""
    person = Observer(cart(), ["x", "v"], motor=0.4, sensory=[0.002, 0.004])
    return fit_output_feedback(
        impc.fit(posed(person, 0.01, 0.9)), person.with_levels(np.array([0.1, 0, 0, 0, 0.1, 0.1]))
    )


@pytest.fixture(scope="module")
def sliding() -> OutputFeedbackFit:
    return sliding_person()


@pytest.mark.parametrize("seed", range(4))
def test_a_step_is_the_best_of_its_box(seed: int) -> None:
    rng = np.random.default_rng(seed)
    root, gradient = rng.normal(size=(6, 6)), 3 * rng.normal(size=6)
    curvature, bound = root @ root.T + 0.1 * np.eye(6), float(rng.uniform(0.1, 1.0))
    step, promised = boxed_step(gradient, curvature, bound)
    found = np.zeros(6)
    for _ in range(2000):  # Coordinate search: each coordinate at its best in turn.
        for k in range(6):
            rest = gradient[k] - curvature[k] @ found + curvature[k, k] * found[k]
            found[k] = np.clip(rest / curvature[k, k], -bound, bound)
    np.testing.assert_allclose(step, found, atol=1e-9)
    assert promised == pytest.approx(gradient @ found - found @ curvature @ found / 2, abs=1e-9)


def test_levels_that_slide_do_not_hold_back_the_rest(sliding: OutputFeedbackFit) -> None:
    """Regression: a step scaled as a whole took more than 30 evaluations here, 100 on the seat."""
    space, theta = sliding.space, np.array(sliding.space.start)
    _, _, spent, settled = climb(sliding.prior, sliding.prior.at(space.start), 100)
    assert settled
    assert sliding.converged
    assert spent < 40
    truth = Controller(cart(), Weights(np.diag([8.0, 1.0]), 1), sliding.problem.bounds, 5).K
    own = space.space
    along = np.tensordot(own.natural(own.gains), own.natural(np.array(truth)), 2)
    theta[: space.gain] = along
    starts = np.array([trial.x0 for trial in own.problem.recordings])
    theta[space.shared : space.after] = -np.linalg.solve(own.own_unit, starts.T).T.ravel()
    theta[space.own :] = np.log([0.4, 0.002, 0.004, 0.01])
    assert sliding.log_likelihood > space.value(theta)


def test_a_search_that_may_not_go_on_says_so(sliding: OutputFeedbackFit) -> None:
    space = sliding.space
    prior = Prior(space, 1.0, space.start[space.own :])
    (theta, identified, _, _), _, spent, settled = climb(prior, prior.at(space.start), 2)
    assert (spent, settled) == (2, False)
    assert identified.value == space.identified(theta).value < sliding.log_likelihood


def test_the_prior_bends_as_it_says(sliding: OutputFeedbackFit) -> None:
    """The gradient against differences; with infinite spread the prior is constant."""
    space, theta = sliding.space, np.array(sliding.theta)
    rng, scales = np.random.default_rng(0), space.start[space.own :]
    prior, step, h = Prior(space, 0.5, scales), rng.normal(size=len(theta)), 1e-5
    change = (prior.value(theta + h * step) - prior.value(theta - h * step)) / (2 * h)
    assert prior.slopes(theta)[0] @ step == pytest.approx(change, rel=1e-6)
    nothing = Prior(space, np.inf, scales)
    assert nothing.value(theta) == nothing.lost(theta, sliding.identified) == 0.0
    assert not np.any(nothing.slopes(theta)[1])
    assert not np.any(unseen_slope(nothing, nothing.at(theta)))


def test_initial_states_are_as_any_other_state(sliding: OutputFeedbackFit) -> None:
    """Mean zero, with second moments of the states plus noise in the loop."""
    space = sliding.space
    scales, driven = space.start[space.own :], np.diag([0.3, 0.2])
    prior = Prior(space, 1.0, scales, driven)
    begin = space.unpack(prior.center).point.problem
    np.testing.assert_allclose([trial.x0 for trial in begin.recordings], 0, atol=1e-12)
    theta, x0 = prior.center.copy(), np.array([0.4, -0.7])
    unit = space.space.own_unit
    theta[space.shared : space.shared + 2] += np.linalg.solve(unit, x0)
    away = prior.value(prior.center) - prior.value(theta)
    assert away == pytest.approx(x0 @ np.linalg.solve(unit @ unit.T + driven, x0) / 2)


def test_what_levels_lose_is_that_of_the_gain_integrated_out() -> None:
    """Against a grid over the gain, at the fitted noise SDs and at twice the motor noise."""
    person = Observer(cart(), ["x"], motor=0.4, sensory=0.05)
    problem = replace(posed(person, 0.01, 3.0, trials=1), unknown_start=False)
    fit = fit_output_feedback(impc.fit(problem), person)
    space, prior, steps = fit.space, fit.prior, np.linspace(-5, 5, 11)
    assert space.own == 2
    change = []
    for factor in (1.0, 2.0):
        theta = np.array(fit.theta)
        theta[2] += np.log(factor)
        here, _, _, _ = climb(prior, prior.at(theta), 30, np.eye(len(theta))[:, :2])
        root = np.linalg.cholesky(np.linalg.inv(here.identified.information[:2, :2]))
        top, total = here.identified.value + prior.value(here.theta), 0.0
        for first, second in itertools.product(steps, steps):
            there = here.theta.copy()
            there[:2] += root @ [first, second]
            if np.isfinite(prior.value(there)):  # it stabilises
                total += np.exp(space.value(there) + prior.value(there) - top)
        volume = total * float(np.linalg.det(root))
        change.append(here.value - top - np.log(volume))
    # Measured: 0.004 nats.
    assert change[0] == pytest.approx(change[1], abs=0.02)


def test_the_slope_of_what_levels_lose_follows_the_ridge(sliding: OutputFeedbackFit) -> None:
    """Against searches over all else with a noise SD a little lower and higher."""
    prior, theta = sliding.prior, np.array(sliding.theta)
    own = sliding.space.own
    found, others, step = unseen_slope(prior, prior.at(theta)), np.eye(len(theta))[:, :own], 0.05
    for index in (own, own + 3):  # The identified ones: motor and recording noise.
        lost = []
        for sign in (-1, 1):
            start = theta + sign * step * np.eye(len(theta))[index]
            there = prior.at(start)
            place, _, _, settled = climb(prior, there, 30, others, np.array(sliding.unseen))
            assert settled
            lost.append(place.lost)
        # Measured: .05 apart, for the first is a step of a tenth to one side.
        assert found[index] == pytest.approx((lost[0] - lost[1]) / (2 * step), abs=0.1)


def test_what_levels_lose_is_learned(sliding: OutputFeedbackFit) -> None:
    """After a long step along one noise SD, the gradient along it is the mean change."""
    prior, theta, own = sliding.prior, np.array(sliding.theta), sliding.space.own
    here, slope = prior.at(theta.copy()), np.array(sliding.unseen)
    theta[own] += 2.0
    theta[0] += 0.1
    there = prior.at(theta)
    learned = learned_slope(prior, slope, here, there)
    assert learned[own] == pytest.approx(np.clip((here.lost - there.lost) / 2, 0, own), rel=0.05)
    np.testing.assert_array_equal(np.delete(learned, own), np.delete(slope, own))
