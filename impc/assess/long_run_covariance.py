"""Autocorrelation of the residuals and its effect on standard errors (HAC).

Residuals e_t of p outputs are modelled as stationary. Each output is prewhitened by a first-order
autoregression (Andrews and Monahan, Econometrica 60, 1992, 953), then the autocovariances of eps_t
are summed under Parzen's window, which keeps sums non-negative, with the bandwidth of Andrews
(Econometrica 59, 1991, 817):

    e_t = diag(a) e_{t-1} + eps_t,        Gamma_l = w_l E[eps_{t+l} eps_t'].

The covariance of sum_t J_t' e_t is then

    sum_{t,s} W_t' Gamma_{t-s} W_s,        W_t = J_t + diag(a) W_{t+1}.

Residuals are smaller than the noise, mostly along the slow fitted columns. With S the covariance of
the noise and Z an orthonormal basis of the fitted columns, e = (I - Z Z') noise has the covariance

    S - (Z Z' S + S Z Z' - Z Z' S Z Z'),

and the bracket, with S estimated from the residuals, is added back lag by lag
(docs/why/intervals.md).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.signal

from impc.arrays import Array, Frozen, frozen
from impc.inverse.columns import TrialSpan

if TYPE_CHECKING:
    Taken = tuple[Array, Array]

# Andrews and Monahan: larger roots cannot be distinguished from one.
_LARGEST_ROOT = 0.97
# Samples before the first in which noise still matters: 0.97^250 is 5e-4.
_BEFORE = 250
# Largest number of iterations of the correction for the fit, which depends on the estimated S, and
# relative change below which the next one would change it by the square of this share.
_ROUNDS, _CLOSE = 3, 0.02


@dataclass(frozen=True)
class ResidualNoise(Frozen):
    """Autocorrelation model of residuals."""

    root: Array  # a of each output (p,)
    gammas: Array  # Tapered autocovariances of eps, from lag 0, (lags, p, p)

    @property
    def lasting(self) -> Array:
        """Long-run covariance of e, from lag 0 on (p, p)."""
        apart = 1 / (1 - np.asarray(self.root))
        return np.asarray(np.sum(self.gammas, axis=0) * np.outer(apart, apart))


def residual_noise(trials: list[Array], fitted: TrialSpan | None = None) -> ResidualNoise:
    """Estimate the autocorrelation of residuals; `trials` (samples, p)."""
    return _restored(_first_order, trials, fitted)


def white_noise(trials: list[Array], fitted: TrialSpan | None = None) -> ResidualNoise:
    """Model of white residuals: correlated between outputs, not between samples."""
    return _restored(_white, trials, fitted)


def spread_of_sum(noise: ResidualNoise, columns: list[Array]) -> Array:
    """Covariance of sum over trials and samples of columns_t' e_t, (k, k)."""
    count = columns[0].shape[2]
    result = np.zeros((count, count))
    for part in columns:
        moved = _to_innovations(part, np.asarray(noise.root))
        result += np.tensordot(moved, _coloured(moved, np.asarray(noise.gammas)), ((0, 1), (0, 1)))
    return (result + result.T) / 2


def _restored(
    model: Callable[[list[Array], list[Taken]], ResidualNoise],
    trials: list[Array],
    fitted: TrialSpan | None,
) -> ResidualNoise:
    found = model(trials, [])
    if fitted is not None:
        for _ in range(_ROUNDS):
            before, found = found, model(trials, _taken(found, fitted, trials))
            change = np.linalg.norm(found.lasting - before.lasting)
            if change <= _CLOSE * np.linalg.norm(found.lasting):
                break
    return found


def _white(trials: list[Array], taken: list[Taken]) -> ResidualNoise:
    total = sum(len(part) for part in trials)
    gammas = (_lagged(trials, 0) + _given_back(taken, 0)) / total
    return ResidualNoise(frozen(np.zeros(gammas.shape[1])), frozen(gammas))


def _first_order(trials: list[Array], taken: list[Taken]) -> ResidualNoise:
    root = _roots(trials, taken)
    whitened = [_whitened(trial, root) for trial in trials]
    total = sum(len(part) for part in whitened)
    bandwidth = min(_andrews(whitened, total), min(len(part) for part in whitened) // 4)
    window = _parzen(np.arange(bandwidth + 1) / (bandwidth + 1))[:, None, None]
    moved = [(_whitened(one, root), _whitened(two, root)) for one, two in taken]
    gammas = window * (_lagged(whitened, bandwidth) + _given_back(moved, bandwidth)) / total
    return ResidualNoise(frozen(root), frozen(gammas))


def _taken(noise: ResidualNoise, fitted: TrialSpan, trials: list[Array]) -> list[Taken]:
    """Part of the noise covariance S that a fit removes, per trial.

    Z and M = S Z - Z (Z' S Z) / 2, (samples, p, k): Z M' + M Z' is removed in each trial.
    """
    root, parts, row = np.asarray(noise.root), [], 0
    for own, trial in zip(fitted.own, trials, strict=True):
        rows = slice(row, row + len(own))
        row = rows.stop
        basis = np.hstack([own, fitted.shared[rows]]).reshape(*trial.shape, -1)
        moved = _to_innovations(basis, root)
        image = _coloured(moved, np.asarray(noise.gammas))
        spread = np.tensordot(moved, image, ((0, 1), (0, 1)))
        parts.append((basis, _filtered(image, root)[-len(trial) :], spread, own.shape[1]))
    total = np.sum([spread[first:, first:] for _, _, spread, first in parts], axis=0)
    for _, _, spread, first in parts:
        spread[first:, first:] = total
    return [(basis, image - basis @ spread / 2) for basis, image, spread, _ in parts]


def _given_back(taken: list[Taken], largest: int) -> Array:
    """Sums of lagged products that a fit has removed, as `_lagged`."""
    count = taken[0][0].shape[1] if taken else 1
    result = np.zeros((largest + 1, count, count))
    for pair in taken:
        # One output at a time, so that each sum runs over contiguous memory.
        one, two = (np.ascontiguousarray(np.swapaxes(part, 0, 1)) for part in pair)
        for ahead, behind in ((one, two), (two, one)):
            for lag, i, j in np.ndindex(result.shape):
                last = one.shape[1] - lag
                result[lag, i, j] += np.vdot(ahead[i, lag:], behind[j, :last])
    return result


def _whitened(part: Array, root: Array) -> Array:
    """eps_t = part_t - root part_{t-1} of a part (samples, p, ...) without its first sample."""
    return np.asarray(part[1:] - root.reshape(-1, *[1] * (part.ndim - 2)) * part[:-1])


def _to_innovations(columns: Array, root: Array) -> Array:
    """W_t = columns_t + diag(a) W_{t+1}, including samples before the first."""
    before = np.zeros((_BEFORE if np.any(root) else 0, *columns.shape[1:]))
    return _filtered(np.concatenate([before, columns])[::-1], root)[::-1]


def _filtered(columns: Array, root: Array) -> Array:
    """y_t = columns_t + diag(a) y_{t-1}."""
    moved = np.empty_like(columns)
    for output, a in enumerate(root):
        moved[:, output] = scipy.signal.lfilter([1.0], [1.0, -a], columns[:, output], axis=0)
    return moved


def _coloured(columns: Array, gammas: Array) -> Array:
    """sum_s Gamma_{t-s} columns_s for columns (samples, p, k), Gamma_{-l} = Gamma_l'."""
    lags = len(gammas) - 1
    both = np.concatenate([np.swapaxes(gammas[:0:-1], 1, 2), gammas])  # lags -L .. L
    result = np.zeros_like(columns)
    for i, j in np.ndindex(columns.shape[1], columns.shape[1]):
        full = scipy.signal.oaconvolve(columns[:, j], both[:, i, j][:, None], axes=0)
        result[:, i] += full[lags : lags + len(columns)]
    return result


def _roots(trials: list[Array], taken: list[Taken]) -> Array:
    """Autoregression coefficients of residuals, corrected for what the fit has `taken`."""
    above = sum(np.sum(part[1:] * part[:-1], axis=0) for part in trials)
    below = sum(np.sum(part[:-1] ** 2, axis=0) for part in trials)
    back = np.diagonal(_given_back(taken, 1), axis1=1, axis2=2)
    above, below = above + back[1], below + back[0]
    root = np.divide(above, below, out=np.zeros_like(below), where=below > 0)
    return np.asarray(np.clip(root, -_LARGEST_ROOT, _LARGEST_ROOT))


def _lagged(trials: list[Array], largest: int) -> Array:
    """Sums of part_{t+l} part_t', lags 0 to `largest`, (lags, p, p)."""
    return np.array(
        [
            sum(part[lag:].T @ part[: len(part) - lag] for part in trials)
            for lag in range(largest + 1)
        ]
    )


def _andrews(trials: list[Array], total: int) -> int:
    """Bandwidth for Parzen's window: 2.6614 (alpha(2) T)^(1/5), Andrews 1991, (6.2) to (6.4)."""
    rho = _roots(trials, [])
    left = sum(np.sum((part[1:] - rho * part[:-1]) ** 2, axis=0) for part in trials)
    variance = np.asarray(left) / total
    below = float(np.sum(variance**2 / (1 - rho) ** 4))
    above = float(np.sum(4 * rho**2 * variance**2 / (1 - rho) ** 8))
    alpha = above / below if below > 0 else 0.0
    return int(np.ceil(2.6614 * (alpha * total) ** 0.2))


def _parzen(x: Array) -> Array:
    return np.where(x <= 0.5, 1 - 6 * x**2 + 6 * x**3, 2 * (1 - x) ** 3)
