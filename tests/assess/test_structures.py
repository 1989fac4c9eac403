"""Structured fits: rank, standard errors, intervals and the score test."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import control
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

import plants
from experiments.printed_intervals import carts, with_noise
from experiments.structure_study import cart_person, seat_person
from impc.assess.structured_weights import Tangent, tangent, weight_covariance
from impc.assess.structures import structure_test
from impc.assess.weight_profiles import WeightProfiles
from impc.checking import replace
from impc.control.controller import Controller
from impc.inverse.problem import Problem
from impc.inverse.residuals import residual_only
from impc.inverse.structured import search_from
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.riccati import solve_lqr
from impc.model.structure import Structure

if TYPE_CHECKING:
    from collections.abc import Callable

BODY = ("theta1", "theta2", "theta1_rate", "theta2_rate")
SEAT = np.log([6e3, 9e3, 6e2, 4e2])
CARTS = np.log([4.0, 5.0, 1.0, 1.0, 1.0])


def seat_tangent(kind: str) -> Tangent:
    """Noise-free seat at the true weights of a structure that contains them."""
    plant = Plant(plants.seated_balance_plant(), ["command"])
    structure = Structure(plant, kind, over=BODY)
    cost_weights = SEAT if kind == "diagonal" else np.concatenate([SEAT / 2, np.zeros(6)])
    truth = Controller(
        plant, structure.weights(cost_weights), Bounds(plant), 20, terminal_set=False
    )
    torque = plants.ternary_torque(duration=10.0, rate=100)
    run = truth.simulate(np.zeros(plant.n), disturbance=torque)
    rng = np.random.default_rng(0)
    outputs = (run.x @ plant.C.T)[:-1] + 1e-9 * rng.standard_normal((1000, 2))
    trial = Recording(plant, outputs, torque)
    problem = Problem(plant, truth.bounds, 20, [trial], terminal_set=False, unknown_start=True)
    return tangent(structure, problem, cost_weights)


def test_the_seat_tells_four_prices_of_four() -> None:
    found = weight_covariance(seat_tangent("diagonal"))
    assert (found.rank, int(np.sum(found.identified))) == (4, 4)
    assert np.all(np.isfinite(found.each))


def test_of_ten_prices_and_products_the_seat_tells_four() -> None:
    """The controller predicts over the delay, so the gain has four degrees of freedom."""
    found = weight_covariance(seat_tangent("full"))
    assert found.rank == 4
    sizes = np.array(found.singular_values)
    assert sizes[3] / sizes[0] > 1e-2  # 1.5e-2, then 1e-7
    assert sizes[4] / sizes[0] < 1e-6
    # No unknown is individually identified: the others compensate for each cost weight.
    assert np.all(np.isinf(found.each))


@functools.cache
def fitted(seed: int = 0, cross: float = 0.0) -> Tangent:
    """Two carts at a VAF of 90 %, initial state unknown, started at the truth."""
    person = cart_person(seed, 90.0, 0.0, cross)
    end = search_from(person.problem, person.structure, person.cost_weights)
    return tangent(person.structure, end.problem, np.array(end.cost_weights))


def test_deviations_are_those_of_the_whole_normal_matrix() -> None:
    """White noise: s^2 times the inverse of H with all columns, by differences."""
    at = fitted()
    structure, problem = at.structure, at.problem
    starts = np.asarray(problem.starts)

    def residual(step: np.ndarray) -> np.ndarray:
        cost_weights, moved = np.split(step, [structure.count])
        there = problem.at(starts + moved.reshape(starts.shape), np.zeros(0))
        found = solve_lqr(there.plant, structure.weights(at.cost_weights + cost_weights))
        return residual_only(there, np.array(found.K), np.array(found.S))

    size, h = structure.count + starts.size, 1e-5
    columns = np.array(
        [(residual(h * row) - residual(-h * row)) / (2 * h) for row in np.eye(size)]
    ).T
    s2 = float(at.residual @ at.residual) / (len(at.residual) - size)
    whole = s2 * np.linalg.inv(columns.T @ columns)[: structure.count, : structure.count]
    found = weight_covariance(at)
    # The noise is estimated per output and differs by a few per cent.
    white = np.sqrt(np.diag(found.white))
    np.testing.assert_allclose(white, np.sqrt(np.diag(whole)), rtol=0.03)


@functools.cache
def fitted_seat() -> Tangent:
    """One trial of a subject whose weights are known to within a factor of ten.

    The quadratic form at the fit alone would end 1.3 (log cost weight) short.
    """
    person = seat_person(4, 99.0, 0.0)
    one = replace(person.problem, recordings=person.problem.recordings[:1])
    end = search_from(one, person.structure, person.cost_weights)
    return tangent(person.structure, end.problem, np.array(end.cost_weights))


@functools.cache
def fitted_scalar() -> Tangent:
    """Unstable plant near its limit, with so much noise that linearisation has no lower end.

    The misfit diverges towards the cost weight at which the plant does.
    """
    system = control.ss(
        [[1.2]], [[1, 1]], [[1]], 0, 1, inputs=["u", "d"], states=["x"], outputs=["x"]
    )
    plant = Plant(system, ["u"])
    structure, bounds = Structure(plant, ["x"]), Bounds(plant, u_min=-1.8, u_max=1.8)
    law = Controller(plant, structure.weights(np.zeros(1)), bounds, 5, terminal_set=False)
    push = np.repeat([1.0, -1.0, 0.0, 1.0, 0.0, -1.0], 40)
    x = law.simulate([0.0], disturbance=push).x[:-1]
    outputs = x + 8.0 * np.random.default_rng(0).standard_normal(x.shape)
    trial = Recording(plant, outputs, push)
    problem = Problem(plant, bounds, 5, [trial], terminal_set=False)
    end = search_from(problem, structure, np.zeros(1))
    return tangent(structure, end.problem, np.array(end.cost_weights))


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


def test_an_interval_has_no_end_where_the_misfit_stays() -> None:
    at = fitted_scalar()
    found = WeightProfiles(at, weight_covariance(at)).interval(np.eye(1)[0])
    assert found.high == np.inf
    assert tangent(at.structure, at.problem, np.array([found.low - 2.0])).found.reason


def _least(at: Tangent, value: float) -> float:
    """Least squares over all weights but the first, initial states free, on the recordings."""

    def reduced(others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        place = tangent(at.structure, at.problem, np.append(value, others))
        columns = np.column_stack([place.residual, place.on_cost_weights[:, 1:]])
        left = place.without_nuisance(columns) / at.noise
        return left[:, 0], left[:, 1:]

    starts = [np.array(at.cost_weights)[1:]]
    if len(starts[0]) == 0:
        return float(np.sum(reduced(starts[0])[0] ** 2))

    if at.structure.count == len(SEAT):
        starts.append(SEAT[1:])

    def residual(others: np.ndarray) -> np.ndarray:
        return reduced(others)[0]

    def slopes(others: np.ndarray) -> np.ndarray:
        return reduced(others)[1]

    searches = (
        scipy.optimize.least_squares(residual, start, jac=slopes, max_nfev=30) for start in starts
    )
    return float(2 * min(found.cost for found in searches))


def _start_columns(place: Tangent) -> np.ndarray:
    """Derivative by the initial state of every trial, zero outside the trial."""
    sizes = [trial.outputs.size for trial in place.problem.recordings]
    parts = np.split(np.asarray(place.found.own), np.cumsum(sizes)[:-1])
    return np.asarray(scipy.linalg.block_diag(*parts))


def test_a_price_of_zero_has_an_upper_end() -> None:
    at = fitted()
    cost_weights = np.array(at.cost_weights)
    cost_weights[3] = -np.inf  # zero cost weight of a speed, for any recordings
    bare = search_from(at.problem, at.structure, cost_weights)
    assert bare.cost_weights[3] == -np.inf
    place = tangent(at.structure, bare.problem, np.array(bare.cost_weights))
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
    """For white residuals T is (U'e)^2 / s^2, the one-step decrease towards the free gain.

    Against least squares with all columns of the gain.
    """
    at = fitted()
    tested = structure_test(at)
    gain, metric = at.gain_columns()
    starts = _start_columns(at)
    e = np.array(at.residual)

    def left(*columns: np.ndarray) -> float:
        rest = np.hstack(columns)
        found = np.linalg.lstsq(rest / np.linalg.norm(rest, axis=0), e, rcond=1e-10)[0]
        return float(np.sum((e - rest / np.linalg.norm(rest, axis=0) @ found) ** 2))

    fall = left(np.array(at.on_cost_weights), starts) - left(
        gain, np.array(at.on_cost_weights), starts
    )
    s2 = float(e @ e) / len(e)
    assert metric.shape[1] >= 1
    # The window of the sandwich and unequal noise of the outputs: 10 %.
    assert tested.statistic == pytest.approx(fall / s2, rel=0.15)


def test_nothing_to_test_where_prices_make_every_gain() -> None:
    """One cart: two cost weights and a gain of two entries."""
    plant = carts(1)
    structure = Structure(plant)
    truth = Controller(
        plant, structure.weights(np.log([4.0, 1.0])), Bounds(plant, u_min=-1, u_max=1), 6,
        terminal_set=False,
    )  # fmt: skip
    rng = np.random.default_rng(2)
    push = np.repeat(rng.choice([-0.8, 0.0, 0.8], (60, 1)), 10, axis=0)
    trial = with_noise(truth, push, rng, 90.0, 0.0)
    problem = Problem(plant, truth.bounds, 6, [trial], terminal_set=False)
    end = search_from(problem, structure, np.log([4.0, 1.0]))
    found = structure_test(tangent(structure, end.problem, np.array(end.cost_weights)))
    assert (found.freedom, found.probability, found.refused) == (0, 1.0, False)


def test_near_a_fit_the_misfit_is_that_of_the_recordings() -> None:
    """A few standard errors away, against a simulation with refitted initial states."""
    at = fitted()
    here = np.array(at.cost_weights)
    moved = here + 0.3 * np.array(weight_covariance(at).each) * [1, -1, 0.5, 0.5, 1]
    nothing = np.zeros((at.structure.count, 0))
    near, true = [], []
    for cost_weights in (here, moved):
        near.append(at.quadratic.least(cost_weights, nothing)[0])
        place = tangent(at.structure, at.problem, cost_weights)
        columns, e = _start_columns(place), np.array(place.residual)
        true.append(float(np.sum((e - columns @ np.linalg.lstsq(columns, e)[0]) ** 2)))
    assert near[1] - near[0] == pytest.approx(true[1] - true[0], rel=0.1)
