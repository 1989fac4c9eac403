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
import scipy.signal

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
    """The recordings in groups of the same drive, as far as all of a group last."""
    groups: list[list[Recording]] = []
    for trial in recordings:
        if trial.has_gaps or trial.samples <= first or not np.any(_drive(trial)):
            continue
        for group in groups:
            if group[0].signals == trial.signals and _same(_drive(group[0]), _drive(trial)):
                group.append(trial)
                break
        else:
            groups.append([trial])
    return groups


def _drive(trial: Recording) -> Array:
    """What moves the person (samples, d + targets)."""
    return np.hstack([trial.disturbance, trial.target])


def _same(one: Array, other: Array) -> bool:
    n = min(len(one), len(other))
    if n < max(len(one), len(other)) / 2:
        return False
    apart = np.linalg.norm(one[:n] - other[:n], axis=0)
    return bool(np.all(apart <= _SAME * np.linalg.norm(one[:n], axis=0)))


def _repetitions(group: list[Recording], first: int) -> list[Array]:
    """Outputs (samples, p) of each repetition: the trials, or the periods of them all."""
    samples = min(trial.samples for trial in group)
    period = _period(_drive(group[0])[:samples])
    outputs = [trial.without_offset[:samples] for trial in group]
    if period is None or (samples - first) // period < 2:
        return [part[first:] for part in outputs]
    count = (samples - first) // period
    begin = samples - count * period
    return [part[begin + k * period :][:period] for part in outputs for k in range(count)]


def _period(drive: Array) -> int | None:
    """Samples after which a drive repeats, at least `_SHORTEST`; None where it does not.

    Of every lag at once: the squares of what differs are those of both parts less twice their
    correlation.
    """
    moving, n = drive - drive.mean(axis=0), len(drive)
    size = np.linalg.norm(moving, axis=0)
    moves = size > _SAME * np.linalg.norm(drive, axis=0)
    if n < 2 * _SHORTEST + 1 or not np.any(moves):
        return None
    moving = moving[:, moves] / size[moves]
    squares = np.cumsum(np.sum(moving**2, axis=1))
    lags = np.arange(_SHORTEST, n // 2)
    alike = [scipy.signal.correlate(one, one, method="fft")[n - 1 :] for one in moving.T]
    products = np.sum(alike, axis=0)
    here, there = squares[n - 1 - lags], squares[-1] - squares[lags - 1]
    apart = here + there - 2 * products[lags]
    found = lags[apart <= _SAME**2 * here]
    return int(found[0]) if len(found) else None


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
