"""States and commands behind recorded outputs, when nothing is known of the controller.

    x+ = A x + B u + E d,    u+ = u + w,    y = C x + e,    w ~ N(0, q r W), e ~ N(0, r V)

The disturbance d is known, the command is a random walk. V is the squared size of the outputs, and
W such that a step of each input moves the outputs by their size within the first n samples. The
ratio q is that of greatest likelihood, r follows from it; then fixed-interval smoothing
(statsmodels; Durbin and Koopman 2012, chapter 4). A laboratory calls it inverse dynamics.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg
import scipy.optimize

from impc.arrays import Array, Frozen, frozen

if TYPE_CHECKING:
    from statsmodels.tsa.statespace.kalman_smoother import KalmanSmoother

    from impc.inverse.problem import Problem
    from impc.model.plant import Plant
    from impc.model.recordings import Recording

__all__ = ["Smoothed", "smoothed_trials"]

# Logarithms (base 10) of q between which it is looked for.
_RATIOS = (-8.0, 8.0)
# Variance of states and commands at the first sample, over that of the outputs.
_DIFFUSE = 1e6


@dataclass(frozen=True)
class Smoothed(Frozen):
    """One trial, in the units of the plant."""

    x: Array  # States (samples, n)
    u: Array  # Commands (samples, m)


def smoothed_trials(problem: Problem) -> tuple[Smoothed, ...]:
    """Estimate states and commands of every trial; bounds and controller play no part."""

    def cost(logarithm: float) -> float:
        """-2 log-likelihood with r at its best, up to a constant."""
        logdet, squares, count = 0.0, 0.0, 0
        for trial in problem.recordings:
            found = _model(problem, trial, 10.0**logarithm).filter()
            covariance = np.moveaxis(found.forecasts_error_cov, 2, 0)
            logdet += float(np.sum(np.linalg.slogdet(covariance)[1]))
            squares += float(np.sum(found.standardized_forecasts_error**2))
            count += found.standardized_forecasts_error.size
        return logdet + count * float(np.log(squares / count))

    best = scipy.optimize.minimize_scalar(
        cost, bounds=_RATIOS, method="bounded", options={"xatol": 0.1}
    )
    n = problem.plant.n
    smoothed = []
    for trial in problem.recordings:
        states = _model(problem, trial, 10.0 ** float(best.x)).smooth().smoothed_state.T
        smoothed.append(Smoothed(frozen(states[:, :n]), frozen(states[:, n:])))
    return tuple(smoothed)


def _model(problem: Problem, trial: Recording, ratio: float) -> KalmanSmoother:
    """The state-space model of the module's text with states (x, u), at r = 1."""
    # Imported here: it takes half a second, and few recordings need it.
    from statsmodels.tsa.statespace.kalman_smoother import KalmanSmoother  # noqa: PLC0415

    plant, scale = problem.plant, np.asarray(problem.output_scale)
    n, m, p = plant.n, plant.m, len(plant.outputs)
    model = KalmanSmoother(k_endog=p, k_states=n + m, k_posdef=m)
    model.bind(np.array(trial.outputs))
    model["design"] = np.hstack([plant.C, np.zeros((p, m))])
    model["obs_cov"] = np.diag(scale**2)
    model["transition"] = scipy.linalg.block_diag(plant.A, np.eye(m))
    model["transition", :n, n:] = plant.B
    model["selection"] = np.vstack([np.zeros((n, m)), np.eye(m)])
    model["state_cov"] = ratio * np.diag(_step(plant, scale) ** 2)
    drift = np.zeros((n + m, trial.samples))
    drift[:n] = plant.E @ trial.disturbance.T
    model["state_intercept"] = drift
    model.initialize_approximate_diffuse(_DIFFUSE * float(np.max(scale)) ** 2)
    return model


def _step(plant: Plant, scale: Array) -> Array:
    """Size of a step of each input (m,) that moves the outputs by their size in n samples."""
    x, total = np.zeros((plant.n, plant.m)), np.zeros(plant.m)
    for _ in range(plant.n + 1):
        x = plant.A @ x + plant.B
        total = np.maximum(total, np.linalg.norm(plant.C @ x / scale[:, None], axis=0))
    return np.asarray(1 / np.maximum(total, 1e-300))
