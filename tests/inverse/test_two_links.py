"""Two-link standing person: fits are at the minimum of the misfit."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.optimize
import scipy.signal

import impc
from experiments.two_link_standing import GAIN, standing_problem
from impc.assess.printed_gain import gain_estimate


def least_misfit(problem: impc.Problem, start: np.ndarray) -> float:
    """Least misfit of linear feedback, by another simulator and optimiser."""
    plant, trial = problem.plant, problem.recordings[0]
    drive, scale = np.array(trial.disturbance), np.array(problem.output_scale)

    def residual(unknowns: np.ndarray) -> np.ndarray:
        K, x0 = unknowns[:8].reshape(2, 4) * GAIN, unknowns[8:]
        loop = plant.A - plant.B @ K, plant.E, np.eye(4), np.zeros((4, 1)), 1.0
        x = scipy.signal.dlsim(loop, drive, x0=x0)[2]
        return np.asarray((x - trial.outputs) / scale).ravel()

    begin = np.concatenate([(start / GAIN).ravel(), trial.x0])
    found = scipy.optimize.least_squares(residual, begin, method="lm", xtol=1e-12, ftol=1e-14)
    return float(np.sqrt(2 * found.cost))


@pytest.mark.parametrize(
    ("noisy", "samples"),
    [
        pytest.param(True, 800, marks=pytest.mark.full),
        pytest.param(False, 4000, marks=pytest.mark.slow),
        pytest.param(True, 4000, marks=pytest.mark.slow),
    ],
)
def test_two_links_end_at_the_least_misfit(noisy: bool, samples: int) -> None:
    problem = standing_problem(1, noisy=noisy, samples=samples)
    least = least_misfit(problem, GAIN)
    count = problem.recordings[0].outputs.size
    fitted = impc.fit(problem)
    feedback = impc.fit(problem, "feedback_gain")
    for misfit in (gain_estimate(fitted).misfit, feedback.misfit):
        assert abs(count * ((misfit / least) ** 2 - 1)) < 0.1
    assert fitted.noise <= least * (1 + 0.05 / count)
