"""How far a fitted gain is determined: standard deviations under noise of any colour.

The residuals e_t of a fit are taken as stationary noise with autocovariances Gamma_l, (p, p). The
least-squares estimate then has, to first order, the covariance (White's and Newey and West's
"sandwich", here with a Jacobian that is known)

    H^-1 [ sum_trials sum_t sum_l w_l J_t' Gamma_l J_{t+l} ] H^-1,     H = sum J'J,

J_t being the derivative of the outputs at sample t with respect to everything that was fitted.
Gamma_l is estimated from the residuals of all trials; w_l is Parzen's window, which keeps the sum
non-negative, with the bandwidth of Andrews (Econometrica 59, 1991, 817) for first-order residuals:
few lags for white noise, a hundred for a correlation of 0.9.

The prior of a search (`fit_gain`) is left out: the result says what the recordings determine, and
in a direction that they hardly do it is wide.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.signal

from impc.arrays import Array, frozen
from impc.evaluation import evaluate
from impc.gain_fibre import natural_coordinates

if TYPE_CHECKING:
    from impc.gain import GainFit
    from impc.inverse_problem import InverseProblem

__all__ = ["GainCovariance", "autocovariances", "gain_covariance"]

# A direction whose singular value is below this, of the largest, is not determined at all.
DETERMINED = 1e-6


@dataclass(frozen=True)
class GainCovariance:
    """What the recordings say of the gain at a fit.

    Directions are of the gain in natural coordinates, K T with x = T z, row by row (`gain_fibre`):
    a step of 1 moves the command by one unit of the white input noise that T stands for.

    Attributes
    ----------
    T : Array
        Natural coordinates (n, n).
    singular_values : Array
        Of the scaled residual's derivative with respect to K T, once initial states and parameters
        have taken what they can; largest first (m n,).
    directions : Array
        Right singular vectors, one a row (m n, m n).
    deviations : Array
        Standard deviation along each direction (m n,); infinite below 1e-6 of the largest
        singular value.
    entries : Array
        Standard deviation of each entry of K (m, n), in its unit; infinite when a direction
        without a value takes part in it.
    parameters : Array
        Standard deviation of the logarithm of each physical parameter (k,).
    bandwidth : int
        Lags of the residuals that were used.
    """

    T: Array
    singular_values: Array
    directions: Array
    deviations: Array
    entries: Array
    parameters: Array
    bandwidth: int


def gain_covariance(fit: GainFit) -> GainCovariance:
    """Covariance of a fitted gain, of the parameters fitted with it and of what they leave free."""
    problem = fit.problem
    m, n = problem.plant.m, problem.plant.n
    T, _ = natural_coordinates(problem.plant, fit.K)
    found = evaluate(problem, fit.K, fit.S)
    on_gain = found.dK.reshape(-1, m * n) @ np.kron(np.eye(m), np.linalg.inv(T).T)
    nuisance = _nuisance(problem, found.dx0, found.dparameters)
    # What initial states and parameters can explain is taken out of the gain's columns; the gain's
    # block of the inverse of H is that of what is left.
    left = _orthogonal(nuisance)
    seen = on_gain - left @ (left.T @ on_gain)
    _, values, directions = np.linalg.svd(seen, full_matrices=False)
    usable = values > DETERMINED * values[0]
    trials = _by_trial(problem, found.residual)
    bandwidth, gammas = autocovariances(trials)
    along = seen @ directions[usable].T / values[usable] ** 2
    spread = _sandwich(problem, along, gammas)
    deviations = np.full(m * n, np.inf)
    deviations[usable] = np.sqrt(np.maximum(np.diag(spread), 0.0))
    back = np.kron(np.eye(m), np.linalg.inv(T).T) @ directions.T
    variances = np.einsum("ij,jk,ik->i", back[:, usable], spread, back[:, usable])
    entries = np.sqrt(np.maximum(variances, 0.0))
    # An entry that shares as much as rounding does with a direction that has no value has none.
    share = np.linalg.norm(back[:, ~usable], axis=1) / np.linalg.norm(back, axis=1)
    entries[share > 1e-6] = np.inf
    return GainCovariance(
        frozen(T),
        frozen(values),
        frozen(directions),
        frozen(deviations),
        frozen(entries.reshape(m, n)),
        frozen(_parameter_deviations(problem, on_gain, nuisance, gammas)),
        bandwidth,
    )


def autocovariances(trials: list[Array]) -> tuple[int, Array]:
    """Tapered autocovariances of residuals (samples, p) each: (bandwidth, (lags, p, p)).

    Entry l estimates w_l E[e_{t+l} e_t'], l = 0 .. bandwidth.
    """
    total = sum(len(trial) for trial in trials)
    longest = min(len(trial) for trial in trials)
    bandwidth = min(_andrews(trials, total), longest // 4)
    gammas = []
    for lag in range(bandwidth + 1):
        products = [trial[lag:].T @ trial[: len(trial) - lag] for trial in trials]
        gammas.append(_parzen(lag / (bandwidth + 1)) * np.sum(products, axis=0) / total)
    return bandwidth, np.array(gammas)


def _andrews(trials: list[Array], total: int) -> int:
    """Bandwidth for Parzen's window: 2.6614 (alpha(2) T)^(1/5), Andrews 1991, (6.2) to (6.4)."""
    above, below = 0.0, 0.0
    for column in range(trials[0].shape[1]):
        series = [trial[:, column] for trial in trials]
        product = sum(float(part[1:] @ part[:-1]) for part in series)
        power = sum(float(part[:-1] @ part[:-1]) for part in series)
        rho = float(np.clip(product / power if power > 0 else 0.0, -0.99, 0.99))
        variance = sum(float(np.sum((part[1:] - rho * part[:-1]) ** 2)) for part in series) / total
        above += 4 * rho**2 * variance**2 / (1 - rho) ** 8
        below += variance**2 / (1 - rho) ** 4
    alpha = above / below if below > 0 else 0.0
    return int(np.ceil(2.6614 * (alpha * total) ** 0.2))


def _parzen(x: float) -> float:
    return 1 - 6 * x**2 + 6 * x**3 if x <= 0.5 else 2 * (1 - x) ** 3


def _sandwich(problem: InverseProblem, along: Array, gammas: Array) -> Array:
    """sum_trials sum_{t,s} along_t' Gamma_{t-s} along_s, (k, k)."""
    result = np.zeros((along.shape[1], along.shape[1]))
    for part in _by_trial(problem, along):  # (samples, p, k)
        result += np.tensordot(part, _colour(part, gammas), ((0, 1), (0, 1)))
    return (result + result.T) / 2


def _colour(columns: Array, gammas: Array) -> Array:
    """sum_s Gamma_{t-s} columns_s for columns (samples, p, k), Gamma_{-l} = Gamma_l'."""
    lags = len(gammas) - 1
    both = np.concatenate([np.swapaxes(gammas[:0:-1], 1, 2), gammas])  # lags -L .. L
    coloured = np.zeros_like(columns)
    for i in range(columns.shape[1]):
        for j in range(columns.shape[1]):
            kernel = both[:, i, j][:, None]
            full = scipy.signal.oaconvolve(columns[:, j], kernel, axes=0)
            coloured[:, i] += full[lags : lags + len(columns)]
    return coloured


def _by_trial(problem: InverseProblem, rows: Array) -> list[Array]:
    """Rows of all trials as one (samples, p, ...) array a trial."""
    p, row, parts = len(problem.plant.outputs), 0, []
    for trial in problem.recordings:
        mine = rows[row : row + trial.outputs.size]
        parts.append(mine.reshape(trial.samples, p, *rows.shape[1:]))
        row += trial.outputs.size
    return parts


def _nuisance(problem: InverseProblem, dx0: Array, dparameters: Array) -> Array:
    """Columns of initial states, trial by trial, then of parameters."""
    columns, row = [], 0
    for trial in problem.recordings:
        mine = slice(row, row + trial.outputs.size)
        row = mine.stop
        block = np.zeros_like(dx0)
        block[mine] = dx0[mine]
        columns.append(block)
    return np.hstack([*columns, dparameters])


def _orthogonal(columns: Array) -> Array:
    """Orthonormal basis of what the columns reach, to 1e-10 of the largest in each one's scale."""
    size = np.linalg.norm(columns, axis=0)
    scaled = columns[:, size > 0] / size[size > 0]
    if scaled.shape[1] == 0:
        return np.zeros((len(columns), 0))
    left, values, _ = np.linalg.svd(scaled, full_matrices=False)
    return np.asarray(left[:, values > 1e-10 * values[0]])


def _parameter_deviations(
    problem: InverseProblem, on_gain: Array, nuisance: Array, gammas: Array
) -> Array:
    """Standard deviations of the logarithms, everything else being fitted too."""
    count = len(problem.logarithms)
    if count == 0:
        return np.zeros(0)
    own = nuisance[:, -count:]
    left = _orthogonal(np.hstack([on_gain, nuisance[:, :-count]]))
    seen = own - left @ (left.T @ own)
    _, values, directions = np.linalg.svd(seen, full_matrices=False)
    if values[-1] <= DETERMINED * np.linalg.norm(own, 2):
        return np.full(count, np.inf)
    along = seen @ directions.T / values**2 @ directions
    return np.sqrt(np.maximum(np.diag(_sandwich(problem, along, gammas)), 0.0))
