"""Plant with stated uncertainty: prior in the fit and in the intervals."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest
import scipy.linalg

import impc
from experiments.uncertain_body import HORIZON, LIMIT, cart, cart_person, noise
from impc.arrays import Array
from impc.assess.covariance import gain_covariance
from impc.assess.long_run_covariance import ResidualNoise
from impc.assess.printed_gain import gain_estimate
from impc.errors import InputError, PlantError
from impc.files.plant_sources import plant_family_of, plant_source
from impc.inverse.estimates import Estimate
from impc.inverse.problem import Problem, noise_of_residual
from impc.inverse.residuals import evaluate, residual_only
from impc.model.plant_family import PlantFamily

KNOWN = {"fall": "3 %", "damp": "3 %", "extra_delay": 0.02, "u_max": "5 %"}


def family(**uncertainty: Any) -> PlantFamily:
    stated = uncertainty or KNOWN
    return PlantFamily(lambda values: cart(values.tolist()), ["fall", "damp"], [1, 1], stated)


@functools.cache
def saturated() -> tuple[Problem, Array]:
    """Recordings partly at the limit, of the family with all four unknowns."""
    made = family()
    plant, rng = made.make(made.nominal), np.random.default_rng(3)
    bounds = impc.Bounds(plant, u_min=-0.42, u_max=0.42)
    weights = impc.Weights(np.diag([4.0, 1.0, 0.01]), 1)
    law = impc.Controller(plant, weights, bounds, HORIZON, terminal_set=False)
    trials = []
    for _ in range(2):
        push = 0.3 * np.repeat(rng.choice([-1.0, 0, 1], 25), 16)
        y = law.simulate([0, 0, 0], disturbance=push).x[:-1, :1]
        trials.append(impc.Recording(plant, y + 0.1 * y.std() * noise(rng, 400, 1, 0.0), push))
    return Problem(plant, bounds, HORIZON, trials, family=made, unknown_start=True), np.array(law.K)


@functools.cache
def fitted() -> Estimate:
    person = cart_person(1, 99, 0.0)
    assert person is not None
    return impc.fit(person.problem)


def test_derivatives_by_parameters_delay_and_limit() -> None:
    problem, K = saturated()
    assert problem.parameter_names == ("fall", "damp", "extra_delay", "u_max.u")
    q, S = np.array([0.02, -0.01, 0.1, 0.03]), np.eye(1)
    found = evaluate(problem.at(problem.starts, q), K, S).dparameters
    for place, unit in enumerate(np.eye(4)):
        ends = [
            residual_only(problem.at(problem.starts, q + sign * 1e-5 * unit), K, S)
            for sign in (1, -1)
        ]
        slope = (ends[0] - ends[1]) / 2e-5
        np.testing.assert_allclose(found[:, place], slope, atol=1e-7 * np.max(np.abs(slope)))


def test_values_of_delay_and_limit_are_in_their_units() -> None:
    problem, _ = saturated()
    assert problem.family is not None
    values = problem.family.values(np.log([1.0, 1.0, 1.5, 1.1]))
    np.testing.assert_allclose(values, [1.0, 1.0, 0.5 * 0.05, 1.1 * 0.42])
    moved = problem.at(problem.starts, np.log([1.0, 1.0, 1.0, 1.1]))
    np.testing.assert_allclose(moved.bounds.u_max, [1.1 * 0.42])


def test_the_covariance_is_that_of_the_joint_curvature() -> None:
    """White residuals: inverse of J'J / s^2 + prior from all columns; to 1e-6."""
    found = gain_estimate(fitted())
    problem, K, S = found.problem, np.array(found.K), np.array(found.S)
    at = evaluate(problem, K, S)
    own = np.split(at.own, np.cumsum(problem.trial_sizes)[:-1])
    J = np.hstack(
        [at.dK.reshape(len(at.residual), -1), at.dparameters, scipy.linalg.block_diag(*own)]
    )
    s = noise_of_residual(problem, at.residual)
    H = J.T @ J / s**2
    H[2:4, 2:4] += np.diag(1 / 0.03**2 * np.ones(2))
    expected = np.sqrt(np.diag(np.linalg.inv(H)))
    white = ResidualNoise(np.zeros(2), s**2 * np.eye(2)[None])
    linear = gain_covariance(problem, K, S, lambda _residuals, _fitted: white)
    np.testing.assert_allclose(linear.entries.ravel(), expected[:2], rtol=1e-6)
    np.testing.assert_allclose(linear.parameters, expected[2:4], rtol=1e-6)
    cov = np.linalg.inv(H)
    shares = cov[:2, 2:4] ** 2 / np.outer(np.diag(cov)[:2], np.diag(cov)[2:4])
    np.testing.assert_allclose(linear.shares.reshape(2, 2), shares, rtol=1e-6)


def test_the_fit_is_the_mode_of_the_posterior() -> None:
    """N log |r|^2 + |q / d|^2 is no smaller nearby (20 directions of gain and body)."""
    found = gain_estimate(fitted())
    problem, K = found.problem, np.array(found.K)
    logs, count = np.array(problem.logarithms), problem.recorded_numbers

    def objective(gain: Array, q: Array) -> float:
        r = residual_only(problem.at(problem.starts, q), gain, np.eye(1))
        return count * float(np.log(r @ r)) + float(np.sum((q / 0.03) ** 2))

    best, rng = objective(K, logs), np.random.default_rng(0)
    deviations = np.array(found.covariance.entries)
    for _ in range(20):
        step = rng.standard_normal((2, 2))
        there = objective(K + 0.3 * deviations * step[:1], logs + 0.3 * 0.03 * step[1])
        assert there > best - 0.05


def test_intervals_hold_where_they_do_not_for_an_exact_body() -> None:
    """Both coefficients 3 % off, four carts: 8 of 8 entries covered, 2 of 8 if taken as exact."""
    held = {"stated": 0, "exact": 0}
    for seed in (0, 4, 5, 6):
        person = cart_person(seed, 99, 0.0, "plant")
        assert person is not None
        problem, truth, _ = person
        for name, posed in (("stated", problem), ("exact", problem.with_body_fixed())):
            found = impc.fit(posed).intervals().iloc[:2]
            held[name] += int(((found.low <= truth[0]) & (truth[0] <= found.high)).sum())
    assert held["stated"] == 8
    assert held["exact"] <= 4


def test_an_uncertainty_of_zero_is_none() -> None:
    """Identical to the fit without the family."""
    person = cart_person(1, 99, 0.0)
    assert person is not None
    nothing = family(fall=0, damp="0 %")
    assert nothing.names == ()
    free = family(extra_delay=0)
    assert free.names == ("fall", "damp")
    assert free.make(free.nominal).n == 2
    given = person.problem
    posed = (given.plant, given.bounds, HORIZON, given.recordings)
    one, other = (
        impc.fit(Problem(*posed, unknown_start=True, family=made)) for made in (None, nothing)
    )
    np.testing.assert_array_equal(one.gain, other.gain)


def test_exact_recordings_of_the_nominal_body_are_explained() -> None:
    made = family(fall="3 %", damp="3 %")
    plant = made.make(made.nominal)
    bounds = impc.Bounds(plant, u_min=-LIMIT, u_max=LIMIT)
    law = impc.Controller(plant, impc.Weights(np.diag([4.0, 1.0]), 1), bounds, HORIZON)
    push = 0.25 * np.repeat(np.random.default_rng(0).choice([-1.0, 0, 1], 25), 16)
    trial = impc.Recording(plant, law.simulate([0, 0], disturbance=push).x[:-1, :1], push)
    found = impc.fit(Problem(plant, bounds, HORIZON, [trial], family=made, unknown_start=True))
    assert found.explained
    np.testing.assert_allclose(found.gain, law.K, rtol=1e-5)


def test_what_a_file_states_replaces_the_plants_own() -> None:
    def deviations(**stated: Any) -> dict[str, float]:
        source = plant_source(
            "plants:seated_balance_for", {"uncertainty": stated} if stated else {}
        )
        made = plant_family_of(source, ["perturbation"], [])
        return {} if made is None else dict(zip(made.names, made.deviations, strict=True))

    usual = deviations()
    assert len(usual) == 13
    assert usual["J2"] == pytest.approx(0.12)
    assert usual["tau_d"] == pytest.approx(0.01 / 0.08)
    assert deviations(all=0) == {}
    assert deviations(all=0, J2="7 %") == {"J2": pytest.approx(0.07)}
    assert deviations(tau_d=0.02)["tau_d"] == pytest.approx(0.25)


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        ({"wing": "3 %"}, "wing"),
        ({"J2": "much"}, "J2"),
        ({"J2": -1}, "J2"),
        ({"J2": True}, "J2"),
        ({"u_max": 3.0}, "a percentage of the limit"),
        ("no table", "is not a table"),
    ],
)
def test_what_cannot_be_stated(stated: Any, said: str) -> None:
    source = plant_source("plants:seated_balance_for", {"uncertainty": stated})
    with pytest.raises(InputError, match=said):
        plant_family_of(source, ["perturbation"], [])


def test_a_delay_needs_a_plant_that_can_have_one() -> None:
    with pytest.raises(InputError, match="more than 2 samples"):
        family(extra_delay=1.0)
    made = family(extra_delay=0.02)
    bounds, trial = impc.Bounds(cart(), u_min=-1, u_max=1), impc.Recording(cart(), np.ones((9, 1)))
    with pytest.raises(InputError, match=r"family.make\(family.nominal\)"):
        Problem(cart(), bounds, 5, [trial], family=made)
    source = plant_source("plants:seated_balance_for", {"uncertainty": {"extra_delay": 0.01}})
    seat = plant_family_of(source, ["perturbation"], [])
    assert seat is not None
    with pytest.raises(PlantError, match="model the delay in the body"):
        seat.make(seat.nominal)


def test_a_body_that_is_not_linear_follows_by_its_linear_part() -> None:
    """Derivatives by parameters of the seat's nonlinear body, against differences; at 4 Nm."""
    made = plant_family_of(plant_source("plants:seated_balance_for", {}), ["perturbation"], [])
    assert made is not None
    plant = made.make(made.nominal)
    assert plant.body is not None
    bounds = impc.Bounds(plant, u_min=-6, u_max=6)
    v = np.array([0.70, 0.65, 0.22, 0.20])
    Q = 1e-2 * np.eye(10)
    Q[:4, :4] += 6e5 * np.outer(v, v) + np.diag([2e4, 2e4, 500, 500])
    law = impc.Controller(plant, impc.Weights(Q, 1), bounds, 10, terminal_set=False)
    push = 3 * np.repeat(np.random.default_rng(0).choice([-1.0, 0, 1], 20), 25)
    trial = impc.Recording(plant, law.simulate(np.zeros(10), disturbance=push).outputs[:-1], push)
    problem = Problem(plant, bounds, 10, [trial], family=made, unknown_start=True)
    K, S, q = np.array(law.K), np.eye(1), np.full(13, 0.01)
    found = evaluate(problem.at(problem.starts, q), K, S).dparameters
    for place in (1, 7, 11):
        unit = 1e-4 * np.eye(13)[place]
        ends = [residual_only(problem.at(problem.starts, q + step), K, S) for step in (unit, -unit)]
        slope = (ends[0] - ends[1]) / 2e-4
        np.testing.assert_allclose(found[:, place], slope, atol=1e-5 * np.max(np.abs(slope)))
