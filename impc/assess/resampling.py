"""Block bootstrap of a fitted controller: simulate, add resampled residuals, refit.

The disturbance is the same in every replicate. Residuals are drawn in moving blocks from those of
all trials (Künsch 1989). The block length is that of Politis and White (2004) for a first-order
process, (6 a^2 / (1 - a^2)^2)^(1/3) T^(1/3), the longest over the outputs. Parameters with a stated
uncertainty are redrawn about the estimate.

Replicate k uses the k-th child of the seed, so that results do not depend on order or machine. The
refit starts at the estimate and moves only the gain (`refit`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.assess.printed_gain import GainEstimate, Interval, entry_names
from impc.checking import replace
from impc.inverse.problem import Problem, modelled, recorded, simulated
from impc.inverse.refit import refit
from impc.model.recordings import Recording


@dataclass(frozen=True)
class Replicate(Frozen):
    """Estimates of one replicate."""

    K: Array  # (m, n), see `refit`
    parameters: Array  # Physical parameters in their units (k,)


def replicate(problem: Problem, gain: Array, metric: Array, index: int, seed: int) -> Replicate:
    """Replicate number `index` of an estimate: `problem` at its values, and its controller."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index,)))
    trials = resampled_trials(problem, gain, metric, rng)
    again = replace(_body_measured_again(problem, rng), recordings=trials)
    found = refit(again, gain, metric)
    return Replicate(found.K, frozen(found.parameters))


def resampled_trials(
    problem: Problem, gain: Array, metric: Array, rng: np.random.Generator
) -> tuple[Recording, ...]:
    """Recordings as simulated by an estimate, with resampled residuals."""
    runs, p = simulated(problem, gain, metric), len(problem.plant.outputs)
    pairs = [(one, modelled(problem, one, run))
             for one, run in zip(problem.recordings, runs, strict=True)]  # fmt: skip
    residuals = [np.nan_to_num(recorded(problem, one) - values) for one, values in pairs]
    trials = []
    for (trial, values), noise in zip(pairs, block_residuals(residuals, rng), strict=True):
        new = values + noise + 0 * recorded(problem, trial)  # missing values stay missing
        commands = new[:, p:] if len(trial.commands) else trial.commands
        trials.append(replace(trial, outputs=frozen(new[:, :p]), commands=frozen(commands)))
    return tuple(trials)


def _body_measured_again(problem: Problem, rng: np.random.Generator) -> Problem:
    """Same plant with redrawn nominal values of the uncertain parameters."""
    if problem.family is None or not np.any(problem.stated):
        return problem
    error = problem.parameter_units * rng.standard_normal(len(problem.stated))
    moved = np.where(problem.stated, problem.logarithms + error, 0.0)
    family = replace(problem.family, nominal=frozen(problem.family.nominal * np.exp(moved)))
    return replace(problem, family=family, logarithms=frozen(problem.logarithms - moved))


def bootstrap_intervals(
    estimate: GainEstimate, replicates: Sequence[Replicate], method: str, level: float
) -> tuple[Interval, ...]:
    """Percentile intervals of gain entries and free parameters; infinite if unidentified."""
    problem, free = estimate.problem, ~estimate.problem.stated
    names = [*entry_names(problem.plant), *np.array(problem.parameter_names)[free].tolist()]
    values = np.append(np.ravel(estimate.K), estimate.parameters[free])
    drawn = np.array([np.append(np.ravel(one.K), one.parameters[free]) for one in replicates])
    low, high = np.quantile(drawn, [0.5 - level / 2, 0.5 + level / 2], axis=0)
    identified = np.append(
        np.ravel(estimate.covariance.individually_identified), np.ones(np.count_nonzero(free), bool)
    )
    # Replicates stay at the start along unidentified directions: their spread has no meaning.
    low, high = np.where(identified, low, -np.inf), np.where(identified, high, np.inf)
    return tuple(
        Interval(name, method, level, float(value), float(one), float(other), bool(known))
        for name, value, one, other, known in zip(names, values, low, high, identified, strict=True)
    )


def block_residuals(residuals: list[Array], rng: np.random.Generator) -> list[Array]:
    """Resample the `residuals` (samples, p) of each trial in moving blocks."""
    centred = [part - np.mean(part, axis=0) for part in residuals]
    length = block_length(residuals)
    drawn = []
    for part in centred:
        blocks: list[Array] = []
        while sum(map(len, blocks)) < len(part):
            source = centred[rng.integers(len(centred))]
            first = rng.integers(max(len(source) - length, 0) + 1)
            blocks.append(source[first : first + length])
        drawn.append(np.concatenate(blocks)[: len(part)])
    return drawn


def block_length(residuals: list[Array]) -> int:
    """Block length in samples for `residuals` (samples, p)."""
    above = sum(np.sum(part[1:] * part[:-1], axis=0) for part in residuals)
    below = sum(np.sum(part**2, axis=0) for part in residuals)
    root = np.clip(np.divide(above, below, out=np.zeros_like(below), where=below > 0), -0.99, 0.99)
    total = sum(map(len, residuals))
    best = np.max(np.cbrt(6 * root**2 / (1 - root**2) ** 2 * total))
    return int(np.clip(np.ceil(best), 1, min(map(len, residuals))))
