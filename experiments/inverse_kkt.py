"""Weights from the stationarity of recorded trajectories: inverse KKT.

The method treats each segment of N samples of a trajectory (x_j, u_j) as an optimal plan. With the
adjoint lambda_j of the dynamics, an optimal plan satisfies

    lambda_j = Q x_j + A' lambda_{j+1},        R u_j + B' lambda_{j+1} = 0

for each input that is not at its bound; rows of inputs at a bound are left out. lambda_N, which
depends on what follows the segment, is free. The rows are linear in (Q, R, lambda_N), so the
weights with the least sum of squares, Q >= 0, R > 0, trace R = m, follow from one convex program.
Keshavarz, Wang, Boyd 2011 (imputing a convex objective); Englert, Vien, Toussaint 2017 (inverse
KKT).

The method needs no simulation, but it treats recorded motion as planned motion: a disturbance that
was not anticipated is only in the recorded one.

It needs states and commands. They are estimated from the recorded outputs, without a controller, by

    x+ = A x + B u + E d,    u+ = u + w,    y = C x + e,    w ~ N(0, q r W), e ~ N(0, r V)

with a known disturbance d and a random-walk command. V is the squared size of the outputs. W is
such that a step of each input moves the outputs by their size within the first n samples. Ratio q
maximises the likelihood, and r follows from it. Then fixed-interval smoothing gives states and
commands (statsmodels; Durbin and Koopman 2012, chapter 4). This is a form of inverse dynamics.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.optimize
from statsmodels.tsa.statespace.kalman_smoother import KalmanSmoother

from impc.arrays import Array, BoolArray, Frozen, frozen
from impc.errors import DataError
from impc.inverse.estimates import Estimate, simulated_estimate
from impc.inverse.methods import Method
from impc.inverse.problem import Problem
from impc.inverse.proximal_step import block_basis
from impc.inverse.semidefinite import matrix_inequality, norm_bound, solve_semidefinite
from impc.inverse.solution_set import natural_coordinates, split_blocks
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights, normalised

# An input within this share of its bound counts as at the bound.
_AT_BOUND = 1e-2
# Least eigenvalue in whitened coordinates, where R is about one, and a ridge that chooses among
# weights with the same residual.
_FLOOR, _RIDGE = 1e-6, 1e-6


def inverse_kkt(problem: Problem, gain: Array) -> Weights:
    """Weights of least stationarity residual on smoothed trajectories; `gain` (m, n)."""
    return stationarity_weights(
        problem.plant,
        smoothed_trials(problem),
        problem.horizon,
        np.array(problem.bounds.u_max),
        gain,
    )


def stationarity_weights(
    plant: Plant, trials: Sequence[Smoothed], length: int, u_max: Array, gain: Array
) -> Weights:
    """Weights for given states and commands; `u_max` (m,), `gain` (m, n)."""
    n, m = plant.n, plant.m
    T, G = natural_coordinates(plant, gain)
    back, forth = np.linalg.inv(T), np.linalg.inv(G)
    A, B = back @ plant.A @ T, back @ plant.B @ G
    units = block_basis(n, m)
    rows: list[Array] = [np.zeros((0, len(units)))]
    for trial in trials:
        x, u = trial.x @ back.T, trial.u @ forth.T
        free = np.abs(trial.u) < (1 - _AT_BOUND) * u_max
        for first in range(0, len(x) - length + 1, length):
            mine = slice(first, first + length)
            rows.append(_stretch(A, B, units, x[mine], u[mine], free[mine]))
    table = np.vstack(rows)
    if len(table) == 0:
        raise DataError(
            "recordings",
            f"leave no stretch of {length} samples with more than {n} free commands",
            "give longer trials or a longer horizon",
        )
    triangle = np.asarray(np.linalg.qr(table, mode="r"), dtype=np.float64)
    theta = _least_squares(triangle, units, n, G)
    natural = np.tensordot(theta, units, 1)
    found = split_blocks(natural, n)
    Q, R = back.T @ found.Q @ back, forth.T @ found.R @ forth
    return normalised(Weights((Q + Q.T) / 2, (R + R.T) / 2))


def _stretch(A: Array, B: Array, units: Array, x: Array, u: Array, free: BoolArray) -> Array:
    """Rows of one segment (r, k) in the entries of (Q, R), lambda_N projected out."""
    n = len(B)
    length = len(x)
    # Backwards: lambda = (basis of Q) x + power lambda_N.
    adjoint, power = np.zeros((n, len(units))), np.eye(n)
    on_weights, on_end = [], []
    for j in range(length - 1, -1, -1):
        stationary = (units[:, n:, n:] @ u[j]).T + B.T @ adjoint
        keep = free[j]
        on_weights.append(stationary[keep])
        on_end.append((B.T @ power)[keep])
        adjoint = (units[:, :n, :n] @ x[j]).T + A.T @ adjoint
        power = A.T @ power
    weights, end = np.vstack(on_weights), np.vstack(on_end)
    if len(end) <= n:
        return np.zeros((0, len(units)))
    basis, _ = np.linalg.qr(end)
    return np.asarray(weights - basis @ (basis.T @ weights))


def _least_squares(triangle: Array, units: Array, n: int, G: Array) -> Array:
    """min ||triangle theta||^2 + ridge ||theta||^2, Q, R >= floor, trace R = m in plant units."""
    k, size = len(units), units.shape[1]
    scale = float(np.linalg.norm(triangle, 2))
    rows = np.vstack([triangle / scale, _RIDGE * np.eye(k)])
    back = np.linalg.inv(G)
    trace = np.trace(back.T @ units[:, n:, n:] @ back, axis1=1, axis2=2) / (size - n)
    # theta = start + null y keeps the trace.
    start = trace / float(trace @ trace)
    null = np.linalg.svd(trace[None])[2][1:].T
    spread = norm_bound(
        np.vstack([(rows @ null).T, np.zeros((1, len(rows)))]),
        np.append(np.zeros(k - 1), 1.0),
        offset=rows @ start,
    )
    cones = [spread]
    constant, levels = np.tensordot(start, units, 1), np.tensordot(null.T, units, 1)
    for block in (slice(0, n), slice(n, size)):
        width = block.stop - block.start
        basis = np.concatenate([levels[:, block, block], np.zeros((1, width, width))])
        cones.append(matrix_inequality(constant[block, block] - _FLOOR * np.eye(width), basis))
    solved = solve_semidefinite(np.append(np.zeros(k - 1), 1.0), cones)
    return np.asarray(start + null @ solved.y[:-1])


# Range of log10(q) in the search.
_RATIOS = (-8.0, 8.0)
# Variance of states and commands at the first sample, over that of the outputs.
_DIFFUSE = 1e6


def _estimate(problem: Problem, start: Estimate) -> Estimate:
    known = start.problem.with_nuisance_fixed()
    weights = inverse_kkt(known, np.array(start.gain))
    K = np.array(solve_lqr(known.plant, weights).K)
    return simulated_estimate(
        "inverse_kkt", known, K, start.metric, noise=start.noise, weights=weights
    )


#: The method as an entry for the noise study.
INVERSE_KKT = Method(
    "inverse_kkt",
    "inverse KKT",
    "Weights that make the smoothed states and commands look like optimal plans.",
    lambda problem: problem,
    _estimate,
)


@dataclass(frozen=True)
class Smoothed(Frozen):
    """One trial, in the units of the plant."""

    x: Array  # States (samples, n)
    u: Array  # Commands (samples, m)


def smoothed_trials(problem: Problem) -> tuple[Smoothed, ...]:
    """Estimate states and commands of every trial, without bounds or controller."""

    def cost(logarithm: float) -> float:
        """-2 log-likelihood maximised over r, up to a constant."""
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
    """State-space model of the module docstring with states (x, u), at r = 1."""
    # Imported here because it takes half a second.
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
    """Step of each input (m,) that moves the outputs by their size in n samples."""
    x, total = np.zeros((plant.n, plant.m)), np.zeros(plant.m)
    for _ in range(plant.n + 1):
        x = plant.A @ x + plant.B
        total = np.maximum(total, np.linalg.norm(plant.C @ x / scale[:, None], axis=0))
    return np.asarray(1 / np.maximum(total, 1e-300))
