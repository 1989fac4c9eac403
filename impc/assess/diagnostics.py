"""What the residuals of a fit say against it: noise inside the loop, and model error.

Intervals hold for stationary noise in the recorder. Two things break that without lowering the VAF:
noise that enters the loop and is answered (`loop_noise`), and a body that is not the model's
(`residual_structure`). Either becomes a warning that comes first on the page (docs/fitting.md).

Whether the residuals of a fit follow what drove the recordings: model error, not noise.

Noise knows nothing of the perturbation. Where the body that moved is not the one of the fit, a part
of the residuals is a function of the perturbation and of the motion that it caused. Two families of
such functions, each delayed over the time that the loop takes to settle:

    linear      the disturbances
    nonlinear   products of two and of three of the simulated outputs

Their part that gain, initial states and parameters can make up for is taken out; what share of the
residuals the rest explains is compared with what it explains of the same residuals shifted in time,
trial by trial and around the end. A shift keeps the colour of the noise and cuts every tie to the
perturbation, so the test holds for noise of any colour (docs/fitting.md has how often it speaks).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array
from impc.assess.covariance import by_trial
from impc.assess.loop_noise import LoopNoise, loop_noise
from impc.checking import replace
from impc.inverse.least_squares import trial_span
from impc.inverse.problem import recorded
from impc.inverse.residuals import evaluate

if TYPE_CHECKING:
    from impc.inverse.problem import Problem
    from impc.inverse.residuals import Evaluation


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
    """Run both tests; `gain` (m, n); `metric` (m, m)."""
    found = evaluate(problem, gain, metric)
    if found.reason:
        return ResidualDiagnostics(None, None)
    p = len(problem.plant.outputs)
    residuals = [-part[:, :p] * problem.output_scale for part in by_trial(problem, found.residual)]
    structure = residual_structure(problem, gain, found)
    # Nothing but rounding is left of an exact fit: neither test has anything to say.
    # Of residuals with gaps the spectrum is another.
    gaps = any(trial.has_gaps for trial in problem.recordings)
    loop = None if structure is None or gaps else loop_noise(problem.plant, gain, residuals)
    return ResidualDiagnostics(loop, structure)


def residual_warnings(
    found: ResidualDiagnostics, outputs: tuple[str, ...], saturated: float
) -> tuple[str, ...]:
    """What to say first: one sentence or two for each test that is positive."""
    identified = []
    if found.loop is not None and found.loop.found:
        identified.append(_loop_sentence(found.loop, outputs, saturated))
    if found.structure is not None and found.structure.found:
        identified.append(_structure_sentence(found.structure))
    return tuple(identified) if saturated > 0 else tuple(reversed(identified))


def _loop_sentence(loop: LoopNoise, outputs: tuple[str, ...], saturated: float) -> str:
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


def _structure_sentence(structure: ResidualStructure) -> str:
    least = min(structure.p_linear, structure.p_nonlinear)
    return (
        f"Warning: {100 * structure.share:.0f} % of what the fit leaves follows the perturbation "
        f"or the motion that it caused (p = {least:.3f}), as noise does not: the body or the "
        f"controller that moved is not that of the model. The intervals on this page hold noise "
        f"only. They do not contain this error, which may be many times wider."
    )


_FAMILIES = ("linear", "nonlinear")
# False alarms, both families together.
_LEVEL = 0.05
# Motor noise in a loop that saturates leaves up to 2 % on the linear seat, its nonlinear body 13 to
# 20 % (12 and 8 subjects, docs/fitting.md).
_LEAST_SHARE = 0.03
_SHIFTS, _LAGS = 199, 8
# Recorded numbers that are looked at: 100 000 take 0.5 GB.
_MOST = 100_000
# Residuals are not shifted by less than this share of a trial: nearby shifts keep a tie.
_LEAST_SHIFT = 0.1
# Of the fit's own rounding: below it there is nothing to test.
_EXACT = 1e-7


@dataclass(frozen=True)
class ResidualStructure:
    """What of the residuals follows the perturbation."""

    p_linear: float  # Probabilities of as much among shifted residuals, of 200 at least
    p_nonlinear: float
    # Of the residuals' variance: what the family of the smaller probability explains, beyond what
    # it explains of shifted ones
    share: float

    @property
    def found(self) -> bool:
        """Whether there is such a part, and more than a trifle of it."""
        identified = min(self.p_linear, self.p_nonlinear) <= _LEVEL / len(_FAMILIES)
        return identified and self.share >= _LEAST_SHARE


def residual_structure(
    problem: Problem, gain: Array, found: Evaluation
) -> ResidualStructure | None:
    """Test both families; `gain` (m, n)."""
    problem, found = _thinned(problem, found)
    p = len(problem.measured)
    lengths = [trial.samples for trial in problem.recordings]
    residual = found.residual.reshape(-1, p)
    values = np.concatenate([recorded(problem, item) for item in problem.recordings])
    known = np.nan_to_num(values / problem.scale)
    size = np.sqrt(np.mean(residual**2, axis=0))
    if found.reason or min(lengths) < 20 * _LAGS or np.any(size <= _EXACT * np.std(known)):
        return None
    weights = np.tile(1 / size, len(residual))
    fitted = np.hstack([found.dK.reshape(len(weights), -1), found.dparameters])
    sizes = problem.trial_sizes
    basis = trial_span(found.own * weights[:, None], sizes, fitted * weights[:, None])
    identified = np.ravel(residual / size)
    shifted = _shifted(residual / size, lengths, np.random.default_rng(0))
    simulated = residual + known
    span = _settling(problem, gain)
    results = []
    for columns in (_linear(problem), _nonlinear(simulated / np.std(simulated, axis=0))):
        rows: Array = np.kron(_delayed(columns, lengths, span), np.eye(p)).astype(np.float64)
        seen = _orthonormal(basis.without(rows))
        share = float(np.sum((seen.T @ identified) ** 2) / (identified @ identified))
        null = np.sum((seen.T @ shifted) ** 2, axis=0) / np.sum(shifted**2, axis=0)
        probability = (1 + int(np.count_nonzero(null >= share))) / (1 + _SHIFTS)
        results.append((probability, max(0.0, share - float(np.mean(null)))))
    (linear, _), (nonlinear, _) = results
    return ResidualStructure(linear, nonlinear, min(results, key=lambda r: (r[0], -r[1]))[1])


def _linear(problem: Problem) -> Array:
    columns = np.concatenate([trial.disturbance for trial in problem.recordings])
    return np.asarray(columns[:, np.ptp(columns, axis=0) > 0])


def _nonlinear(outputs: Array) -> Array:
    """y_i y_j and y_i^2 y_j."""
    p = outputs.shape[1]
    pairs = [outputs[:, i] * outputs[:, j] for i in range(p) for j in range(i, p)]
    triples = [outputs[:, i] ** 2 * outputs[:, j] for i, j in itertools.product(range(p), repeat=2)]
    return np.column_stack([*pairs, *triples])


def _thinned(problem: Problem, found: Evaluation) -> tuple[Problem, Evaluation]:
    """Every k-th trial of many, so that arrays of 199 shifts and of 112 delayed columns are small.

    Nothing is lost that matters: of so many samples any part above `_LEAST_SHARE` is found.
    """
    sizes = problem.trial_sizes
    every = -(-sum(sizes) // _MOST)
    if every == 1:
        return problem, found
    chosen = np.arange(len(sizes)) % every == 0
    rows = np.repeat(chosen, sizes)
    trials = tuple(itertools.compress(problem.recordings, chosen))
    parts = {
        name: getattr(found, name)[rows] for name in ("residual", "dK", "dS", "own", "dparameters")
    }
    return replace(problem, recordings=trials), replace(found, **parts)


def _settling(problem: Problem, gain: Array) -> int:
    """Samples in which the closed loop gives 19 of 20 parts of its answer to an impulse."""
    plant = problem.plant
    longest = min(trial.samples for trial in problem.recordings) // 4
    closed, state = plant.A - plant.B @ gain, np.hstack([plant.B, plant.E])
    energy = []
    for _ in range(longest):
        energy.append(np.sum((plant.C @ state / problem.output_scale[:, None]) ** 2))
        state = closed @ state
    gathered = np.cumsum(energy)
    return max(_LAGS, int(np.searchsorted(gathered, 0.95 * gathered[-1])))


def _delayed(columns: Array, lengths: list[int], span: int) -> Array:
    """Columns at `_LAGS` delays over the span, zero before each trial begins."""
    delays = np.unique(np.round(np.linspace(0, span, _LAGS)).astype(int))
    parts, row = [], 0
    for length in lengths:
        part = columns[row : row + length]
        row += length
        late = [np.vstack([np.zeros((d, part.shape[1])), part[: length - d]]) for d in delays]
        parts.append(np.hstack(late))
    return np.concatenate(parts)


def _shifted(residual: Array, lengths: list[int], rng: np.random.Generator) -> Array:
    """Residuals (samples, p) shifted around the end of each trial, one a column (samples p, s)."""
    drawn, row = [], 0
    for length in lengths:
        part = residual[row : row + length]
        row += length
        least = int(_LEAST_SHIFT * length)
        steps = rng.integers(least, length - least, size=_SHIFTS)
        drawn.append(np.stack([np.ravel(np.roll(part, step, axis=0)) for step in steps], axis=1))
    return np.concatenate(drawn)


def _orthonormal(columns: Array) -> Array:
    size = np.linalg.norm(columns, axis=0)
    scaled = columns[:, size > 0] / size[size > 0]
    if scaled.shape[1] == 0:
        return np.zeros((len(columns), 0))
    left, values, _ = np.linalg.svd(scaled, full_matrices=False)
    return np.asarray(left[:, values > 1e-8 * values[0]])
