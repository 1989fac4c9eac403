"""The part of a movement that repeats: what any deterministic controller can explain at most.

Where a perturbation comes again, in other trials or as a periodic one in the same, a controller
without noise of its own does the same each time. With R repetitions y_rt of n samples the noise has
the variance of what differs between them, and the ceiling of the VAF (3.24) is

    1 - s^2 / mean y^2,      s^2 = sum_rt (y_rt - mean_r y_rt)^2 / (n (R - 1)).

The interval follows from how s^2 scatters over pieces of time, which are taken as independent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.assess.covariance import TWO_SIDED

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.inverse.problem import Problem
    from impc.model.recordings import Recording

# Perturbations are the same up to this share of their size: that of a recorded torque's noise.
_SAME = 0.02
# Pieces of time, at least so many samples long each; fewer of them give no interval.
_PIECES, _SHORTEST, _FEWEST = 20, 25, 5


@dataclass(frozen=True)
class Ceiling(Frozen):
    """The largest VAF of each output that a controller without noise can have."""

    vaf: Array  # % (p,)
    low: Array  # Ends at 95 % (p,)
    high: Array
    repetitions: int  # Of the perturbation, in all


def ceiling(problem: Problem, settle: float) -> Ceiling | None:
    """The ceiling of recordings whose perturbation repeats; None where it does not.

    The first `settle` seconds of each trial do not count: there it comes from another state.
    """
    first = round(settle / problem.plant.dt)
    groups = [_repetitions(group, first) for group in _alike(problem.recordings, first)]
    groups = [group for group in groups if len(group) > 1]
    if not groups:
        return None
    pieces = [part for group in groups for part in _sums(group)]
    if len(pieces) < _FEWEST:
        return None
    noise, every = np.swapaxes(np.stack(pieces), 0, 1)  # (pieces, p) each
    total = np.maximum(every.sum(axis=0), 1e-300)
    whole = np.asarray(100 * (1 - noise.sum(axis=0) / total))
    error = 100 * np.sqrt(len(noise)) * np.std(noise, axis=0, ddof=1) / total
    low, high = (np.clip(whole + side * error, -np.inf, 100.0) for side in (-TWO_SIDED, TWO_SIDED))
    repetitions = sum(len(group) for group in groups)
    return Ceiling(frozen(whole), frozen(low), frozen(high), repetitions)


def _alike(recordings: Sequence[Recording], first: int) -> list[list[Recording]]:
    """The recordings in groups of the same perturbation, as far as all of a group last."""
    groups: list[list[Recording]] = []
    for trial in recordings:
        if trial.has_gaps or not np.any(trial.disturbance) or trial.samples <= first:
            continue
        for group in groups:
            if _same(np.array(group[0].disturbance), np.array(trial.disturbance)):
                group.append(trial)
                break
        else:
            groups.append([trial])
    return groups


def _same(one: Array, other: Array) -> bool:
    n = min(len(one), len(other))
    if n < max(len(one), len(other)) / 2:
        return False
    return bool(np.linalg.norm(one[:n] - other[:n]) <= _SAME * np.linalg.norm(one[:n]))


def _repetitions(group: list[Recording], first: int) -> list[Array]:
    """Outputs (samples, p) of each repetition: the trials, or the periods of them all."""
    samples = min(trial.samples for trial in group)
    period = _period(np.array(group[0].disturbance)[:samples])
    outputs = [trial.without_offset[:samples] for trial in group]
    if period is None or (samples - first) // period < 2:
        return [part[first:] for part in outputs]
    count = (samples - first) // period
    begin = samples - count * period
    return [part[begin + k * period :][:period] for part in outputs for k in range(count)]


def _period(disturbance: Array) -> int | None:
    """Samples after which a disturbance repeats, at least `_SHORTEST`; None where it does not."""
    size = np.linalg.norm(disturbance, axis=0).max()
    for lag in range(_SHORTEST, len(disturbance) // 2):
        if np.max(np.abs(disturbance[lag] - disturbance[0])) > size:
            continue
        here, there = disturbance[:-lag], disturbance[lag:]
        if np.linalg.norm(here - there) <= _SAME * np.linalg.norm(here):
            return lag
    return None


def _sums(group: list[Array]) -> list[Array]:
    """Squares of what differs, as noise, and of all, summed in pieces of time (2, p) each."""
    outputs = np.stack(group)
    apart = outputs - outputs.mean(axis=0)
    count = int(np.clip(outputs.shape[1] // _SHORTEST, 1, _PIECES))
    found = []
    for differs, whole in zip(
        np.array_split(apart, count, axis=1), np.array_split(outputs, count, axis=1), strict=True
    ):
        noise = np.sum(differs**2, axis=(0, 1)) * len(group) / (len(group) - 1)
        found.append(np.stack([noise, np.sum(whole**2, axis=(0, 1))]))
    return found
