"""What the residuals of a fit say against it: noise inside the loop, and model error.

Intervals hold for stationary noise in the recorder. Two things break that without lowering the VAF:
noise that enters the loop and is answered (`loop_noise`), and a body that is not the model's
(`residual_structure`). Either becomes a warning that comes first on the page (docs/fitting.md).

Whether the residuals of a fit look like noise that entered the loop and was answered.

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
import scipy.special

from impc.arrays import Array, frozen
from impc.assess.residual_structure import ResidualStructure, residual_structure
from impc.assess.whittle import ORDER, loop_shapes, loops, misfit, outputs, root_of, size, spectrum
from impc.inverse.residuals import evaluate

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.assess.whittle import Complex, Spectrum
    from impc.inverse.problem import Problem
    from impc.model.plant import Plant


@dataclass(frozen=True)
class ResidualDiagnostics:
    """Both tests; each None where there is nothing to test."""

    loop: LoopNoise | None
    structure: ResidualStructure | None

    @property
    def contradicted(self) -> bool:
        """Whether either finds something."""
        return any(test is not None and test.found for test in (self.loop, self.structure))


def residual_diagnostics(problem: Problem, gain: Array, metric: Array) -> ResidualDiagnostics:
    """Run both tests.

    `gain` (m, n); `metric` (m, m).
    """
    found = evaluate(problem, gain, metric)
    if found.reason:
        return ResidualDiagnostics(None, None)
    p, row, residuals = len(problem.plant.outputs), 0, []
    for trial in problem.recordings:
        mine = found.residual[row : row + trial.outputs.size].reshape(-1, p)
        residuals.append(-mine * problem.output_scale)
        row += trial.outputs.size
    structure = residual_structure(problem, gain, found)
    # Nothing but rounding is left of an exact fit: neither test has anything to say.
    loop = None if structure is None else loop_noise(problem.plant, gain, residuals)
    return ResidualDiagnostics(loop, structure)


def residual_warnings(
    found: ResidualDiagnostics, outputs: tuple[str, ...], saturated: float
) -> tuple[str, ...]:
    """What to tell first: one sentence or two for each test that is positive."""
    told = []
    if found.loop is not None and found.loop.found:
        told.append(_loop_sentence(found.loop, outputs, saturated))
    if found.structure is not None and found.structure.found:
        told.append(_structure_sentence(found.structure))
    return tuple(told) if saturated > 0 else tuple(reversed(told))


def _loop_sentence(loop: LoopNoise, outputs: tuple[str, ...], saturated: float) -> str:
    index = int(np.argmax(loop.shares))
    seen = (
        f"Warning: what the fit leaves looks like noise inside the loop and not in the recorder: "
        f"{100 * loop.shares[index]:.0f} % of the residual of {outputs[index]} has the response of "
        f"the fitted loop (likelihood ratio {loop.statistic:.0f}, threshold {loop.threshold:.1f})."
    )
    if saturated > 0:
        return (
            f"{seen} The command stands at its bound for {100 * saturated:.1f} % of the time: the "
            f"gain is then biased by as much as half, at a high VAF too, and 95 % intervals of it "
            f"held the truth in 0 to 40 % of simulated subjects. Do not rely on the gain, the "
            f"weights or their intervals."
        )
    return (
        f"{seen} The gain is scattered more than by noise in the recorder, and 95 % intervals held "
        f"the truth in 83 to 92 % of simulated subjects."
    )


def _structure_sentence(structure: ResidualStructure) -> str:
    least = min(structure.p_linear, structure.p_nonlinear)
    return (
        f"Warning: {100 * structure.share:.0f} % of what the fit leaves follows the perturbation "
        f"or the motion that it caused (p = {least:.3f}), as noise does not: the body or the "
        f"controller that moved is not that of the model. The intervals on this page hold noise "
        f"only. They do not contain this error, which may be many times wider."
    )


# One false alarm in a hundred where the output noise is as the first model says; a share below a
# fifth biases no gain by more than its deviation (docs/fitting.md).
_LEVEL, _LEAST_SHARE = 0.99, 0.2


@dataclass(frozen=True)
class LoopNoise:
    """How much of the residuals looks like noise inside the fitted loop."""

    shares: Array  # Share of each output's residual variance that is laid to the loop (p,), 0 to 1
    statistic: float  # Twice the gain in log-likelihood
    threshold: float  # What output noise exceeds in one of a hundred recordings
    root: float  # Of the noise at the loop's input: 0 when it is white

    @property
    def found(self) -> bool:
        """Whether noise inside the loop is told from noise in the recorder, and matters."""
        return self.statistic > self.threshold and bool(np.max(self.shares) >= _LEAST_SHARE)


def loop_noise(plant: Plant, gain: Array, residuals: list[Array]) -> LoopNoise | None:
    """Compare the two models on the residuals of a fit.

    `gain` (m, n); `residuals` (samples, p).
    """
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
