"""Whether the residuals of a fit look like noise that entered the loop and was answered.

A fit takes what it does not explain as noise in the recorder. Noise that moves the body instead
(motor noise, noise in what is sensed) is answered by the controller, and what is recorded of it has
the response of the closed loop in it. Where such noise drives the command into its limit the fit is
biased and its intervals do not hold (docs/fitting.md). Two models of the spectrum of residuals,

    output noise    S_0(w) = H(w) V H(w)* + D            H diagonal: an autoregression of order
                                                         four for each output; V (p, p); D white
    and in the loop S_1(w) = S_0(w) + G(w) W(w) G(w)*    G = C (z - A + B K)^-1 B, the fitted loop;
                                                         W diagonal, first-order of one root

are compared by Whittle's likelihood. Twice the gain of the second is near chi-squared of m + 1
degrees of freedom when the first is true; the share of an output's variance that the second lays to
the loop says how much there is of it. With one output an autoregression can all but imitate a loop
of few states, and the test has little power.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.optimize
import scipy.signal
import scipy.special

from impc.arrays import Array, frozen

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.model.plant import Plant

__all__ = ["LoopNoise", "loop_noise"]

_ORDER = 4
# One false alarm in a hundred where the output noise is as the first model says; a share below a
# fifth biases no gain by more than its deviation (docs/fitting.md).
_LEVEL, _LEAST_SHARE = 0.99, 0.2
# Frequencies are averaged over bins of this relative width; each bin holds one ordinate at least.
_WIDTH, _INSIDE = 0.05, 4
# Hann's window makes neighbours depend: as many independent ordinates as T / 1.94 (35 / 18).
_HANN = 35 / 18
# Of the mean level: a spectrum below it, as of rounding, is not looked into.
_FLOOR = 1e-3


@dataclass(frozen=True)
class LoopNoise:
    """How much of the residuals looks like noise inside the fitted loop.

    Attributes
    ----------
    shares : Array
        Share of each output's residual variance that is laid to the loop (p,), 0 to 1.
    statistic : float
        Twice the gain in log-likelihood.
    threshold : float
        What output noise exceeds in one of a hundred recordings.
    root : float
        Of the noise at the loop's input: 0 when it is white.
    """

    shares: Array
    statistic: float
    threshold: float
    root: float

    @property
    def found(self) -> bool:
        """Whether noise inside the loop is told from noise in the recorder, and matters."""
        return self.statistic > self.threshold and bool(np.max(self.shares) >= _LEAST_SHARE)


@dataclass(frozen=True)
class _Spectrum:
    """Binned periodograms (b, p, p) of unit variance, their angles (b,) and counts (b,)."""

    angles: Array
    edges: Array
    counts: Array
    power: np.ndarray[tuple[int, ...], np.dtype[np.complex128]]
    size: Array


def loop_noise(plant: Plant, gain: Array, residuals: list[Array]) -> LoopNoise | None:
    """Compare the two models on the residuals of a fit.

    Parameters
    ----------
    plant : Plant
    gain : Array
        K (m, n) of the fit; A - B K stable.
    residuals : list of Array
        Recorded minus simulated outputs (samples, p) of each trial, in the outputs' units.

    Returns
    -------
    LoopNoise or None
        None when a residual is zero throughout or trials are too short to have a spectrum.
    """
    spectrum = _spectrum(residuals)
    if spectrum is None:
        return None
    shapes = _loop_shapes(plant, gain, spectrum)
    size = np.sqrt(np.mean(np.einsum("bjii->bj", shapes).real, axis=0))
    if not np.all(size > 0):
        return None
    shapes = shapes / size[:, None, None] ** 2
    p, m = len(spectrum.size), plant.m
    first = _minimise(lambda t: _misfit(_outputs(t, spectrum, p), spectrum), _start(spectrum, p))
    both = [
        _minimise(
            lambda t: _misfit(
                _outputs(t, spectrum, p) + _loops(t[-m - 1 :], shapes, spectrum), spectrum
            ),
            np.concatenate([outputs, np.full(m, np.log(share)), [root]]),
        )
        for outputs, share, root in (
            (_lowered(first.x, p, 0.05), 0.05, 0.0),
            (_lowered(first.x, p, 0.9), 0.9, 1.5),
            (_plain(p), 1.0, 0.0),
        )
    ]
    best = min(both, key=lambda item: float(item.fun))
    # The first model once more, from the second's outputs: its optimum must not be a worse one.
    again = _minimise(lambda t: _misfit(_outputs(t, spectrum, p), spectrum), best.x[: _size(p)])
    least = min(float(first.fun), float(again.fun))
    statistic = max(0.0, 2 * (least - float(best.fun)))
    # Autoregressions can take over much of a loop's answer: of readings that gain at least half as
    # much as the best, the one that lays most to the loop.
    good = [item for item in both if 2 * (least - float(item.fun)) >= statistic / 2]
    shares, root = max(
        ((_shares(item.x, shapes, spectrum, p), _root(item.x)) for item in good or [best]),
        key=lambda pair: float(np.max(pair[0])),
    )
    threshold = float(scipy.special.chdtri(m + 1, 1 - _LEVEL))
    return LoopNoise(frozen(shares), statistic, threshold, root)


def _shares(theta: Array, shapes: np.ndarray, spectrum: _Spectrum, p: int) -> Array:
    """Of each output's variance, what the loop has."""
    parts = (_loops(theta[_size(p) :], shapes, spectrum), _outputs(theta, spectrum, p))
    inside, outside = (np.einsum("b,bii->i", spectrum.counts, part).real for part in parts)
    return np.asarray(inside / (inside + outside))


def _spectrum(residuals: list[Array]) -> _Spectrum | None:
    shortest = min(map(len, residuals))
    size = np.sqrt(
        np.mean(np.concatenate([part - part.mean(axis=0) for part in residuals]) ** 2, axis=0)
    )
    if shortest < 64 or not np.all(size > 0) or not np.all(np.isfinite(size)):
        return None
    edges = [1.5]
    while edges[-1] < shortest // 2 - 1:
        edges.append(np.floor(max(edges[-1] + 1, edges[-1] * (1 + _WIDTH))) + 0.5)
    angles = 2 * np.pi * np.array(edges) / shortest
    angles[-1] = min(angles[-1], np.pi)
    p, bins = len(size), len(angles) - 1
    power, counts = np.zeros((bins, p, p), dtype=np.complex128), np.zeros(bins)
    for part in residuals:
        window = scipy.signal.windows.hann(len(part), sym=False)
        seen = ((part - part.mean(axis=0)) / size) * (window / np.linalg.norm(window))[:, None]
        found = np.fft.rfft(seen, axis=0)
        place = np.digitize(2 * np.pi * np.arange(len(found)) / len(part), angles) - 1
        inside = (place >= 0) & (place < bins)
        np.add.at(power, place[inside], found[inside, :, None] * found[inside, None, :].conj())
        np.add.at(counts, place[inside], 1.0)
    centres = (angles[1:] + angles[:-1]) / 2
    return _Spectrum(centres, angles, counts / _HANN, power / counts[:, None, None], size)


def _loop_shapes(plant: Plant, gain: Array, spectrum: _Spectrum) -> np.ndarray:
    """G_j G_j* of each input, averaged over each bin, outputs over their size (b, m, p, p)."""
    closed = plant.A - plant.B @ gain
    shares = (np.arange(_INSIDE) + 0.5) / _INSIDE
    angles = spectrum.edges[:-1, None] + np.diff(spectrum.edges)[:, None] * shares
    z = np.exp(1j * angles)[..., None, None]
    G = plant.C @ np.linalg.solve(z * np.eye(len(closed)) - closed, plant.B + 0j)
    G = G / spectrum.size[:, None]
    return np.asarray(np.einsum("bkpj,bkqj->bjpq", G, G.conj()) / _INSIDE)


def _outputs(theta: Array, spectrum: _Spectrum, p: int) -> np.ndarray:
    """S_0: reflection coefficients of each output, then the Cholesky factor of V."""
    backwards = np.exp(-1j * spectrum.angles)
    H = np.empty((len(backwards), p), dtype=np.complex128)
    for output in range(p):
        model = np.ones(1)
        for reflection in np.tanh(np.clip(theta[_ORDER * output : _ORDER * (output + 1)], -5, 5)):
            model = np.append(model, 0.0) + reflection * np.append(model, 0.0)[::-1]
        H[:, output] = 1 / np.polynomial.polynomial.polyval(backwards, model)
    factor = np.zeros((p, p))
    factor[np.tril_indices(p)] = theta[_ORDER * p : _ORDER * p + p * (p + 1) // 2]
    factor[np.diag_indices(p)] = np.exp(np.clip(np.diag(factor), -10, 10))
    root = H[:, :, None] * factor
    white = np.exp(np.clip(theta[_size(p) - p : _size(p)], -25, 10))
    return np.asarray(root @ np.swapaxes(root.conj(), 1, 2) + np.diag(white))


def _size(p: int) -> int:
    """Numbers of S_0: reflections, a triangle, logarithms of white variances."""
    return _ORDER * p + p * (p + 1) // 2 + p


def _loops(theta: Array, shapes: np.ndarray, spectrum: _Spectrum) -> np.ndarray:
    """G W G*: logarithms of the variances at the inputs, and their root."""
    root = _root(theta)
    colour = (1 - root**2) / np.abs(1 - root * np.exp(-1j * spectrum.angles)) ** 2
    sizes = np.exp(np.clip(theta[:-1], -25, 10))
    return np.asarray(np.einsum("j,bjpq,b->bpq", sizes, shapes, colour))


def _root(theta: Array) -> float:
    """Of the noise at the inputs: .995 at most, a drift is not told from a trend."""
    return float(np.tanh(np.clip(theta[-1], -3, 3)))


def _misfit(S: np.ndarray, spectrum: _Spectrum) -> float:
    """Minus Whittle's log-likelihood."""
    # Relative to its size too: one input alone gives a spectrum of rank one.
    least = _FLOOR + 1e-9 * np.einsum("bii->b", S).real
    S = S + least[:, None, None] * np.eye(S.shape[1])
    told = np.linalg.slogdet(S)[1] + np.einsum("bii->b", np.linalg.solve(S, spectrum.power)).real
    return float(spectrum.counts @ told)


def _start(spectrum: _Spectrum, p: int) -> Array:
    """Autoregressions of each output by Levinson's recursion, a little white noise beside them."""
    lags = np.arange(_ORDER + 1)[:, None]
    own = np.einsum("bii->bi", spectrum.power).real * spectrum.counts[:, None]
    covariances = np.cos(lags * spectrum.angles) @ own / own.sum(axis=0)
    reflections, left = np.zeros((p, _ORDER)), np.ones(p)
    for output in range(p):
        model = np.ones(1)
        for order in range(_ORDER):
            ahead = float(model @ covariances[order + 1 : 0 : -1, output][: len(model)])
            reflections[output, order] = np.clip(-ahead / left[output], -0.995, 0.995)
            model = np.append(model, 0.0) + reflections[output, order] * np.append(model, 0.0)[::-1]
            left[output] *= 1 - reflections[output, order] ** 2
    triangle = np.diag(np.log(left) / 2)[np.tril_indices(p)]
    white = np.full(p, np.log(1e-2))
    return np.concatenate([np.ravel(np.arctanh(reflections)), triangle, white])


def _plain(p: int) -> Array:
    """White noise of a hundredth of the outputs."""
    triangle = np.diag(np.full(p, np.log(0.1)))[np.tril_indices(p)]
    return np.concatenate([np.zeros(_ORDER * p), triangle, np.full(p, np.log(1e-2))])


def _lowered(theta: Array, p: int, share: float) -> Array:
    """Output noise of what is left when the loop takes a share."""
    result = theta.copy()
    diagonal = _ORDER * p + np.cumsum(np.arange(1, p + 1)) - 1
    result[diagonal] += np.log(1 - share) / 2
    result[_size(p) - p : _size(p)] += np.log(1 - share)
    return result


def _minimise(misfit: Callable[[Array], float], start: Array) -> Any:
    # A likelihood of some 1e4 to 1e-2: the threshold is 9. All but flat directions end it else.
    options: Any = {"ftol": 1e-6, "maxiter": 100}
    return scipy.optimize.minimize(misfit, start, method="L-BFGS-B", options=options)
