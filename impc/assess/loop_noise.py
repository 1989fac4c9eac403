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

With S the spectrum that a model says and P
the periodograms, averaged over bins of c ordinates each,

    misfit = sum c (log det S + tr(S^-1 P)),    d misfit = sum c tr((S^-1 - S^-1 P S^-1) dS).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.optimize
import scipy.signal
import scipy.special

from impc.arrays import Array, frozen
from impc.assess.covariance import by_trial
from impc.inverse.problem import recorded_size
from impc.inverse.residuals import evaluate

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.assess.printed_gain import IdentifiedGain
    from impc.model.plant import Plant

Complex = np.ndarray[tuple[int, ...], np.dtype[np.complex128]]

#: Of the autoregression of each output.
ORDER = 4
# Frequencies are averaged over bins of this relative width; each bin holds one ordinate at least.
_WIDTH, _INSIDE = 0.05, 4
# Hann's window makes neighbours depend: as many independent ordinates as T / 1.94 (35 / 18).
_HANN = 35 / 18
# Of the mean level, and of its own size, for one input alone gives a spectrum of rank one: one
# below it, as of rounding, is not looked into.
_FLOOR, _OWN = 1e-3, 1e-9
# Unknowns beyond these are at them: arguments of tanh of reflections and of the root (.995 at most,
# a drift is not distinguished from a trend), logarithms of the diagonal of V's factor, and of
# variances.
_REFLECTION, _ROOT, _DIAGONAL, _VARIANCE = 5.0, 3.0, 10.0, (-25.0, 10.0)


@dataclass(frozen=True)
class Spectrum:
    """Binned periodograms of outputs over their size."""

    angles: Array  # Middle of each bin (b,), rad a sample
    edges: Array  # Of the bins (b + 1,), rad a sample
    counts: Array  # Independent ordinates in each (b,)
    power: Complex  # (b, p, p), complex
    size: Array  # Standard deviation of each output (p,), in its unit


def spectrum(residuals: list[Array]) -> Spectrum | None:
    """Of residuals (samples, p) of each trial; None of zeros, or of trials that are too short."""
    shortest = min(map(len, residuals))
    deviations = np.sqrt(
        np.mean(np.concatenate([part - part.mean(axis=0) for part in residuals]) ** 2, axis=0)
    )
    if shortest < 64 or not np.all(deviations > 0) or not np.all(np.isfinite(deviations)):
        return None
    edges = [1.5]
    while edges[-1] < shortest // 2 - 1:
        edges.append(np.floor(max(edges[-1] + 1, edges[-1] * (1 + _WIDTH))) + 0.5)
    angles = 2 * np.pi * np.array(edges) / shortest
    angles[-1] = min(angles[-1], np.pi)
    p, bins = len(deviations), len(angles) - 1
    power, counts = np.zeros((bins, p, p), dtype=np.complex128), np.zeros(bins)
    for part in residuals:
        window = scipy.signal.windows.hann(len(part), sym=False)
        scaled = (part - part.mean(axis=0)) / deviations
        seen = scaled * (window / np.linalg.norm(window))[:, None]
        found = np.fft.rfft(seen, axis=0)
        place = np.digitize(2 * np.pi * np.arange(len(found)) / len(part), angles) - 1
        inside = (place >= 0) & (place < bins)
        np.add.at(power, place[inside], found[inside, :, None] * found[inside, None, :].conj())
        np.add.at(counts, place[inside], 1.0)
    centres = (angles[1:] + angles[:-1]) / 2
    return Spectrum(centres, angles, counts / _HANN, power / counts[:, None, None], deviations)


def loop_shapes(plant: Plant, gain: Array, found: Spectrum) -> Complex:
    """G_j G_j* of each input, averaged over each bin, outputs over their size (b, m, p, p)."""
    closed = plant.A - plant.B @ gain
    shares = (np.arange(_INSIDE) + 0.5) / _INSIDE
    angles = found.edges[:-1, None] + np.diff(found.edges)[:, None] * shares
    z = np.exp(1j * angles)[..., None, None]
    G = plant.C @ np.linalg.solve(z * np.eye(len(closed)) - closed, plant.B + 0j)
    G = G / found.size[:, None]
    return np.asarray(np.einsum("bkpj,bkqj->bjpq", G, G.conj()) / _INSIDE)


def size(p: int) -> int:
    """Numbers of S_0: reflections, a triangle, logarithms of white variances; p outputs."""
    return ORDER * p + p * (p + 1) // 2 + p


def outputs(theta: Array, found: Spectrum) -> tuple[Complex, Callable[[Complex], Array]]:
    """S_0 (b, p, p), and what reads its gradient off W (b, p, p) as in the module's text."""
    p = len(found.size)
    H, slopes = _filters(theta[: ORDER * p].reshape(p, ORDER), found.angles)
    factor, free = np.zeros((p, p)), np.ones((p, p))
    factor[np.tril_indices(p)] = theta[ORDER * p : size(p) - p]
    diagonal, inside = _clipped(np.diag(factor), -_DIAGONAL, _DIAGONAL)
    factor[np.diag_indices(p)] = np.exp(diagonal)
    free[np.diag_indices(p)] = inside * np.exp(diagonal)
    logs, moving = _clipped(theta[size(p) - p : size(p)], *_VARIANCE)
    root, white = H[:, :, None] * factor, np.exp(logs)
    S = root @ np.swapaxes(root.conj(), 1, 2) + np.diag(white)

    def gradient(W: Complex) -> Array:
        """Of sum tr(W dS): dS = dR R* + R dR*."""
        back = 2 * np.swapaxes(root.conj(), 1, 2) @ W
        own = np.einsum("bjk,kj->bk", back, factor)  # along H_k
        reflections = np.einsum("bk,bkr->kr", own, slopes).real
        triangle = np.einsum("bji,bi->ij", back, H).real * free
        whites = np.einsum("bii->i", W).real * white * moving
        return np.concatenate([np.ravel(reflections), triangle[np.tril_indices(p)], whites])

    return S, gradient


def _filters(theta: Array, angles: Array) -> tuple[Complex, Complex]:
    """H (b, p) of each output, and its slopes along the arguments of its reflections (b, p, r)."""
    powers = np.exp(-1j * np.outer(angles, np.arange(ORDER + 1)))
    arguments, free = _clipped(theta, -_REFLECTION, _REFLECTION)
    reflections = np.tanh(arguments)
    models = np.zeros((len(theta), 1 + ORDER, ORDER + 1))  # the polynomial, and its derivatives
    models[:, 0, 0] = 1.0
    for r in range(ORDER):
        turned = np.zeros_like(models)
        turned[..., : r + 2] = models[..., : r + 2][..., ::-1]
        before = turned[:, 0].copy()
        models = models + reflections[:, r, None, None] * turned
        models[:, 1 + r] += before
    found = np.einsum("bo,pko->bpk", powers, models)
    H = 1 / found[..., 0]
    return H, -(H**2)[..., None] * found[..., 1:] * (free * (1 - reflections**2))


def loops(
    theta: Array, shapes: Complex, found: Spectrum
) -> tuple[Complex, Callable[[Complex], Array]]:
    """G W G* (b, p, p), and what reads its gradient off as for `outputs`."""
    logs, moving = _clipped(theta[:-1], *_VARIANCE)
    root, variances = root_of(theta), np.exp(logs)
    free = _clipped(theta[-1], -_ROOT, _ROOT)[1]
    apart = np.abs(1 - root * np.exp(-1j * found.angles)) ** 2
    colour = (1 - root**2) / apart
    # |1 - r e^-iw|^2 = 1 - 2 r cos w + r^2.
    slope = -2 * root / apart - colour * (2 * root - 2 * np.cos(found.angles)) / apart
    S = np.einsum("j,bjpq,b->bpq", variances, shapes, colour)

    def gradient(W: Complex) -> Array:
        each = np.einsum("bqp,bjpq->bj", W, shapes).real * variances
        along = float(np.sum(each * slope[:, None])) * free * (1 - root**2)
        return np.append(colour @ each * moving, along)

    return np.asarray(S), gradient


def root_of(theta: Array) -> float:
    """Of the noise at the inputs, from the unknowns `theta` of `loops` or of both models (any,)."""
    return float(np.tanh(np.clip(theta[-1], -_ROOT, _ROOT)))


def misfit(S: Complex, found: Spectrum) -> tuple[float, Complex]:
    """Minus Whittle's log-likelihood of S (b, p, p), and W (b, p, p): its slope is sum tr(W dS)."""
    eye = np.eye(S.shape[1])
    least = _FLOOR + _OWN * np.einsum("bii->b", S).real
    inverse = np.linalg.inv(S + least[:, None, None] * eye)
    identified = inverse @ found.power
    value = np.einsum("bii->b", identified).real - np.linalg.slogdet(inverse)[1]
    W = found.counts[:, None, None] * (inverse - identified @ inverse)
    own = _OWN * np.einsum("bii->b", W).real
    return float(found.counts @ value), W + own[:, None, None] * eye


def _clipped(value: Array, low: float, high: float) -> tuple[Array, Array]:
    """A number inside its ends, and its slope."""
    return np.clip(value, low, high), np.where((value > low) & (value < high), 1.0, 0.0)


# One false alarm in a hundred where the output noise is as the first model says; a share below a
# fifth biases no gain by more than its deviation (docs/fitting.md).
_LEVEL, _LEAST_SHARE = 0.99, 0.2
# Of the recordings: below it residuals are rounding.
_EXACT = 1e-7


@dataclass(frozen=True)
class LoopNoise:
    """How much of the residuals looks like noise inside the fitted loop."""

    shares: Array  # Share of each output's residual variance that is laid to the loop (p,), 0 to 1
    statistic: float  # Twice the gain in log-likelihood
    threshold: float  # What output noise exceeds in one of a hundred recordings
    root: float  # Of the noise at the loop's input: 0 when it is white

    @property
    def found(self) -> bool:
        """Whether noise inside the loop differs from noise in the recorder, and matters."""
        return self.statistic > self.threshold and bool(np.max(self.shares) >= _LEAST_SHARE)


def loop_noise_of(estimate: IdentifiedGain) -> LoopNoise | None:
    """The same of the residuals of a fit; None of an exact one, or of recordings with gaps."""
    problem = estimate.problem
    found = evaluate(problem, np.array(estimate.K), np.array(estimate.S))
    exact = np.linalg.norm(found.residual) <= _EXACT * recorded_size(problem)
    if found.reason or exact or any(trial.has_gaps for trial in problem.recordings):
        return None
    p = len(problem.plant.outputs)
    residuals = [-part[:, :p] * problem.output_scale for part in by_trial(problem, found.residual)]
    return loop_noise(problem.plant, np.array(estimate.K), residuals)


def loop_sentence(loop: LoopNoise, outputs: tuple[str, ...], saturated: float) -> str:
    """What to say first where such noise was found; `saturated` is a share of the samples."""
    index = int(np.argmax(loop.shares))
    seen = (
        f"Warning: what the fit leaves looks like noise inside the loop and not in the recorder: "
        f"{100 * loop.shares[index]:.0f} % of the residual of {outputs[index]} has the response of "
        f"the fitted loop (likelihood ratio {loop.statistic:.0f}, threshold {loop.threshold:.1f})."
    )
    if saturated > 0:
        return (
            f"{seen} The command is at its bound for {100 * saturated:.1f} % of the time: the "
            f"gain is then biased by as much as half, at a high VAF too, and 95 % intervals of it "
            f"held the truth in 0 to 40 % of simulated subjects. Do not rely on the gain, the "
            f"weights or their intervals."
        )
    return (
        f"{seen} The gain is scattered more than by noise in the recorder, and 95 % intervals held "
        f"the truth in 83 to 92 % of simulated subjects."
    )


def loop_noise(plant: Plant, gain: Array, residuals: list[Array]) -> LoopNoise | None:
    """Compare the two models on the residuals of a fit; `gain` (m, n); `residuals` (samples, p)."""
    found = spectrum(residuals)
    if found is None:
        return None
    shapes = loop_shapes(plant, gain, found)
    sizes = np.sqrt(np.mean(np.einsum("bjii->bj", shapes).real, axis=0))
    if not np.all(sizes > 0):
        return None
    shapes = shapes / sizes[:, None, None] ** 2
    p, m = len(found.size), plant.m

    def alone(theta: Array) -> tuple[float, Array]:
        """The first model."""
        S, gradient = outputs(theta, found)
        value, W = misfit(S, found)
        return value, gradient(W)

    def inside(theta: Array) -> tuple[float, Array]:
        """The second."""
        own, along_own = outputs(theta[: size(p)], found)
        more, along_more = loops(theta[size(p) :], shapes, found)
        value, W = misfit(own + more, found)
        return value, np.concatenate([along_own(W), along_more(W)])

    first = _minimise(alone, _start(found, p))
    both = [
        _minimise(inside, np.concatenate([begin, np.full(m, np.log(share)), [root]]))
        for begin, share, root in (
            (_lowered(first.x, p, 0.05), 0.05, 0.0),
            (_lowered(first.x, p, 0.9), 0.9, 1.5),
            (_plain(p), 1.0, 0.0),
        )
    ]
    best = min(both, key=lambda item: float(item.fun))
    # The first model once more, from the second's outputs: its optimum must not be a worse one.
    again = _minimise(alone, best.x[: size(p)])
    least = min(float(first.fun), float(again.fun))
    statistic = max(0.0, 2 * (least - float(best.fun)))
    # Autoregressions can take over much of a loop's answer: of readings that gain at least half as
    # much as the best, the one that lays most to the loop.
    good = [item for item in both if 2 * (least - float(item.fun)) >= statistic / 2]
    shares, root = max(
        ((_shares(item.x, shapes, found), root_of(item.x)) for item in good or [best]),
        key=lambda pair: float(np.max(pair[0])),
    )
    threshold = float(scipy.special.chdtri(m + 1, 1 - _LEVEL))
    return LoopNoise(frozen(shares), statistic, threshold, root)


def _shares(theta: Array, shapes: Complex, found: Spectrum) -> Array:
    """Of each output's variance, what the loop has."""
    own = size(len(found.size))
    parts = loops(theta[own:], shapes, found)[0], outputs(theta[:own], found)[0]
    inside, outside = (np.einsum("b,bii->i", found.counts, part).real for part in parts)
    return np.asarray(inside / (inside + outside))


def _start(found: Spectrum, p: int) -> Array:
    """Autoregressions of each output by Levinson's recursion, a little white noise beside them."""
    lags = np.arange(ORDER + 1)[:, None]
    own = np.einsum("bii->bi", found.power).real * found.counts[:, None]
    covariances = np.cos(lags * found.angles) @ own / own.sum(axis=0)
    reflections, left = np.zeros((p, ORDER)), np.ones(p)
    for output in range(p):
        model = np.ones(1)
        for order in range(ORDER):
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
    return np.concatenate([np.zeros(ORDER * p), triangle, np.full(p, np.log(1e-2))])


def _lowered(theta: Array, p: int, share: float) -> Array:
    """Output noise of what is left when the loop takes a share."""
    result = theta.copy()
    diagonal = ORDER * p + np.cumsum(np.arange(1, p + 1)) - 1
    result[diagonal] += np.log(1 - share) / 2
    result[size(p) - p : size(p)] += np.log(1 - share)
    return result


def _minimise(misfit: Callable[[Array], tuple[float, Array]], start: Array) -> Any:
    # A likelihood of some 1e4 to 1e-3 a step: the threshold is 9, and searches creep.
    options: Any = {"ftol": 1e-7, "maxiter": 300}
    return scipy.optimize.minimize(misfit, start, jac=True, method="L-BFGS-B", options=options)
