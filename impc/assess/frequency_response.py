"""Frequency response from the perturbation to the outputs, recorded and modelled.

H = S_dy / S_dd by Welch's method over pieces of all trials and bands of frequencies, with
coherence. The model is estimated in the same way from its simulated outputs, so that windows and
limits affect both equally. Frequencies above those that the outputs follow are left out. With
coherence c from n independent pieces the magnitude has a relative standard error of sqrt((1 - c) /
(2 n c)) (Bendat and Piersol 2010, 9.90).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.signal

from impc.arrays import Array, Frozen, IntArray, frozen
from impc.control.simulation import Simulation
from impc.inverse.problem import Problem
from impc.model.foresight import physical_disturbances
from impc.model.recordings import Recording

# Length of a piece in s, its least number of samples, and the least number of pieces.
_PIECE, _LEAST, _FEWEST = 10.0, 32, 4
# Least power of a driven frequency relative to the largest.
_DRIVEN = 1e-3
# Consecutive bands without coherence that end the response.
_GAP = 3
# Width of an averaging band relative to its frequency.
_WIDTH = 0.1


@dataclass(frozen=True)
class FrequencyResponse(Frozen):
    """Responses of the outputs to the strongest driving signal."""

    signal: str  # Driving signal: a disturbance, or the target of an output
    frequencies: Array  # Hz (f,)
    recorded: Array  # Magnitude in output units over signal units (f, p); phase in degrees
    recorded_phase: Array
    modelled: Array
    modelled_phase: Array
    coherence: Array  # Of the recorded outputs (f, p)
    errors: Array  # Relative standard error of the recorded magnitude (f, p)
    threshold: Array  # 95 % quantile of the coherence without any relation (f,)


def frequency_response(problem: Problem, runs: Sequence[Simulation]) -> FrequencyResponse | None:
    """Response over the trials without gaps; None if too short or not driven."""
    plant = problem.plant
    trials, whole = _usable(problem, runs)
    if not trials:
        return None
    count = physical_disturbances(plant)
    names = [*plant.disturbances[:count], *trials[0].signals]
    drives = [np.hstack([one.disturbance[:, :count], one.target]) for one in trials]
    if not names or any(one.signals != trials[0].signals for one in trials):
        return None
    power = np.sum([np.var(part, axis=0) for part in drives], axis=0)
    column = int(np.argmax(power))
    length = min(max(round(_PIECE / plant.dt), _LEAST), *(one.samples for one in trials))
    count = sum(2 * (one.samples // length) - 1 for one in trials)
    if count < _FEWEST or power[column] == 0:
        return None
    drive = [part[:, column, None] for part in drives]
    outputs = [one.corrected for one in trials]
    model = [run.x[: len(part)] @ plant.C.T for run, part in zip(whole, outputs, strict=True)]
    frequencies = np.asarray(np.fft.rfftfreq(length, plant.dt), np.float64)
    bands = _bands(frequencies)
    sizes = np.diff(np.append(bands, len(frequencies)))[:, None]

    def averaged(first: list[Array], second: list[Array]) -> Array:
        spectrum = _spectrum(first, second, length, plant.dt)
        return np.asarray(np.add.reduceat(spectrum, bands, axis=0) / sizes)

    driven, own = averaged(drive, drive).real, averaged(outputs, outputs).real
    across = averaged(drive, outputs)
    coherence = np.clip(np.abs(across) ** 2 / np.maximum(driven * own, 1e-300), 1e-12, 1.0)
    independent = np.maximum(1.0, 0.6 * count * sizes)  # neighbouring pieces overlap by half
    threshold = 1 - 0.05 ** (1 / np.maximum(independent - 1, 1))
    known = np.any(coherence > threshold, axis=1) & (driven[:, 0] > _DRIVEN * driven.max())
    gaps = np.flatnonzero(np.convolve(~known, np.ones(_GAP), "valid") == _GAP)
    used = slice(0, int(gaps[0]) if len(gaps) else len(known))
    if not np.any(known[used]):
        return None
    recorded, modelled = across / driven, averaged(drive, model) / driven
    parts = [
        np.add.reduceat(frequencies, bands) / sizes[:, 0],
        np.abs(recorded),
        np.degrees(np.unwrap(np.angle(recorded), axis=0)),
        np.abs(modelled),
        np.degrees(np.unwrap(np.angle(modelled), axis=0)),
        coherence,
        np.sqrt((1 - coherence) / (2 * independent * coherence)),
        threshold[:, 0],
    ]
    return FrequencyResponse(names[column], *(frozen(part[used]) for part in parts))


def _usable(
    problem: Problem, runs: Sequence[Simulation]
) -> tuple[list[Recording], list[Simulation]]:
    """Trials without gaps whose simulation is complete, with it."""
    pairs = [
        (trial, run)
        for trial, run in zip(problem.recordings, runs, strict=True)
        if not trial.has_gaps and run.complete
    ]
    return [trial for trial, _ in pairs], [run for _, run in pairs]


def _spectrum(first: list[Array], second: list[Array], length: int, dt: float) -> Array:
    """Cross spectrum over pieces of all trials (f, p)."""
    found = [
        scipy.signal.csd(one, other, 1 / dt, nperseg=length, axis=0)[1]
        for one, other in zip(first, second, strict=True)
    ]
    return np.average(found, axis=0, weights=[2 * (len(one) // length) - 1 for one in first])


def _bands(frequencies: Array) -> IntArray:
    """First index of each band: single frequencies, then bands of relative width."""
    found = [1]
    for k in range(2, len(frequencies)):
        if frequencies[k] >= (1 + _WIDTH) * frequencies[found[-1]]:
            found.append(k)
    return np.array(found)
