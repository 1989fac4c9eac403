"""Cost weights of a structure: exact, zero and noisy; the span of the gains of its weights."""

from __future__ import annotations

import functools
from typing import Any

import control
import numpy as np
import pytest
import scipy.linalg

import impc
from experiments.driver import with_noise
from experiments.printed_intervals import carts
from impc.arrays import Array
from impc.inverse.laws import GainLaw
from impc.inverse.regulator_span import kept_to, regulators_alone
from impc.inverse.residuals import misfit_or_reason
from impc.inverse.solution_set import natural_coordinates
from impc.inverse.structured import fit_structure, search_from
from impc.inverse.unknowns import Unknowns
from impc.output_feedback.simulation import simulate_person
from tests.support import extrapolated_slope, named_plant, nelder_mead, posed, present, regulator

ONE = np.log([4.0, 1.0])


def pushed(
    structure: impc.Structure, plant: impc.Plant, cost_weights: Any, samples: int = 300
) -> tuple[impc.Controller, np.ndarray]:
    """Controller of the structure, and a push that drives it to its limits."""
    rng, weights = np.random.default_rng(5), structure.weights(cost_weights)
    push = np.repeat(rng.choice([-0.8, 0.0, 0.8], (samples // 10, plant.E.shape[1])), 10, axis=0)
    return regulator(plant, weights.Q, 1, 6, weights.R), push


def size_of(problem: impc.Problem, structure: impc.Structure, cost_weights: Any) -> float:
    solution = impc.solve_lqr(problem.plant, structure.weights(cost_weights))
    return misfit_or_reason(problem, np.array(solution.K), np.array(solution.S))[0]


def test_a_price_that_is_not_needed_is_zero() -> None:
    """The second speed has no cost weight; noise decides whether its estimate is zero."""
    plant = carts(2)
    structure, zeros = impc.Structure(plant), 0
    cost_weights = np.concatenate([np.log([4.0, 5.0, 1.0]), [-np.inf, 0.0]])
    truth, push = pushed(structure, plant, cost_weights, 800)
    for seed in range(4):
        trial = with_noise(truth, push, np.random.default_rng(seed), 90.0, 0.0)
        problem = posed(truth, trial, terminal_set=False)
        found = search_from(problem, structure, np.log([4.0, 5.0, 1.0, 0.3, 1.0]))
        if found.cost_weights[3] == -np.inf:  # no small positive cost weight fits better
            zeros += 1
            for small in (1e-3, 1e-2):
                tried = np.array(found.cost_weights)
                tried[3] = np.log(small)
                assert size_of(problem, structure, tried) > found.misfit
    assert 1 <= zeros <= 3  # half of the time in expectation


def test_no_search_without_derivatives_does_better() -> None:
    plant = carts(1)
    structure = impc.Structure(plant)
    truth, push = pushed(structure, plant, ONE)
    trial = with_noise(truth, push, np.random.default_rng(1), 80.0, 0.0)
    problem = posed(truth, trial, terminal_set=False, unknown_start=False)
    found = fit_structure(problem, structure, 0.8 * truth.K, np.array(truth.S))
    best = min(
        nelder_mead(lambda z: size_of(problem, structure, z), start, 200)
        for start in (ONE, ONE + 1.0)
    )
    # The refinement stops when the misfit decreases by less than 1e-8 of itself.
    assert found.misfit == pytest.approx(best, rel=1e-7)


def test_the_method_of_the_registry() -> None:
    """Through `impc.fit`, with an estimate that has its cost weights."""
    plant, structure = carts(1), impc.Structure(carts(1))
    truth, push = pushed(structure, plant, ONE)
    trial = impc.Recording(plant, truth.simulate([0, 0], disturbance=push).outputs[:-1], push)
    found = impc.fit(posed(truth, trial, terminal_set=False, structure=structure), "structured")
    assert found.explained
    np.testing.assert_allclose(present(found.cost_weights), ONE, atol=1e-6)
    np.testing.assert_allclose(found.stage_weights.Q, np.diag([4.0, 1.0]), rtol=1e-6)
    without = impc.fit(posed(truth, trial, terminal_set=False), "structured")
    assert without.K is None
    assert "the problem has no structure" in without.reason
    said = r"^structure: has 4 states, but an earlier argument has 2"
    with pytest.raises(impc.InputError, match=said):
        posed(truth, trial, structure=impc.Structure(carts(2)))


def test_no_regulator_that_can_be_simulated() -> None:
    """Push far beyond the limit: the plant diverges for all cost weights."""
    system = control.ss([[3.0]], [[1.0, 1.0]], [[1.0]], 0, 1, inputs=["u", "push"])
    plant = impc.Plant(system, ["u"])
    truth = regulator(plant, 1, 1, 3)
    trial = impc.Recording(plant, np.zeros((900, 1)), np.full(900, 50.0))
    problem = posed(truth, trial, terminal_set=False)
    with pytest.raises(impc.SolverError, match="no controller of this structure can be simulated"):
        fit_structure(problem, impc.Structure(plant), np.array(truth.K), np.array(truth.S))


_BODY = np.array([[1.0, 0.1], [0.05, 0.98]])
_LATE = 3
_Q = np.diag([6.0, 1.0, 0, 0, 0])


def late_body() -> impc.Plant:
    """Unstable body of two states; the command arrives three samples late."""
    A = np.zeros((2 + _LATE, 2 + _LATE))
    A[:2, :2], A[:2, 2], A[2:-1, 3:] = _BODY, [0.0, 0.1], np.eye(_LATE - 1)
    inputs = np.zeros((len(A), 2))
    inputs[-1, 0], inputs[1, 1] = 1.0, 0.1
    return named_plant(A, inputs, np.eye(5)[:1], 0.1, "p v late_3 late_2 late_1", "u push", "p")


def weighed(plant: impc.Plant, rng: np.random.Generator) -> Array:
    """Gain of random weights on the body, by scipy's Riccati solver."""
    root = rng.normal(size=(2, 2))
    Q = scipy.linalg.block_diag(root @ root.T, np.zeros((_LATE, _LATE)))
    P = scipy.linalg.solve_discrete_are(plant.A, plant.B, Q, np.eye(1))
    return np.asarray(np.linalg.solve(1 + plant.B.T @ P @ plant.B, plant.B.T @ P @ plant.A))


def spanned(structure: impc.Structure, plant: impc.Plant, gain: Array) -> Array:
    return regulators_alone(plant, structure, natural_coordinates(plant, gain)[0])


def outside(found: Array, gain: Array) -> float:
    """Share of a gain outside the span."""
    rows, row = found.reshape(len(found), -1), np.ravel(gain)
    left = row - np.linalg.lstsq(rows.T, row, rcond=None)[0] @ rows
    return float(np.linalg.norm(left) / np.linalg.norm(row))


@pytest.mark.parametrize("features", ["full", "diagonal", ["p", "v"], ["p", "v - p", "p + v"]])
def test_over_a_delay_the_controller_predicts(features: str | list[str]) -> None:
    """K = K_b (A^3, A^2 b, A b, b) for all cost weights of the body: two dimensions of five."""
    plant, rng = late_body(), np.random.default_rng(0)
    over = ["p", "v"] if isinstance(features, str) else None
    found = spanned(impc.Structure(plant, features, over=over), plant, weighed(plant, rng))
    assert len(found) == 2
    b = plant.A[:2, 2:3]
    powers = [np.linalg.matrix_power(_BODY, k) for k in range(_LATE + 1)]
    predicted = np.hstack([powers[_LATE], *(powers[k] @ b for k in range(_LATE - 1, -1, -1))])
    for _ in range(5):
        gain = weighed(plant, rng)
        on_body = np.linalg.lstsq(predicted.T, gain[0], rcond=None)[0]
        np.testing.assert_allclose(on_body @ predicted, gain[0], rtol=1e-9)
        assert outside(found, gain) < 1e-9
    assert outside(found, np.eye(5)[4]) > 0.1  # a gain on the delay alone is outside


@functools.cache
def late_trials() -> tuple[impc.Controller, tuple[impc.Recording, ...]]:
    plant = late_body()
    law, rng, trials = regulator(plant, _Q, 1, 8, 0.2), np.random.default_rng(4), []
    person = impc.Observer(plant, ["p", "v"], motor=0.1, sensory=0.02)
    for seed in range(2):
        push = np.repeat(rng.choice([-0.6, 0.0, 0.6], 40), 10)
        found = simulate_person(law, person, push, recorder=0.005, seed=seed)
        assert np.any(np.abs(found.u) >= 1 - 1e-9)
        trials.append(impc.Recording(plant, found.outputs, push))
    return law, tuple(trials)


def late_problem(**given: object) -> impc.Problem:
    law, trials = late_trials()
    return posed(law, *trials, terminal_set=False, unknown_start=True, **given)


def test_a_structure_that_prices_every_state_keeps_no_gain_out() -> None:
    plant = late_body()
    shape = impc.Structure(plant, ["p", "v"])
    family = impc.PlantFamily(lambda _: plant, ["mass"], [1.0])
    assert kept_to(late_problem()) is None
    assert kept_to(late_problem(structure=impc.Structure(plant, "diagonal"))) is None
    assert kept_to(late_problem(structure=shape)) is shape
    assert kept_to(late_problem(structure=shape, family=family)) is None


@pytest.mark.full
def test_a_person_is_searched_within_the_span() -> None:
    """Three unknowns fewer, a predicting gain, and derivatives equal to finite differences."""
    problem = late_problem(structure=impc.Structure(late_body(), ["p", "v"]))
    person = impc.Observer(problem.plant, ["p", "v"], motor=0.1, sensory=[0.02, 0.02])
    first = impc.fit(problem)
    found = impc.fit_output_feedback(first, person)
    assert found.converged
    assert found.space.gain == 2
    np.testing.assert_allclose(found.K, late_trials()[0].K, rtol=0.3)
    closed = np.abs(np.linalg.eigvals(problem.plant.A - problem.plant.B @ found.K))
    np.testing.assert_allclose(np.sort(closed)[:_LATE], 0, atol=1e-3)  # cube root of 1e-15
    step = np.random.default_rng(5).normal(size=len(found.theta))
    slope = extrapolated_slope(
        lambda t: np.array([found.space.value(found.theta + t * step)]), 1e-3
    )[0]
    assert found.identified.gradient @ step == pytest.approx(slope, rel=1e-6)


def test_the_search_begins_next_to_the_gain_that_is_given() -> None:
    structure = impc.Structure(late_body(), ["p", "v"])
    problem = late_problem(structure=structure)
    gain = weighed(problem.plant, np.random.default_rng(6))
    law = GainLaw(problem, gain, np.eye(1), spanned(structure, problem.plant, gain))
    space = Unknowns(problem, law)
    np.testing.assert_allclose(space.unpack(space.start).K, gain, rtol=1e-8)
