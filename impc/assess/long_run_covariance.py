"""The noise that the residuals of a fit show: its colour, and what it does to an estimate.

Residuals e_t of p outputs are taken as stationary. Each output is first whitened by an
autoregression of order one (Andrews and Monahan, Econometrica 60, 1992, 953), then the
autocovariances of what is left, eps_t, are summed under Parzen's window, which keeps every sum
non-negative, with the bandwidth of Andrews (Econometrica 59, 1991, 817):

    e_t = diag(a) e_{t-1} + eps_t,        Gamma_l = w_l E[eps_{t+l} eps_t'].

The covariance of sum_t J_t' e_t is then

    sum_{t,s} W_t' Gamma_{t-s} W_s,        W_t = J_t + diag(a) W_{t+1}.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.signal

from impc.arrays import Array, Frozen, frozen

__all__ = ["ResidualNoise", "residual_noise", "spread_of_sum", "white_noise"]

# Andrews and Monahan: a root nearer to one is not told from one, and would be taken too seriously.
_LARGEST_ROOT = 0.97
# Samples before the first over which noise still has an effect: 0.97^250 is 5e-4.
_BEFORE = 250


@dataclass(frozen=True)
class ResidualNoise(Frozen):
    """A model of residuals.

    Attributes
    ----------
    root : Array
        a, one for each output (p,).
    gammas : Array
        Tapered autocovariances of eps, lags 0 to `bandwidth`, (lags, p, p).
    """

    root: Array
    gammas: Array

    @property
    def bandwidth(self) -> int:
        """Lags of eps that count."""
        return len(self.gammas) - 1


def residual_noise(trials: list[Array], lost: int = 0) -> ResidualNoise:
    """Estimate the colour of residuals.

    Parameters
    ----------
    trials : list of Array
        Residuals (samples, p) of each trial.
    lost : int
        Number of fitted values: the residuals are that much too small.
    """
    root = _roots(trials)
    whitened = [trial[1:] - root * trial[:-1] for trial in trials]
    total = sum(len(part) for part in whitened)
    bandwidth = min(_andrews(whitened, total), min(len(part) for part in whitened) // 4)
    size = total * trials[0].shape[1]
    grow = size / max(size - lost, 1)
    gammas = [
        grow * _parzen(lag / (bandwidth + 1)) * _lagged(whitened, lag) / total
        for lag in range(bandwidth + 1)
    ]
    return ResidualNoise(frozen(root), frozen(gammas))


def white_noise(trials: list[Array], lost: int = 0) -> ResidualNoise:
    """As `residual_noise` if the residuals were white: outputs may be correlated, samples not.

    Parameters
    ----------
    trials : list of Array
        Residuals (samples, p) of each trial.
    lost : int
        Count of numbers that were fitted to them.
    """
    total = sum(len(part) for part in trials)
    size = total * trials[0].shape[1]
    gamma = _lagged(trials, 0) / total * size / max(size - lost, 1)
    return ResidualNoise(frozen(np.zeros(trials[0].shape[1])), frozen(gamma[None]))


def spread_of_sum(noise: ResidualNoise, columns: list[Array]) -> Array:
    """Covariance of sum over trials and samples of columns_t' e_t, (k, k).

    Parameters
    ----------
    columns : list of Array
        (samples, p, k) for each trial.
    """
    count = columns[0].shape[2]
    result = np.zeros((count, count))
    for part in columns:
        moved = _to_innovations(part, np.asarray(noise.root))
        result += np.tensordot(moved, _coloured(moved, np.asarray(noise.gammas)), ((0, 1), (0, 1)))
    return (result + result.T) / 2


def _to_innovations(columns: Array, root: Array) -> Array:
    """W_t = columns_t + diag(a) W_{t+1}, some samples before the first included."""
    before = np.zeros((_BEFORE if np.any(root) else 0, *columns.shape[1:]))
    extended = np.concatenate([before, columns])[::-1]
    moved = np.empty_like(extended)
    for output, a in enumerate(root):
        moved[:, output] = scipy.signal.lfilter([1.0], [1.0, -a], extended[:, output], axis=0)
    return moved[::-1]


def _coloured(columns: Array, gammas: Array) -> Array:
    """sum_s Gamma_{t-s} columns_s for columns (samples, p, k), Gamma_{-l} = Gamma_l'."""
    lags = len(gammas) - 1
    both = np.concatenate([np.swapaxes(gammas[:0:-1], 1, 2), gammas])  # lags -L .. L
    result = np.zeros_like(columns)
    for i in range(columns.shape[1]):
        for j in range(columns.shape[1]):
            full = scipy.signal.oaconvolve(columns[:, j], both[:, i, j][:, None], axes=0)
            result[:, i] += full[lags : lags + len(columns)]
    return result


def _roots(trials: list[Array]) -> Array:
    above = sum(np.sum(part[1:] * part[:-1], axis=0) for part in trials)
    below = sum(np.sum(part[:-1] ** 2, axis=0) for part in trials)
    root = np.divide(above, below, out=np.zeros_like(below), where=below > 0)
    return np.asarray(np.clip(root, -_LARGEST_ROOT, _LARGEST_ROOT))


def _lagged(trials: list[Array], lag: int) -> Array:
    return np.asarray(sum(part[lag:].T @ part[: len(part) - lag] for part in trials))


def _andrews(trials: list[Array], total: int) -> int:
    """Bandwidth for Parzen's window: 2.6614 (alpha(2) T)^(1/5), Andrews 1991, (6.2) to (6.4)."""
    rho = _roots(trials)
    left = sum(np.sum((part[1:] - rho * part[:-1]) ** 2, axis=0) for part in trials)
    variance = np.asarray(left) / total
    below = float(np.sum(variance**2 / (1 - rho) ** 4))
    above = float(np.sum(4 * rho**2 * variance**2 / (1 - rho) ** 8))
    alpha = above / below if below > 0 else 0.0
    return int(np.ceil(2.6614 * (alpha * total) ** 0.2))


def _parzen(x: float) -> float:
    return 1 - 6 * x**2 + 6 * x**3 if x <= 0.5 else 2 * (1 - x) ** 3
