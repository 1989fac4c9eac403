"""Cost weights of a structure: exact recovery, zero cost weights, and noisy fits."""

from __future__ import annotations

import functools

import control
import numpy as np
import pytest

import impc
import plants
from experiments.printed_intervals import carts, with_noise
from impc.control.controller import Controller
from impc.errors import InputError, SolverError
from impc.inverse.laws import WeightLaw
from impc.inverse.problem import Problem
from impc.inverse.residuals import misfit_or_reason
from impc.inverse.structured import fit_structure, search_from
from impc.inverse.unknowns import Unknowns
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.plant_family import PlantFamily
from impc.model.recordings import Recording
from impc.model.riccati import solve_lqr
from impc.model.structure import Structure
from tests.support import extrapolated_slope, nelder_mead

BODY = ("theta1", "theta2", "theta1_rate", "theta2_rate")
SEAT = np.log([6e3, 9e3, 6e2, 4e2])


def pushed(
    structure: Structure,
    plant: Plant,
    cost_weights: np.ndarray,
    samples: int = 300,
    limit: float = 1.0,
) -> tuple[Controller, np.ndarray]:
    """Controller of the structure, and a push that drives it to its limits."""
    bounds = Bounds(plant, u_min=-limit, u_max=limit)
    rng = np.random.default_rng(5)
    push = np.repeat(rng.choice([-0.8, 0.0, 0.8], (samples // 10, plant.E.shape[1])), 10, axis=0)
    truth = Controller(plant, structure.weights(cost_weights), bounds, 6, terminal_set=False)
    return truth, push


def posed(truth: Controller, trial: Recording, **given: object) -> Problem:
    return Problem(
        truth.plant,
        truth.bounds,
        truth.horizon,
        [trial],
        terminal_set=False,
        **given,  # type: ignore[arg-type]
    )


@functools.cache
def seat() -> tuple[Problem, Controller]:
    """One noise-free trial of ten seconds of the seat, and its controller."""
    plant = Plant(plants.seated_balance_plant(), ["command"])
    structure = Structure(plant, "diagonal", over=BODY)
    truth = Controller(plant, structure.weights(SEAT), Bounds(plant), 20, terminal_set=False)
    torque = plants.ternary_torque(duration=10.0, rate=100)
    run = truth.simulate(np.zeros(plant.n), disturbance=torque)
    trial = Recording(plant, (run.x @ plant.C.T)[:-1], torque)
    problem = Problem(
        plant, truth.bounds, 20, [trial], terminal_set=False, unknown_start=True,
        structure=structure,
    )  # fmt: skip
    return problem, truth


def test_the_prices_of_the_seat_without_noise() -> None:
    """From a gain that is 5 % wrong; the search starts at Bryson's rule."""
    problem, truth = seat()
    structure = problem.structure
    assert structure is not None
    found = fit_structure(problem, structure, 1.05 * truth.K, np.array(truth.S))
    assert np.max(np.abs(found.cost_weights - SEAT)) < 1e-6
    assert found.misfit < 1e-9 * np.sqrt(2000)


@pytest.mark.parametrize("family", [False, True])
def test_derivatives_through_the_riccati_equation(family: bool) -> None:
    """Two inputs at their limits; with a family the plant changes the gain too."""
    plant = carts(2)
    structure = Structure(plant, ["x[0]", "x[1] - x[0]", "x[2]", "x[3]"], "full")
    cost_weights = np.concatenate([np.log([4.0, 5.0, 1.0, 1.0]), [0.1, 0.2]])
    truth, push = pushed(structure, plant, cost_weights)
    trial = with_noise(truth, push, np.random.default_rng(0), 90.0, 0.0)

    def stronger(values: np.ndarray) -> Plant:
        made = control.ss(
            plant.A, np.hstack([values[0] * plant.B, plant.E]), plant.C, 0, plant.dt,
            inputs=[*plant.controls, *plant.disturbances], outputs=list(plant.outputs),
        )  # fmt: skip
        return Plant(made, list(plant.controls))

    known = {"family": PlantFamily(stronger, ["strength"], [1.0])} if family else {}
    problem = posed(truth, trial, unknown_start=True, **known)
    space = Unknowns(problem, WeightLaw(structure, cost_weights + 0.3))
    z = space.start + 0.05
    exact = space.at(z).jacobian.T @ space.at(z).residual
    for index in range(len(z)):
        step = np.eye(len(z))[index]

        def half(h: float, step: np.ndarray = step) -> np.ndarray:
            return np.array(np.sum(space.at(z + h * step).residual ** 2) / 2)

        slope = extrapolated_slope(half, 1e-4)
        # Kinks where a limit becomes active: 1e-6 of the gradient.
        assert exact[index] == pytest.approx(float(slope), rel=1e-4, abs=1e-5 * abs(exact).max())


def test_a_price_that_is_not_needed_is_zero() -> None:
    """The second speed has no cost weight; noise decides whether its estimate is zero."""
    plant = carts(2)
    structure = Structure(plant)
    cost_weights = np.concatenate([np.log([4.0, 5.0, 1.0]), [-np.inf, 0.0]])
    truth, push = pushed(structure, plant, cost_weights, 800)
    zeros = 0
    for seed in range(4):
        trial = with_noise(truth, push, np.random.default_rng(seed), 90.0, 0.0)
        problem = posed(truth, trial)
        found = search_from(problem, structure, np.log([4.0, 5.0, 1.0, 0.3, 1.0]))
        zeros += int(found.cost_weights[3] == -np.inf)
        if found.cost_weights[3] == -np.inf:  # no small positive cost weight fits better
            for small in (1e-3, 1e-2):
                tried = np.array(found.cost_weights)
                tried[3] = np.log(small)
                solution = solve_lqr(plant, structure.weights(tried))
                size, _ = misfit_or_reason(problem, np.array(solution.K), np.array(solution.S))
                assert size > found.misfit
    assert 1 <= zeros <= 3  # half of the time in expectation


def test_no_search_without_derivatives_does_better() -> None:
    plant = carts(1)
    structure = Structure(plant)
    cost_weights = np.log([4.0, 1.0])
    truth, push = pushed(structure, plant, cost_weights)
    trial = with_noise(truth, push, np.random.default_rng(1), 80.0, 0.0)
    problem = posed(truth, trial, unknown_start=False)
    found = fit_structure(problem, structure, 0.8 * truth.K, np.array(truth.S))

    def objective(z: np.ndarray) -> float:
        solution = solve_lqr(plant, structure.weights(z))
        return misfit_or_reason(problem, np.array(solution.K), np.array(solution.S))[0]

    best = min(nelder_mead(objective, start, 200) for start in (cost_weights, cost_weights + 1.0))
    # The refinement stops when the misfit decreases by less than 1e-8 of itself.
    assert found.misfit == pytest.approx(best, rel=1e-7)


def test_the_method_of_the_registry() -> None:
    """Through `impc.fit`, with an estimate that has its cost weights."""
    plant = carts(1)
    structure = Structure(plant)
    truth, push = pushed(structure, plant, np.log([4.0, 1.0]))
    run = truth.simulate(np.zeros(2), disturbance=push)
    trial = Recording(plant, (run.x @ plant.C.T)[:-1], push)
    found = impc.fit(posed(truth, trial, structure=structure), "structured")
    assert found.explained
    assert found.cost_weights is not None
    np.testing.assert_allclose(found.cost_weights, np.log([4.0, 1.0]), atol=1e-6)
    np.testing.assert_allclose(found.stage_weights.Q, np.diag([4.0, 1.0]), rtol=1e-6)
    without = impc.fit(posed(truth, trial), "structured")
    assert without.K is None
    assert "the problem has no structure" in without.reason


def test_a_structure_of_another_plant_is_refused() -> None:
    truth, push = pushed(Structure(carts(1)), carts(1), np.log([4.0, 1.0]))
    run = truth.simulate(np.zeros(2), disturbance=push)
    trial = Recording(truth.plant, (run.x @ truth.plant.C.T)[:-1], push)
    with pytest.raises(
        InputError, match=r"^structure: has 4 states, but an earlier argument has 2"
    ):
        posed(truth, trial, structure=Structure(carts(2)))


def test_no_regulator_that_can_be_simulated() -> None:
    """Push far beyond the limit: the plant diverges for all cost weights."""
    system = control.ss([[3.0]], [[1.0, 1.0]], [[1.0]], 0, 1, inputs=["u", "push"])
    plant = Plant(system, ["u"])
    structure = Structure(plant)
    truth = Controller(plant, structure.weights(np.zeros(1)), Bounds(plant, u_min=-1, u_max=1), 3)
    trial = Recording(plant, np.zeros((900, 1)), np.full(900, 50.0))
    with pytest.raises(SolverError, match="no controller of this structure can be simulated"):
        fit_structure(posed(truth, trial), structure, np.array(truth.K), np.array(truth.S))
