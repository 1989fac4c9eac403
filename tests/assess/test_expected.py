"""Expected standard errors against finite differences and dense covariances."""

from __future__ import annotations

import functools

import control
import numpy as np
import pytest
import scipy.linalg

import impc
from experiments.printed_intervals import carts
from impc.arrays import Array
from impc.assess.expected import MULTIPLES, Expectation
from tests.support import differences, present

NOISE = 0.03
SAMPLES = 160


@functools.cache
def cart() -> tuple[impc.Plant, Array, Array]:
    """Cart with a gain, and a push up to its limit."""
    push = np.repeat(np.random.default_rng(3).choice([-0.8, 0.0, 0.8], (16, 1)), 10, axis=0)
    plant = carts(1)
    return plant, np.array(impc.solve_lqr(plant, impc.Weights(np.diag([4.0, 1.5]), 1)).K), push


def outputs(gain: Array, x0: Array, limit: float) -> Array:
    """Simulated positions (samples,)."""
    plant, _, push = cart()
    bounds = impc.Bounds(plant, u_min=-limit, u_max=limit)
    law = impc.Controller.from_gain(plant, gain.reshape(1, 2), bounds, 8, terminal_set=False)
    return law.simulate(x0, disturbance=push).outputs[:SAMPLES, 0]


@functools.cache
def cart_problem(family: impc.PlantFamily | None = None, limit: float = 1.0) -> impc.Problem:
    plant, gain, push = cart()
    trial = impc.Recording(plant, outputs(gain, np.zeros(2), limit)[:, None], push)
    bounds = impc.Bounds(plant, u_min=-limit, u_max=limit)
    return impc.Problem(
        plant, bounds, 8, [trial], terminal_set=False, unknown_start=True, family=family
    )


@functools.cache
def expected(root: float = 0.0) -> Expectation:
    return impc.expected_intervals(cart_problem(), cart()[1], NOISE, root=root)


@functools.cache
def columns() -> tuple[Array, Array, Array]:
    """Derivatives by gain, initial state and log limit, by five-point differences."""

    def moved(z: Array) -> Array:
        return outputs(cart()[1][0] + z[:2], z[2:4], float(np.exp(z[4])))

    # At steps of 1e-4 a sample reaches its limit in between.
    one, two = (differences(moved, np.zeros(5), step) for step in (1e-5, 2e-5))
    found = (4 * one - two) / 3
    return found[:, :2], found[:, 2:4], found[:, 4]


@pytest.mark.parametrize("root", [0.0, 0.6])
def test_deviations_are_those_of_least_squares(root: float) -> None:
    """Against the covariance matrix of first-order noise."""
    found, noise = expected(root), NOISE**2 * scipy.linalg.toeplitz(root ** np.arange(SAMPLES))
    back = np.linalg.pinv(np.hstack(columns()[:2]))
    block = (back @ noise @ back.T)[:2, :2]
    # The package's noise model reaches 250 samples back; differences are accurate to 1e-7.
    np.testing.assert_allclose(found.deviations[0], np.sqrt(np.diag(block)), rtol=2e-5)
    # An exact body: errors fall with the root of the number of trials.
    times = np.sqrt(np.array(MULTIPLES))[:, None, None]
    np.testing.assert_allclose(found.by_trials * times, np.tile(found.deviations, (6, 1, 1)))


def test_the_limit_is_known_as_least_squares_with_a_free_gain_says() -> None:
    on_gain, on_start, on_limit = columns()
    others = np.hstack([on_gain, on_start])
    rest = on_limit - others @ np.linalg.lstsq(others, on_limit)[0]
    assert expected().limits[0] == pytest.approx(NOISE / np.linalg.norm(rest), rel=2e-5)
    never_met = cart_problem(limit=9.0)
    assert np.isinf(impc.expected_intervals(never_met, cart()[1], NOISE).limits[0])


def test_several_trials_are_multiples_of_one() -> None:
    """Two recordings of the same trial are twice the trials, with a stated body too."""
    for family in (None, body(STATED)):
        problem = cart_problem(family)
        twice = impc.replace(problem, recordings=problem.recordings * 2)
        one, two = (impc.expected_intervals(it, cart()[1], NOISE) for it in (problem, twice))
        place = MULTIPLES.index(2.0)
        np.testing.assert_allclose(one.by_trials[place], two.deviations, rtol=1e-6)


STATED: dict[str, float | str] = {"force": "5 %", "fall": 0.06, "u_max": "5 %"}


def body(uncertainty: dict[str, float | str]) -> impc.PlantFamily:
    """Cart with stated uncertainties of force per command and rate of falling."""

    def made(values: Array) -> impc.Plant:
        force, fall = values
        system = control.ss(
            [[0, 1], [fall, -0.3]], [[0, 0], [force, 1]], [[1, 0]], 0,
            inputs=["force1", "push1"], outputs=["position1"],
        )  # fmt: skip
        return impc.Plant(control.c2d(system, 0.1), ["force1"])

    return impc.PlantFamily(made, ["force", "fall"], [1.0, 0.3], uncertainty)


def known_to(uncertainty: dict[str, float | str]) -> Expectation:
    return impc.expected_intervals(cart_problem(body(uncertainty)), cart()[1], NOISE)


def test_an_exact_body_and_one_that_is_measured_are_those_of_their_own_problems() -> None:
    found, exact = known_to(STATED), expected()
    assert exact.exact is None
    assert present(found.exact) == pytest.approx(exact.deviations, rel=1e-6)
    for place, name in enumerate(STATED):
        fall = 1 - known_to(STATED | {name: 0.0}).deviations / found.deviations
        assert found.narrower[..., place] == pytest.approx(fall, abs=1e-6)
    # The stated uncertainty of the limit is excluded from its expected precision.
    assert found.limits == pytest.approx(known_to(STATED | {"u_max": 0.0}).limits, rel=1e-6)


def test_no_number_of_trials_tells_a_weak_force_from_a_weak_person() -> None:
    """Scaling force and limit against the gain leaves the outputs unchanged."""
    # The best known precision is therefore sqrt(1 / (1 / .05^2 + 1 / .05^2)) of the gain.
    relative = known_to(STATED).by_trials[-1] / np.abs(cart()[1])
    assert np.all(relative > 0.05 / np.sqrt(2))
    # The known limit identifies the force.
    known = known_to({"force": "5 %"}).by_trials[-1] / np.abs(cart()[1])
    assert np.all(known < 0.05 / np.sqrt(2))


def test_a_gain_that_is_not_identified_has_no_standard_error() -> None:
    found = impc.expected_intervals(cart_problem(), cart()[1], 1e4)
    assert np.all(np.isinf(found.deviations))


def test_what_cannot_be_meant_is_refused() -> None:
    for noise, root, said in ((0.0, 0.0, "deviation"), (NOISE, 1.0, "root")):
        with pytest.raises(impc.InputError, match=said):
            impc.expected_intervals(cart_problem(), cart()[1], noise, root=root)
