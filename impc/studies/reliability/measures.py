"""Measures of one trial: root-mean-square about upright, and mean bandpass signal energy (2.1).

    RMS  = sqrt( mean y^2 )                        about 0, upright: the mean is not removed
    E_mb = df sum_{i = l..h} Phi(f_i)              (2.1), Phi one-sided power spectral density

The passband l..h is the largest contiguous range in which the input's power is above 3 % of its
peak. A ternary sequence has no power at even harmonics of its period, so that no range of raw
frequencies is contiguous: it is looked for among the frequencies that the input excites. An input
that was cut inside a period, or is not periodic, excites all of them, unevenly: its power is then
averaged over seven neighbours first.

Empirical transfer function estimates from the input to each output, with coherence.

    G(f_k) = Y(f_k) / U(f_k)                                  one trial (ETFE, Ljung 1999)
    G(f_k) = sum_j Y_j conj(U_j) / sum_j |U_j|^2              several trials, H1
    C(f_k) = |sum_j Y_j conj(U_j)|^2 / (sum_j |U_j|^2 sum_j |Y_j|^2)

at the excited frequencies of the passband. The loop is closed, and no obstacle: the torque on the
seat comes from outside. With trials of one and the same input H1 is the mean of the trials' ETFE.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.ndimage
import scipy.signal

from impc.arrays import Array, IntArray
from impc.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Sequence

# Power below this share of the peak is none: rounding, and what a window leaks.
_NOTHING = 1e-6
# A period's odd harmonics are half of all frequencies.
_MOST_LINES = 0.6
_NEIGHBOURS = 7


@dataclass(frozen=True)
class Passband:
    """Range of frequencies."""

    low: float  # Hz, both inside
    high: float
    # Indices (f,) of the excited frequencies inside, on the grid of the input's periodogram
    excited: IntArray


def rms(outputs: Array) -> Array:
    """Root-mean-square about upright of each output (p,), in its unit; outputs (samples, p)."""
    return np.asarray(np.sqrt(np.mean(np.asarray(outputs) ** 2, axis=0)))


def passband(signal: Array, rate: float) -> Passband:
    """Largest contiguous range of excited frequencies of a `signal` (samples,) at `rate` per s."""
    frequency, power = scipy.signal.periodogram(signal, rate, detrend=False)
    power[0] = 0.0
    peak = float(power.max(initial=0.0))
    if peak <= 1e-24 * max(float(np.mean(np.asarray(signal) ** 2)), 1e-300) or peak == 0:
        raise DataError("input", "is constant: its passband is empty", "check its column")
    excited = np.flatnonzero(power > _NOTHING * peak)
    if len(excited) > _MOST_LINES * len(power):  # no line spectrum
        power = scipy.ndimage.uniform_filter1d(power, _NEIGHBOURS)
        peak = float(power.max())
    above = power[excited] > 0.03 * peak
    runs = np.split(np.arange(len(excited)), np.flatnonzero(np.diff(above.astype(int))) + 1)
    inside = [run for run in runs if above[run[0]]]
    best = max(inside, key=lambda run: int(excited[run[-1]] - excited[run[0]]))
    found = excited[best]
    return Passband(float(frequency[found[0]]), float(frequency[found[-1]]), found)


def band_energy(outputs: Array, rate: float, low: float, high: float) -> Array:
    """(2.1) of outputs (samples, p) at `rate` per s: (p,), in their unit squared."""
    frequency, power = scipy.signal.periodogram(outputs, rate, detrend=False, axis=0)
    step = float(frequency[1] - frequency[0])
    rounding = 1e-6 * step
    inside = (frequency >= low - rounding) & (frequency <= high + rounding)
    if not np.any(inside):
        raise DataError(
            "passband", f"{low:g} to {high:g} Hz holds no frequency of the trial",
            "give longer trials",
        )  # fmt: skip
    return np.asarray(step * np.sum(power[inside], axis=0))


#: An array of complex numbers.
ComplexArray = np.ndarray[tuple[int, ...], np.dtype[np.complex128]]


@dataclass(frozen=True)
class TransferFunction:
    """Estimate at a few frequencies."""

    frequency: Array  # Hz (f,)
    response: ComplexArray  # Output over input (f, p)
    coherence: Array  # (f, p); 1 for a single trial, which cannot say


def transfer_function(
    inputs: Sequence[Array], outputs: Sequence[Array], rate: float, band: Passband
) -> TransferFunction:
    """From trials of one length: inputs (samples,), outputs (samples, p), at `rate` per s."""
    if not inputs:
        raise DataError("transfer function", "has no trial", "give one or more")
    lengths = {len(item) for item in (*inputs, *outputs)}
    if len(lengths) > 1:
        raise DataError(
            "trials", f"have {', '.join(map(str, sorted(lengths)))} samples", "cut them alike"
        )
    (samples,) = lengths
    chosen = band.excited
    if chosen[-1] > samples // 2:
        raise DataError("trials", "are shorter than the input of the passband", "cut them alike")
    U = np.array([np.fft.rfft(item)[chosen] for item in inputs])
    Y = np.array([np.fft.rfft(item, axis=0)[chosen] for item in outputs])
    power = np.sum(np.abs(U) ** 2, axis=0)[:, None]
    cross = np.sum(Y * np.conj(U)[..., None], axis=0)
    total = power * np.sum(np.abs(Y) ** 2, axis=0)
    coherence = np.divide(np.abs(cross) ** 2, total, out=np.zeros(total.shape), where=total > 0)
    return TransferFunction(np.asarray(chosen * (rate / samples)), cross / power, coherence)
