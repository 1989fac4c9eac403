"""Cost weights of a structure: exact recovery, zero cost weights, and noisy fits."""

from __future__ import annotations

from typing import Any

import control
import numpy as np
import pytest

import impc
import plants
from experiments.driver import with_noise
from experiments.printed_intervals import carts
from impc.inverse.residuals import misfit_or_reason
from impc.inverse.structured import fit_structure, search_from
from tests.support import nelder_mead, posed, regulator

BODY = ("theta1", "theta2", "theta1_rate", "theta2_rate")
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


def test_the_prices_of_the_seat_without_noise() -> None:
    """Ten seconds, from a gain that is 5 % wrong; the search starts at Bryson's rule."""
    plant = impc.Plant(plants.seated_balance_plant(), ["command"])
    shape, wanted = impc.Structure(plant, "diagonal", over=BODY), np.log([6e3, 9e3, 6e2, 4e2])
    truth = regulator(plant, shape.weights(wanted).Q, np.inf, 20)
    torque = plants.ternary_torque(duration=10.0, rate=100)
    run = truth.simulate(np.zeros(plant.n), disturbance=torque)
    trial = impc.Recording(plant, run.outputs[:-1], torque)
    problem = posed(truth, trial, terminal_set=False, unknown_start=True, structure=shape)
    found = fit_structure(problem, shape, 1.05 * truth.K, np.array(truth.S))
    assert np.max(np.abs(found.cost_weights - wanted)) < 1e-6
    assert found.misfit < 1e-9 * np.sqrt(2000)


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
    assert found.cost_weights is not None
    np.testing.assert_allclose(found.cost_weights, ONE, atol=1e-6)
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
