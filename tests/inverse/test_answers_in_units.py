"""Results do not depend on the units of the recordings."""

from __future__ import annotations

import control
import numpy as np
import pytest

from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.simulation import scenario
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.problem import Problem
from impc.inverse.search import fit_gain
from impc.inverse.table31 import inverse_mpc_reduced, table_3_1
from impc.model.bounds import Bounds
from impc.model.plant import Plant, change_coordinates
from impc.model.recordings import Recording
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights
from impc.studies.example.cases import CASES
from tests.inverse.test_several_inputs import random_problem

UNITS = [1e-12, 1e-5, 1e5, 1e12]


def recorded(scale: float, name: str) -> Problem:
    """The example with all numbers, bounds too, `scale` times as large."""
    plant = Plant(control.ss([[2, -1], [1, 0.2]], [[1], [0]], np.eye(2), 0, True))
    bounds = Bounds(plant, u_min=-scale, u_max=scale)
    controller = Controller(plant, Weights(np.eye(2), 1), bounds, 3)
    run = simulate(controller, scenario(plant, x0=scale * np.array(CASES[name]), steps=20))
    return Problem(plant, bounds, 3, (Recording(plant, run.x),))


@pytest.mark.full
@pytest.mark.parametrize("name", ["A", "B"])
def test_table_3_1_does_not_depend_on_a_common_unit(name: str) -> None:
    """All values 1e12 times as large."""
    plain = table_3_1(recorded(1.0, name))
    truth = solve_lqr(plain["inverse_mpc"].problem.plant, Weights(np.eye(2), 1)).K
    for scale in [1.0, *UNITS]:
        found = table_3_1(recorded(scale, name))
        assert found["inverse_mpc"].explained
        np.testing.assert_allclose(found["inverse_mpc"].gain, truth, rtol=1e-9)
        for line in ("feedback_gain", "inverse_mpc"):
            assert found[line].evaluations < 1.5 * plain[line].evaluations + 3


@pytest.mark.parametrize("scale", UNITS)
def test_two_inputs_do_not_depend_on_a_common_unit(scale: float) -> None:
    controller, problem = random_problem(2, 2)
    plant, (trial,) = problem.plant, problem.recordings
    bounds = Bounds(plant, u_min=-scale, u_max=scale)
    scaled = Recording(plant, scale * trial.outputs, scale * trial.disturbance)
    other = Problem(plant, bounds, 5, (scaled,), terminal_set=False)
    found = inverse_mpc_reduced(other)
    assert found.explained
    np.testing.assert_allclose(found.gain, controller.K, rtol=1e-9, atol=1e-10)
    assert found.evaluations < 2 * inverse_mpc_reduced(problem).evaluations
    np.testing.assert_allclose(fit_controller(other).gain, controller.K, rtol=1e-8, atol=1e-9)


def in_units(problem: Problem, states: np.ndarray, inputs: np.ndarray) -> Problem:
    """x = diag(states) z, u = diag(inputs) v."""
    T, G = np.diag(states), np.diag(inputs)
    moved: Plant = change_coordinates(problem.plant, T, G)
    outputs = problem.plant.C @ T
    plant = Plant(
        control.ss(
            moved.A,
            np.hstack([moved.B, moved.E]),
            np.eye(moved.n),
            0,
            True,
            inputs=[*(f"u{i}" for i in range(moved.m)), "d0"],
        ),
        [f"u{i}" for i in range(moved.m)],
    )
    (trial,) = problem.recordings
    bounds = Bounds(plant, u_min=-1 / inputs, u_max=1 / inputs)
    z = np.linalg.solve(outputs, trial.outputs.T).T
    return Problem(
        plant,
        bounds,
        problem.horizon,
        (Recording(plant, z, trial.disturbance),),
        terminal_set=False,
    )


def test_states_and_inputs_in_units_of_their_own() -> None:
    """States and inputs in different units: the gain becomes G^-1 K T."""
    controller, problem = random_problem(2, 2)
    states, inputs = np.array([1e-3, 1.0, 1e3, 10.0]), np.array([100.0, 0.01])
    found = fit_gain(in_units(problem, states, inputs))
    assert found.explained
    expected = controller.K * states / inputs[:, None]
    np.testing.assert_allclose(found.K / expected, np.ones_like(expected), rtol=1e-9)


def test_output_scale_is_the_size_of_each_output() -> None:
    problem = recorded(1.0, "A")
    size = np.sqrt(np.mean(problem.recordings[0].outputs ** 2, axis=0))
    np.testing.assert_allclose(problem.output_scale, size, rtol=1e-12)
    plant, outputs = problem.plant, np.array([[0.0, 3.0], [0.0, 4.0]])
    silent = Problem(plant, problem.bounds, 3, (Recording(plant, outputs),))
    np.testing.assert_allclose(silent.output_scale, [np.sqrt(12.5)] * 2, rtol=1e-12)
