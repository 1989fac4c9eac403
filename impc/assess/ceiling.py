"""Noise ceiling: the largest VAF that a deterministic controller can reach.

If a perturbation repeats, across trials or periodically within one, a noise-free controller
responds identically each time. With R repetitions y_rt of n samples, the variance between them
estimates the noise, and the ceiling of the VAF (3.24) is

    1 - s^2 / mean y^2,      s^2 = sum_rt (y_rt - mean_r y_rt)^2 / (n (R - 1)).

The interval follows from the scatter of s^2 over pieces of time, assumed independent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.signal

from impc.arrays import Array, Frozen, frozen
from impc.assess.covariance import TWO_SIDED
from impc.inverse.problem import Problem
from impc.model.recordings import Recording

# Relative difference up to which perturbations are equal: noise of a recorded torque.
_SAME = 0.02
# Pieces of time, least samples per piece, and least number of pieces for an interval.
_PIECES, _SHORTEST, _FEWEST = 20, 25, 5


@dataclass(frozen=True)
class Ceiling(Frozen):
    """Largest VAF of each output that a noise-free controller can reach."""

    vaf: Array  # % (p,)
    low: Array  # 95 % interval (p,)
    high: Array
    repetitions: int  # Repetitions of the perturbation in total


def ceiling(problem: Problem, settle: float) -> Ceiling | None:
    """Noise ceiling of recordings with a repeated perturbation; None without repetition.

    The first `settle` seconds of each trial are excluded: its initial state differs.
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
    """Groups of recordings with the same driving signals, over their common length."""
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
    """Driving signals: disturbances and targets (samples, d + targets)."""
    return np.hstack([trial.disturbance, trial.target])


def _same(one: Array, other: Array) -> bool:
    n = min(len(one), len(other))
    if n < max(len(one), len(other)) / 2:
        return False
    apart = np.linalg.norm(one[:n] - other[:n], axis=0)
    return bool(np.all(apart <= _SAME * np.linalg.norm(one[:n], axis=0)))


def _repetitions(group: list[Recording], first: int) -> list[Array]:
    """Outputs (samples, p) of each repetition: trials, or periods of all trials."""
    samples = min(trial.samples for trial in group)
    period = _period(_drive(group[0])[:samples])
    outputs = [trial.corrected[:samples] for trial in group]
    if period is None or (samples - first) // period < 2:
        return [part[first:] for part in outputs]
    count = (samples - first) // period
    begin = samples - count * period
    return [part[begin + k * period :][:period] for part in outputs for k in range(count)]


def _period(drive: Array) -> int | None:
    """Period of a signal in samples, at least `_SHORTEST`; None if it does not repeat.

    All lags at once: squared differences are both parts' squares minus twice the correlation.
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
    """Squared differences (as noise) and squares, summed over pieces of time, (2, p) each."""
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
