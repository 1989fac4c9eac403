"""Results do not depend on the units of the recordings."""

from __future__ import annotations

import control
import numpy as np
import pytest

import impc
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.search import fit_gain
from impc.inverse.table31 import inverse_mpc_reduced
from impc.model.plant import change_coordinates
from tests.support import example_problem, random_problem

UNITS = [1e-12, 1e-5, 1e5, 1e12]


@pytest.mark.full
@pytest.mark.parametrize("name", ["A", "B"])
def test_table_3_1_does_not_depend_on_a_common_unit(name: str) -> None:
    plain = impc.table_3_1(example_problem(name))
    truth = impc.solve_lqr(example_problem(name).plant, impc.Weights(np.eye(2), 1)).K
    for scale in [1.0, *UNITS]:
        found = impc.table_3_1(example_problem(name, scale))
        assert found["inverse_mpc"].explained
        np.testing.assert_allclose(found["inverse_mpc"].gain, truth, rtol=1e-9)
        for line in ("feedback_gain", "inverse_mpc"):
            assert found[line].evaluations < 1.5 * plain[line].evaluations + 3


def in_units(problem: impc.Problem, states: np.ndarray, inputs: np.ndarray) -> impc.Problem:
    """x = diag(states) z, u = diag(inputs) v."""
    T, G = np.diag(states), np.diag(inputs)
    moved, (trial,) = change_coordinates(problem.plant, T, G), problem.recordings
    names = [f"u{i}" for i in range(moved.m)]
    B = np.hstack([moved.B, moved.E])
    system = control.ss(moved.A, B, np.eye(moved.n), 0, True, inputs=[*names, "d0"])
    plant = impc.Plant(system, names)
    z = np.linalg.solve(problem.plant.C @ T, trial.outputs.T).T
    again = impc.Recording(plant, z, trial.disturbance)
    bounds = impc.Bounds(plant, u_min=-1 / inputs, u_max=1 / inputs)
    return impc.Problem(plant, bounds, problem.horizon, (again,), terminal_set=False)


@pytest.mark.parametrize("scale", UNITS)
def test_two_inputs_do_not_depend_on_a_common_unit(scale: float) -> None:
    controller, problem = random_problem(2, 2)
    plant, (trial,) = problem.plant, problem.recordings
    bounds = impc.Bounds(plant, u_min=-scale, u_max=scale)
    scaled = impc.Recording(plant, scale * trial.outputs, scale * trial.disturbance)
    other = impc.Problem(plant, bounds, 5, (scaled,), terminal_set=False)
    found = inverse_mpc_reduced(other)
    assert found.explained
    np.testing.assert_allclose(found.gain, controller.K, rtol=1e-9, atol=1e-10)
    assert found.evaluations < 2 * inverse_mpc_reduced(problem).evaluations
    np.testing.assert_allclose(fit_controller(other).gain, controller.K, rtol=1e-8, atol=1e-9)


def test_states_and_inputs_in_units_of_their_own() -> None:
    """States and inputs in different units: the gain becomes G^-1 K T."""
    controller, problem = random_problem(2, 2)
    states, inputs = np.array([1e-3, 1.0, 1e3, 10.0]), np.array([100.0, 0.01])
    found = fit_gain(in_units(problem, states, inputs))
    assert found.explained
    expected = controller.K * states / inputs[:, None]
    np.testing.assert_allclose(found.K / expected, np.ones_like(expected), rtol=1e-9)


def test_output_scale_is_the_size_of_each_output() -> None:
    problem = example_problem("A")
    size = np.sqrt(np.mean(problem.recordings[0].outputs ** 2, axis=0))
    np.testing.assert_allclose(problem.output_scale, size, rtol=1e-12)
    silent = impc.Recording(problem.plant, np.array([[0.0, 3.0], [0.0, 4.0]]))
    quiet = impc.Problem(problem.plant, problem.bounds, 3, (silent,))
    np.testing.assert_allclose(quiet.output_scale, [np.sqrt(12.5)] * 2, rtol=1e-12)
