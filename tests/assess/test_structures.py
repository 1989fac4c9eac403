"""Structured fits: rank, standard errors, intervals and the score test."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

import impc
import plants
from experiments.driver import with_noise
from experiments.printed_intervals import carts
from experiments.structure_study import cart_person, seat_person
from impc.arrays import Array
from impc.assess.structured_weights import Tangent, tangent, weight_covariance
from impc.assess.structures import structure_test
from impc.assess.weight_profiles import WeightProfiles
from impc.inverse.residuals import residual_only
from impc.inverse.structured import search_from
from tests.support import differences, named_plant, posed, regulator

BODY = ("theta1", "theta2", "theta1_rate", "theta2_rate")
SEAT = np.log([6e3, 9e3, 6e2, 4e2])


def ended(problem: impc.Problem, structure: impc.Structure, start: Array) -> Tangent:
    """Where a search that starts there ends."""
    end = search_from(problem, structure, start)
    return tangent(structure, end.problem, np.array(end.cost_weights))


@functools.cache
def fitted(seed: int = 0, cross: float = 0.0) -> Tangent:
    """Two carts at a VAF of 90 %, initial state unknown, started at the truth."""
    person = cart_person(seed, 90.0, 0.0, cross)
    return ended(person.problem, person.structure, person.cost_weights)


@functools.cache
def fitted_seat() -> Tangent:
    """One trial of a subject: the quadratic form alone would end 1.3 (log weight) short."""
    person = seat_person(4, 99.0, 0.0)
    one = impc.replace(person.problem, recordings=person.problem.recordings[:1])
    return ended(one, person.structure, person.cost_weights)


@functools.cache
def fitted_scalar() -> Tangent:
    """Unstable plant with so much noise that linearisation has no lower end."""
    plant = named_plant([[1.2]], [[1, 1]], [[1]], 1, "x", "u d", "x")
    structure, law = impc.Structure(plant, ["x"]), regulator(plant, 1, 1.8, 5)
    push = np.repeat([1.0, -1.0, 0.0, 1.0, 0.0, -1.0], 40)
    x = law.simulate([0.0], disturbance=push).x[:-1]
    noise = 8.0 * np.random.default_rng(0).standard_normal(x.shape)
    problem = posed(law, impc.Recording(plant, x + noise, push), terminal_set=False)
    return ended(problem, structure, np.zeros(1))


def seat_problem(
    kind: str, cost_weights: Any, noise: float = 0.0
) -> tuple[impc.Controller, impc.Problem, impc.Structure]:
    """Ten seconds of the seat without a limit, under weights over angles and rates."""
    plant = impc.Plant(plants.seated_balance_plant(), ["command"])
    shape, rng = impc.Structure(plant, kind, over=BODY), np.random.default_rng(0)
    truth = regulator(plant, shape.weights(cost_weights).Q, np.inf, 20)
    torque = plants.ternary_torque(duration=10.0, rate=100)
    y = truth.simulate(np.zeros(plant.n), disturbance=torque).outputs[:-1]
    trial = impc.Recording(plant, y + noise * rng.standard_normal(y.shape), torque)
    given: Any = {"terminal_set": False, "unknown_start": True, "structure": shape}
    return truth, posed(truth, trial, **given), shape


@pytest.mark.parametrize("kind", ["diagonal", "full"])
def test_the_seat_identifies_four_cost_weights(kind: str) -> None:
    """Of four, or of ten with products: the controller predicts over the delay."""
    full = kind == "full"
    cost_weights = np.concatenate([SEAT / 2, np.zeros(6)]) if full else SEAT
    _, problem, structure = seat_problem(kind, cost_weights, 1e-9)
    found = weight_covariance(tangent(structure, problem, cost_weights))
    assert found.rank == 4
    if full:
        sizes = np.array(found.singular_values)
        assert sizes[3] / sizes[0] > 1e-2  # 1.5e-2, then 1e-7
        assert sizes[4] / sizes[0] < 1e-6
        # No unknown is individually identified: the others compensate for each cost weight.
        assert np.all(np.isinf(found.each))
    else:
        assert int(np.sum(found.identified)) == 4
        assert np.all(np.isfinite(found.each))


def test_deviations_are_those_of_the_whole_normal_matrix() -> None:
    """White noise: s^2 times the inverse of H with all columns, by differences."""
    at = fitted()
    structure, problem, starts = at.structure, at.problem, np.asarray(at.problem.starts)

    def residual(step: Array) -> Array:
        cost_weights, moved = np.split(step, [structure.count])
        there = problem.at(starts + moved.reshape(starts.shape), np.zeros(0))
        found = impc.solve_lqr(there.plant, structure.weights(at.cost_weights + cost_weights))
        return residual_only(there, np.array(found.K), np.array(found.S))

    columns = differences(residual, np.zeros(structure.count + starts.size), 1e-5)
    s2 = float(at.residual @ at.residual) / (len(at.residual) - columns.shape[1])
    whole = np.sqrt(s2 * np.diag(np.linalg.inv(columns.T @ columns))[: structure.count])
    # The noise is estimated per output and differs by a few per cent.
    white = np.sqrt(np.diag(weight_covariance(at).white))
    np.testing.assert_allclose(white, whole, rtol=0.03)


@pytest.mark.parametrize(
    ("fit", "tolerance"),
    [(fitted, 0.05), pytest.param(fitted_seat, 0.1, marks=pytest.mark.full), (fitted_scalar, 0.1)],
)
def test_an_interval_ends_where_the_misfit_has_grown(
    fit: Callable[[], Tangent], tolerance: float
) -> None:
    """Against searches of the recordings with the cost weight fixed at the end."""
    at = fit()
    covariance, row = weight_covariance(at), np.eye(at.structure.count)[0]
    found = WeightProfiles(at, covariance).interval(row)
    best = _least(at, float(at.cost_weights[0]))
    ends = [end for end in (found.low, found.high) if np.isfinite(end)]
    assert len(ends) == (1 if fit is fitted_scalar else 2)
    for end in ends:
        grown = (len(at.residual) - covariance.rank) * (_least(at, end) / best - 1)
        # The search ends within 1/50 of a standard error, 2 % of D.
        assert grown == pytest.approx(3.84 * covariance.spread(row)[1] ** 2, rel=tolerance)
    if fit is fitted_scalar:  # the misfit stays above, and diverges below
        assert found.high == np.inf
        assert tangent(at.structure, at.problem, np.array([found.low - 2.0])).reason


def _least(at: Tangent, value: float) -> float:
    """Least squares over all weights but the first, initial states free, on the recordings."""

    def reduced(others: Array) -> Array:
        """Residual, and its derivatives by the other weights."""
        place = tangent(at.structure, at.problem, np.append(value, others))
        columns = np.column_stack([place.residual, place.on_cost_weights[:, 1:]])
        return place.without_nuisance(columns) / at.noise

    def residual(others: Array) -> Array:
        return reduced(others)[:, 0]

    def slopes(others: Array) -> Array:
        return reduced(others)[:, 1:]

    starts = [np.array(at.cost_weights)[1:]]
    if len(starts[0]) == 0:
        return float(np.sum(residual(starts[0]) ** 2))
    if at.structure.count == len(SEAT):
        starts.append(SEAT[1:])
    fits = [scipy.optimize.least_squares(residual, z, jac=slopes, max_nfev=30) for z in starts]
    return float(2 * min(found.cost for found in fits))


def _start_columns(place: Tangent) -> Array:
    """Derivative by the initial state of every trial, zero outside the trial."""
    sizes = [trial.outputs.size for trial in place.problem.recordings]
    parts = np.split(np.asarray(place.own), np.cumsum(sizes)[:-1])
    return np.asarray(scipy.linalg.block_diag(*parts))


def _left(e: Array, *columns: Array) -> float:
    """Sum of squares that the columns leave."""
    rest = np.hstack(columns)
    rest = rest / np.linalg.norm(rest, axis=0)
    return float(np.sum((e - rest @ np.linalg.lstsq(rest, e, rcond=1e-10)[0]) ** 2))


def test_a_price_of_zero_has_an_upper_end() -> None:
    at = fitted()
    cost_weights = np.array(at.cost_weights)
    cost_weights[3] = -np.inf  # zero cost weight of a speed, for any recordings
    place = ended(at.problem, at.structure, cost_weights)
    assert place.cost_weights[3] == -np.inf
    covariance = weight_covariance(place)
    assert np.isinf(covariance.each[3])
    assert covariance.values[3] == -np.inf
    found = WeightProfiles(place, covariance).zero(3)
    assert (found.low, found.value) == (-np.inf, -np.inf)
    assert np.isfinite(found.high)
    assert found.holds(-np.inf)


def test_the_structure_that_holds_is_not_refused_and_a_cross_term_is() -> None:
    holds, crossed = structure_test(fitted()), structure_test(fitted(0, 0.5))
    assert min(holds.freedom, crossed.freedom) >= 3
    assert not holds.refused
    assert crossed.refused
    first = next(item for item in holds.powers if (item.first, item.second) == ("x[0]", "x[1]"))
    assert first.power > 0.99  # and it is rejected in 5 of 5 subjects of the study


def test_the_statistic_is_the_one_step_fall_of_the_misfit() -> None:
    """White residuals: T is (U'e)^2 / s^2, against least squares with all gain columns."""
    at = fitted()
    gain, metric = np.split(at.on_law, [at.solution.K.size], axis=1)
    e, others = np.array(at.residual), (np.array(at.on_cost_weights), _start_columns(at))
    fall = _left(e, *others) - _left(e, gain, *others)
    assert metric.shape[1] >= 1
    # The window of the sandwich and unequal noise of the outputs: 10 %.
    assert structure_test(at).statistic == pytest.approx(fall / (e @ e / len(e)), rel=0.15)


def test_nothing_to_test_where_prices_make_every_gain() -> None:
    """One cart: two cost weights and a gain of two entries."""
    structure, start, rng = impc.Structure(carts(1)), np.log([4.0, 1.0]), np.random.default_rng(2)
    truth = regulator(carts(1), np.diag([4.0, 1.0]), 1, 6)
    push = np.repeat(rng.choice([-0.8, 0.0, 0.8], (60, 1)), 10, axis=0)
    problem = posed(truth, with_noise(truth, push, rng, 90.0, 0.0), terminal_set=False)
    found = structure_test(ended(problem, structure, start))
    assert (found.freedom, found.probability, found.refused) == (0, 1.0, False)
