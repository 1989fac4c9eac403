"""Results do not depend on the units of the recordings."""

from __future__ import annotations

import control
import numpy as np
import pytest

import impc
from impc.inverse.noisy_fit import fit_controller
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


@pytest.mark.parametrize(
    ("states", "inputs"),
    [*((one, one) for one in UNITS), (np.array([1e-3, 1.0, 1e3, 10.0]), np.array([100.0, 0.01]))],
)
def test_two_inputs_do_not_depend_on_units(states: np.ndarray, inputs: np.ndarray) -> None:
    """With x = diag(states) z and u = diag(inputs) v the gain becomes G^-1 K T."""
    controller, problem = random_problem(2, 2)
    T, G, (trial,) = np.eye(4) * states, np.eye(2) * inputs, problem.recordings
    moved = change_coordinates(problem.plant, T, G)
    B = np.hstack([moved.B, moved.E])
    plant = impc.Plant(control.ss(moved.A, B, np.eye(4), 0, True, inputs=["u0", "u1", "d0"]),
                       ["u0", "u1"])  # fmt: skip
    again = impc.Recording(plant, trial.outputs @ np.linalg.inv(T), trial.disturbance)
    limit = 1 / np.diag(G)
    bounds = impc.Bounds(plant, u_min=-limit, u_max=limit)
    other = impc.Problem(plant, bounds, problem.horizon, (again,), terminal_set=False)
    found, expected = inverse_mpc_reduced(other), np.linalg.solve(G, controller.K @ T)
    assert found.explained
    np.testing.assert_allclose(found.gain / expected, np.ones((2, 4)), rtol=1e-9)
    allowed = inverse_mpc_reduced(problem).evaluations * (1 if np.isscalar(states) else 2)
    assert found.evaluations <= allowed
    fitted = fit_controller(other).gain
    np.testing.assert_allclose(fitted / expected, np.ones((2, 4)), rtol=1e-8)


def test_output_scale_is_the_size_of_each_output() -> None:
    problem = example_problem("A")
    size = np.sqrt(np.mean(problem.recordings[0].outputs ** 2, axis=0))
    np.testing.assert_allclose(problem.output_scale, size, rtol=1e-12)
    silent = impc.Recording(problem.plant, np.array([[0.0, 3.0], [0.0, 4.0]]))
    quiet = impc.Problem(problem.plant, problem.bounds, 3, (silent,))
    np.testing.assert_allclose(quiet.output_scale, [np.sqrt(12.5)] * 2, rtol=1e-12)
