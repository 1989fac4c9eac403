"""One-step-ahead predictions against the explicit filter recursion, and limiting cases."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg

import impc
from experiments.search_problems import random_problem, stick_problem
from impc.inverse.laws import GainLaw
from impc.inverse.prediction import Correction, correction
from impc.inverse.residuals import residual_or_reason
from impc.inverse.unknowns import linear_at


@pytest.mark.parametrize("ratio", [1.0, 10.0])
def test_the_corrected_loop_is_the_recursion(ratio: float) -> None:
    """Stick with a limit: predict, correct by the innovation, clip the command (horizon 1)."""
    known = next(filter(None, map(stick_problem, range(50))))
    problem = impc.replace(known.problem, horizon=1, terminal_set=False)
    plant, (trial,) = problem.plant, problem.recordings
    residual, _ = residual_or_reason(problem, known.K, known.S, correction(problem, ratio))
    M, limit = correction(problem, ratio).M, problem.bounds.u_max
    x, errors = np.array(trial.x0), []
    for y, d in zip(trial.outputs, trial.disturbance, strict=True):
        errors.append(y - plant.C @ x)
        x = x + M @ errors[-1]
        u = np.clip(-known.K @ x, -limit, limit)
        x = plant.A @ x + plant.B @ u + plant.E @ d
    scaled = np.array(errors) / problem.output_scale
    np.testing.assert_allclose(np.abs(residual), np.abs(scaled.ravel()), atol=1e-10)


def test_the_filter_is_steady_and_stable() -> None:
    """The filter gain solves the Riccati equation (checked by iterating the covariance)."""
    known = random_problem(3, half=True)
    assert known is not None
    problem, plant = known.problem, known.problem.plant
    M = correction(problem, 1.0).M
    loop = (np.eye(plant.n) - M @ plant.C) @ plant.A
    assert np.max(np.abs(np.linalg.eigvals(loop))) < 1
    sizes = np.maximum(-problem.bounds.u_min, problem.bounds.u_max)
    driving = plant.B @ np.diag(sizes**2) @ plant.B.T
    driving += 1e-9 * np.trace(driving) * np.eye(plant.n)
    noise, P = np.diag(problem.output_scale**2), np.eye(plant.n)
    for _ in range(5000):
        gain = P @ plant.C.T @ scipy.linalg.inv(plant.C @ P @ plant.C.T + noise)
        P = plant.A @ (P - gain @ plant.C @ P) @ plant.A.T + driving
    np.testing.assert_allclose(M, gain, rtol=1e-6, atol=1e-9)


def test_no_correction_is_the_simulation() -> None:
    known = random_problem(5)
    assert known is not None
    problem = known.problem
    nothing = Correction(np.zeros((problem.plant.n, len(problem.output_scale))))
    law = GainLaw(problem, np.array(known.K), np.array(known.S))
    plain, same = (linear_at(problem, law, law.start, None, one) for one in (None, nothing))
    np.testing.assert_allclose(same.residual, plain.residual, atol=1e-12)
    np.testing.assert_allclose(same.tables[0], plain.tables[0], atol=1e-9)
