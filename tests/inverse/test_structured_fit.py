"""Cost weights of a structure: exact recovery, zero cost weights, and noisy fits."""

from __future__ import annotations

import functools
from typing import Any

import control
import numpy as np
import pytest

import impc
import plants
from experiments.printed_intervals import carts, with_noise
from impc.inverse.laws import WeightLaw
from impc.inverse.residuals import misfit_or_reason
from impc.inverse.structured import fit_structure, search_from
from impc.inverse.unknowns import Unknowns
from tests.support import extrapolated_jacobian, nelder_mead, posed

SEAT = np.log([6e3, 9e3, 6e2, 4e2])
BODY = ("theta1", "theta2", "theta1_rate", "theta2_rate")
ONE = np.log([4.0, 1.0])


def pushed(
    structure: impc.Structure, plant: impc.Plant, cost_weights: Any, samples: int = 300
) -> tuple[impc.Controller, np.ndarray]:
    """Controller of the structure, and a push that drives it to its limits."""
    bounds, rng = impc.Bounds(plant, u_min=-1, u_max=1), np.random.default_rng(5)
    push = np.repeat(rng.choice([-0.8, 0.0, 0.8], (samples // 10, plant.E.shape[1])), 10, axis=0)
    weights = structure.weights(cost_weights)
    return impc.Controller(plant, weights, bounds, 6, terminal_set=False), push


@functools.cache
def exact_cart() -> tuple[impc.Controller, impc.Recording]:
    plant = carts(1)
    truth, push = pushed(impc.Structure(plant), plant, ONE)
    run = truth.simulate(np.zeros(2), disturbance=push)
    return truth, impc.Recording(plant, (run.x @ plant.C.T)[:-1], push)


def size_of(problem: impc.Problem, structure: impc.Structure, cost_weights: Any) -> float:
    solution = impc.solve_lqr(problem.plant, structure.weights(cost_weights))
    return misfit_or_reason(problem, np.array(solution.K), np.array(solution.S))[0]


def test_the_prices_of_the_seat_without_noise() -> None:
    """Ten seconds, from a gain that is 5 % wrong; the search starts at Bryson's rule."""
    plant = impc.Plant(plants.seated_balance_plant(), ["command"])
    shape = impc.Structure(plant, "diagonal", over=BODY)
    truth = impc.Controller(plant, shape.weights(SEAT), impc.Bounds(plant), 20, terminal_set=False)
    torque = plants.ternary_torque(duration=10.0, rate=100)
    run = truth.simulate(np.zeros(plant.n), disturbance=torque)
    trial = impc.Recording(plant, (run.x @ plant.C.T)[:-1], torque)
    problem = posed(truth, trial, terminal_set=False, unknown_start=True, structure=shape)
    found = fit_structure(problem, shape, 1.05 * truth.K, np.array(truth.S))
    assert np.max(np.abs(found.cost_weights - SEAT)) < 1e-6
    assert found.misfit < 1e-9 * np.sqrt(2000)


@pytest.mark.parametrize("family", [False, True])
def test_derivatives_through_the_riccati_equation(family: bool) -> None:
    """Two inputs at their limits; with a family the plant changes the gain too."""
    plant = carts(2)
    structure = impc.Structure(plant, ["x[0]", "x[1] - x[0]", "x[2]", "x[3]"], "full")
    cost_weights = np.concatenate([np.log([4.0, 5.0, 1.0, 1.0]), [0.1, 0.2]])
    truth, push = pushed(structure, plant, cost_weights)
    trial = with_noise(truth, push, np.random.default_rng(0), 90.0, 0.0)

    def stronger(values: np.ndarray) -> impc.Plant:
        made = control.ss(
            plant.A, np.hstack([values[0] * plant.B, plant.E]), plant.C, 0, plant.dt,
            inputs=[*plant.controls, *plant.disturbances], outputs=list(plant.outputs),
        )  # fmt: skip
        return impc.Plant(made, list(plant.controls))

    known = {"family": impc.PlantFamily(stronger, ["strength"], [1.0])} if family else {}
    problem = posed(truth, trial, terminal_set=False, unknown_start=True, **known)
    space = Unknowns(problem, WeightLaw(structure, cost_weights + 0.3))
    z = space.start + 0.05
    exact = space.at(z).jacobian.T @ space.at(z).residual
    (slope,) = extrapolated_jacobian(
        lambda z: np.array(np.sum(space.at(z).residual ** 2) / 2), z, 1e-4
    )
    # Kinks where a limit becomes active: 1e-6 of the gradient.
    assert exact == pytest.approx(slope, rel=1e-4, abs=1e-5 * np.max(np.abs(exact)))


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
    truth, trial = exact_cart()
    structure = impc.Structure(truth.plant)
    problem = posed(truth, trial, terminal_set=False, structure=structure)
    found = impc.fit(problem, "structured")
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
    structure, bounds = impc.Structure(plant), impc.Bounds(plant, u_min=-1, u_max=1)
    truth = impc.Controller(plant, structure.weights(np.zeros(1)), bounds, 3)
    trial = impc.Recording(plant, np.zeros((900, 1)), np.full(900, 50.0))
    problem = posed(truth, trial, terminal_set=False)
    with pytest.raises(impc.SolverError, match="no controller of this structure can be simulated"):
        fit_structure(problem, structure, np.array(truth.K), np.array(truth.S))
