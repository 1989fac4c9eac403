"""The search, its profiles with a direction fixed, and covariances: steps, ends, sizes."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

import impc
from experiments.noisy_people import recorded, subject
from experiments.noisy_people_score import blind
from impc.arrays import Array
from impc.output_feedback.fit import maximise, reml_slope, updated_slope
from impc.output_feedback.intervals import (
    confusion,
    entry_intervals,
    fallen,
    level_interval,
    level_intervals,
    person_covariance,
    profile,
)
from tests.output_feedback.fits import cart, fitted, posed, unknown_truth

pytestmark = pytest.mark.full


def test_levels_that_slide_do_not_hold_back_the_rest() -> None:
    """Regression: a step scaled as a whole took more than 30 evaluations here, 100 on the seat."""
    found = fitted("sliding")
    space = found.space
    _, _, spent, settled = maximise(space, space.at(space.start), 100)
    assert settled
    assert found.converged
    assert spent < 40
    truth = unknown_truth(found, [0.4, 0.002, 0.004, 0.01], 0.9)
    assert found.log_likelihood > space.value(truth)
    place, _, spent, settled = maximise(space, space.at(space.start), 2)
    assert (spent, settled) == (2, False)
    assert place.identified.value == space.value(place.theta) < found.log_likelihood


def test_initial_states_are_as_any_other_state() -> None:
    """Mean zero, with second moments of the states plus noise in the loop."""
    space, x0 = fitted("sliding").space, np.array([0.4, -0.7])
    begin = space.unpack(space.center)[0].problem
    np.testing.assert_allclose([trial.x0 for trial in begin.recordings], 0, atol=1e-12)
    theta, unit, plant = space.center.copy(), space.space.own_unit, cart()
    theta[space.shared : space.shared + 2] += np.linalg.solve(unit, x0)
    away = space.log_prior(space.center) - space.log_prior(theta)
    closed = plant.A - plant.B @ space.unpack(space.start)[0].K
    driven = np.exp(2 * space.scales[0]) * scipy.linalg.solve_discrete_lyapunov(
        closed, plant.B @ plant.B.T
    )
    assert away == pytest.approx(x0 @ np.linalg.solve(unit @ unit.T + driven, x0) / 2)


def test_what_levels_lose_is_that_of_the_gain_integrated_out() -> None:
    """Against a grid over the gain, at the fitted noise SDs and at twice the motor noise."""
    person = impc.Observer(cart(), ["x"], motor=0.4, sensory=0.05)
    problem = impc.replace(posed(person, 0.01, 3.0, 2), unknown_start=False)
    fit = impc.fit_output_feedback(impc.fit(problem), person)
    space, steps, change = fit.space, np.linspace(-5, 5, 11), []
    assert space.own == 2
    for factor in (1.0, 2.0):
        theta = np.array(fit.theta)
        theta[2] += np.log(factor)
        here, _, _, _ = maximise(space, space.at(theta), 30, np.eye(len(theta))[:, :2])
        root = np.linalg.cholesky(np.linalg.inv(here.identified.information[:2, :2]))
        top, total = here.identified.value + space.log_prior(here.theta), 0.0
        for first, second in itertools.product(steps, steps):
            there = here.theta.copy()
            there[:2] += root @ [first, second]
            if np.isfinite(space.log_prior(there)):  # it stabilises
                total += np.exp(space.value(there) + space.log_prior(there) - top)
        volume = total * float(np.linalg.det(root))
        change.append(here.value - top - np.log(volume))
    # Measured: 0.016 nats.
    assert change[0] == pytest.approx(change[1], abs=0.02)


def test_the_slope_of_what_levels_lose_follows_the_ridge() -> None:
    """Against searches over all else with a noise SD a little lower and higher."""
    fit = fitted("sliding")
    space, theta, own = fit.space, np.array(fit.theta), fit.space.own
    found, others, step = reml_slope(space, space.at(theta)), np.eye(len(theta))[:, :own], 0.05
    for index in (own, own + 3):  # The identified ones: motor and recording noise.
        lost = []
        for sign in (-1, 1):
            there = space.at(theta + sign * step * np.eye(len(theta))[index])
            place, _, _, settled = maximise(space, there, 30, others, np.array(fit.unseen))
            assert settled
            lost.append(place.lost)
        # Measured: .05 apart, for the first is a step of a tenth to one side.
        assert found[index] == pytest.approx((lost[0] - lost[1]) / (2 * step), abs=0.1)
    # After a long step along one noise SD, the learned slope along it is the mean change.
    here, slope = space.at(theta.copy()), np.array(fit.unseen)
    theta[own] += 2.0
    theta[0] += 0.1
    there = space.at(theta)
    learned = updated_slope(space, slope, here, there)
    assert learned[own] == pytest.approx(np.clip((here.lost - there.lost) / 2, 0, own), rel=0.05)
    np.testing.assert_array_equal(np.delete(learned, own), np.delete(slope, own))


@pytest.mark.parametrize(
    ("weights", "end"),
    [
        # Along two coordinates of the gain, motor and sensory noise.
        ((1, 0, 0, 0), 0), ((1, 0, 0, 0), 1), ((0, 0, 1, 0), 0), ((0, 0, 1, 0), 1),
        ((0, 0, 0, 1), 1), ((2, -1, 2, 0), 1),
    ],
)  # fmt: skip
def test_at_its_end_the_likelihood_has_fallen(weights: tuple[float, ...], end: int) -> None:
    """By half of 1.96^2, maximised over all else by another search."""
    fit = fitted("vague")
    own, along = fit.space.own, np.zeros(len(fit.theta))
    along[[0, 1, own, own + 1]] = np.array(weights) / np.linalg.norm(weights)
    space, value = fit.space.freed(along), profile(fit, along)[end]
    start = fit.theta + (value - along @ fit.theta) * along
    across = scipy.linalg.null_space(along[None])
    information = across.T @ (fit.identified.information + 0.1 * np.eye(len(along))) @ across
    ways = across @ np.linalg.inv(np.linalg.cholesky(information)).T  # steps of one are deviations
    unseen = reml_slope(space, space.at(start))

    def climbed(steps: Array) -> tuple[float, Array]:
        here = space.at(start + ways @ steps)
        gradient = here.identified.gradient + space.slopes(here.theta)[0] + unseen
        return -here.value, -ways.T @ gradient

    found = scipy.optimize.minimize(
        climbed, np.zeros(len(along) - 1), jac=True, method="BFGS", options={"gtol": 1e-3}
    )
    drop = space.placed(np.array(fit.theta), fit.identified).value + found.fun
    # The root of what has fallen is found to 0.04 of 1.39.
    assert drop == pytest.approx(1.920729, abs=0.12)
    assert fallen(fit, along, value) == pytest.approx(drop, abs=0.02)


def test_intervals_are_by_profile_where_the_standard_error_is_not_enough() -> None:
    fit = fitted("vague")
    expected, robust = person_covariance(fit, "expected"), person_covariance(fit)
    # Near a parabola they equal those of the standard error; unidentified entries have none.
    about = np.ravel(fit.K)[:, None] + 1.96 * np.ravel(expected.entries)[:, None] * [-1, 1]
    np.testing.assert_allclose(entry_intervals(fit, expected), about, rtol=0.05)
    loose = dataclasses.replace(expected, entries=10 + expected.entries)
    assert np.all(np.isnan(entry_intervals(fit, loose)))
    index = fit.space.names.index("recorder x")
    assert expected.levels[index] < 0.1
    assert fit.levels[index] == pytest.approx(fit.recorder[0])
    # Measured: 0.8 % below, 0.0 above, of a deviation of 2.8 %.
    ends = expected.level_intervals(fit.levels)[index]
    np.testing.assert_allclose(level_interval(fit, index), ends, rtol=0.01)
    index = fit.space.names.index("sensory x")
    low, high = level_interval(fit, index)
    assert 0 <= low < 0.01 < high < 1.0
    assert robust.levels[index] > 0.25
    intervals = level_intervals(fit, robust)
    np.testing.assert_array_equal(intervals[index], [low, high])
    assert intervals.shape == (len(fit.space.names), 2)


def test_a_level_that_may_be_none_is_told_on_one_side() -> None:
    """A subject whose senses are almost exact."""
    person = impc.Observer(cart(), ["x", "v"], motor=0.4, sensory=[1e-4, 1e-4])
    fit = impc.fit_output_feedback(impc.fit(posed(person, 0.01, 3.0)), person)
    low, high = level_interval(fit, fit.space.names.index("sensory x"))
    assert low == 0.0
    assert 1e-4 < high < 10.0  # metres: closed above, whatever is not expected of it
    # The square of such a noise SD overflows: nothing is as likely.
    assert fallen(fit, np.eye(len(fit.theta))[fit.space.own], 1e3) == np.inf


@pytest.mark.parametrize("seed", [0, 3])
def test_a_sense_that_is_hardly_told_leaves_the_motor_noise_its_own(seed: int) -> None:
    """Without a prior a sensory noise SD tends to zero here, and motor noise takes its part."""
    who = subject("cart", seed, "both", 90.0, 0.7)
    first, motor = impc.fit(recorded(who, seed).problem), float(who.person.levels[0])
    fit = impc.fit_output_feedback(first, blind(who))
    low, high = person_covariance(fit, "expected").level_intervals(fit.levels)[0]
    assert low < motor < high
    free = impc.fit_output_feedback(first, blind(who), spread=np.inf)
    assert np.max(person_covariance(free, "expected").levels) > 10
    assert free.observer.motor[0] > fit.observer.motor[0]


def test_covariances_agree_where_the_model_is_true() -> None:
    fit = fitted("free")
    expected, sandwich = (person_covariance(fit, kind) for kind in ("expected", "sandwich"))
    # 1600 samples: a standard error is itself known to 10 or 20 %.
    np.testing.assert_allclose(sandwich.entries, expected.entries, rtol=0.4)
    np.testing.assert_allclose(sandwich.levels, expected.levels, rtol=0.4)
    with pytest.raises(impc.InputError, match="expected, sandwich"):
        person_covariance(fit, "robust")
    # The squared canonical correlation is an eigenvalue.
    space, about = fit.space, np.zeros(len(fit.theta))
    about[: space.own] = 1.0
    covariance = np.linalg.inv(fit.identified.information + np.diag(about))
    gain, levels = slice(0, space.gain), slice(space.own, None)
    across, own = covariance[gain, levels], covariance[gain, gain]
    product = np.linalg.solve(own, across) @ np.linalg.solve(covariance[levels, levels], across.T)
    assert confusion(fit) ** 2 == pytest.approx(np.max(np.linalg.eigvals(product).real), rel=1e-3)


def test_a_direction_that_nothing_tells_leaves_the_others_as_they_are() -> None:
    """Two inputs without limit: the metric of the inputs affects neither command nor likelihood.

    Regression: four of seven directions had no sandwich standard error.
    """
    who = subject("pair", 0, "motor", 90.0, 5.0)
    found = impc.fit_output_feedback(impc.fit(recorded(who, 0).problem), blind(who))
    assert np.linalg.eigvalsh(found.identified.information)[0] < 1e-8
    robust, expected = person_covariance(found), person_covariance(found, "expected")
    assert np.linalg.eigvalsh(robust.covariance)[0] > 0
    np.testing.assert_allclose(robust.deviations, expected.deviations, rtol=0.3)
    np.testing.assert_allclose(robust.entries, expected.entries, rtol=0.3)
    off = (np.array(found.K) - np.array(who.controller.K)) / robust.entries
    assert np.all(np.abs(off) < 3)
