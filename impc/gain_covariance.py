"""How far a fitted gain is determined: standard deviations under noise of any colour.

To first order a least-squares estimate under stationary noise e_t has the covariance (White 1980,
Newey and West 1987: the "sandwich", here with a Jacobian that is known; docs/fitting.md)

    H^-1 cov( sum_t J_t' e_t ) H^-1,     H = sum_t J_t' J_t,

J_t being the derivative of the outputs at sample t with respect to everything that was fitted, and
the middle as `residual_noise` estimates it from the residuals. With white noise it is the
Cramér-Rao bound.

The prior of a search (`fit_gain`) is left out: the result says what the recordings determine, and
in a direction that they hardly do it is wide.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.evaluation import evaluate
from impc.gain_fibre import natural_coordinates
from impc.residual_noise import ResidualNoise, residual_noise, spread_of_sum

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.gain import GainFit
    from impc.inverse_problem import InverseProblem

__all__ = ["DETERMINED", "GainCovariance", "gain_covariance"]

#: A direction whose singular value is below this, of the largest, is not determined at all.
DETERMINED = 1e-6


@dataclass(frozen=True)
class GainCovariance(Frozen):
    """What the recordings say of the gain at a fit.

    Directions are of the gain in natural coordinates, K T with x = T z, row by row (`gain_fibre`):
    a step of 1 moves the command by one unit of the white input noise that T stands for.

    Attributes
    ----------
    T : Array
        Natural coordinates (n, n).
    singular_values : Array
        Of the scaled residual's derivative with respect to K T, once initial states and parameters
        have taken what they can; largest first (m * n,).
    directions : Array
        Right singular vectors, one a row (m * n, m * n).
    deviations : Array
        Standard deviation along each direction (m * n,); infinite below 1e-6 of the largest
        singular value.
    entries : Array
        Standard deviation of each entry of K (m, n), in its unit; infinite when a direction
        without a value takes part in it.
    parameters : Array
        Standard deviation of the logarithm of each physical parameter (k,).
    noise : ResidualNoise
        The colour of the residuals.
    """

    T: Array
    singular_values: Array
    directions: Array
    deviations: Array
    entries: Array
    parameters: Array
    noise: ResidualNoise


def gain_covariance(
    fit: GainFit, noise: Callable[[list[Array], int], ResidualNoise] = residual_noise
) -> GainCovariance:
    """Covariance of a fitted gain, and of the parameters fitted with it.

    Parameters
    ----------
    fit : GainFit
    noise : callable
        How the noise is estimated from the residuals, (samples, p) for each trial, and the count
        of numbers fitted: `residual_noise`, or `white_noise` for the plain
        Cramér-Rao bound.
    """
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
    colour = noise(
        _by_trial(problem, found.residual), left.shape[1] + int(np.count_nonzero(usable))
    )
    along = seen @ directions[usable].T / values[usable] ** 2
    spread = spread_of_sum(colour, _by_trial(problem, along))
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
        frozen(_parameter_deviations(problem, on_gain, nuisance, colour)),
        colour,
    )


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
    problem: InverseProblem, on_gain: Array, nuisance: Array, colour: ResidualNoise
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
    spread = spread_of_sum(colour, _by_trial(problem, along))
    return np.sqrt(np.maximum(np.diag(spread), 0.0))
