"""Measures of a trial: RMS about upright, bandpass energy (2.1), transfer function.

    RMS  = sqrt( mean y^2 )                        about 0, upright: the mean is not removed
    E_mb = df sum_{i = l..h} Phi(f_i)              (2.1), Phi one-sided power spectral density

The passband l..h is the largest contiguous range in which the input's power is above 3 % of its
peak, among the frequencies that the input excites (a ternary sequence has no power at even
harmonics of its period). If the input is not periodic, or cut inside a period, its power is first
averaged over seven neighbouring frequencies.

Empirical transfer function estimates from the input to each output, with coherence:

    G(f_k) = Y(f_k) / U(f_k)                                  one trial (ETFE, Ljung 1999)
    G(f_k) = sum_j Y_j conj(U_j) / sum_j |U_j|^2              several trials, H1
    C(f_k) = |sum_j Y_j conj(U_j)|^2 / (sum_j |U_j|^2 sum_j |Y_j|^2)

at the excited frequencies of the passband. The closed loop causes no bias, because the torque on
the seat is exogenous. If all trials have the same input, H1 is the mean of their ETFEs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from impc.arrays import Array, IntArray
from impc.errors import DataError

# Power below this share of the peak is attributed to rounding and leakage.
_NOTHING = 1e-6
# Largest share of excited frequencies in a line spectrum; odd harmonics are half of all.
_MOST_LINES = 0.6
_NEIGHBOURS = 7
#: An array of complex numbers.
ComplexArray = np.ndarray[tuple[int, ...], np.dtype[np.complex128]]


@dataclass(frozen=True)
class Passband:
    """Range of frequencies, ends included."""

    low: float  # Hz
    high: float
    # Indices (f,) of the excited frequencies in the input's periodogram
    excited: IntArray


def rms(outputs: Array) -> Array:
    """Root mean square about zero (upright); outputs (..., samples, p) to (..., p)."""
    return np.asarray(np.sqrt(np.mean(np.asarray(outputs) ** 2, axis=-2)))


def passband(signal: Array, rate: float) -> Passband:
    """Passband of a `signal` (samples,) sampled at `rate` in Hz."""
    frequency, power = scipy.signal.periodogram(signal, rate, detrend=False)
    power[0] = 0.0
    peak = float(power.max(initial=0.0))
    if not peak > 1e-24 * float(np.mean(np.asarray(signal) ** 2)):
        raise DataError("input", "is constant: its passband is empty", "check its column")
    excited = np.flatnonzero(power > _NOTHING * peak)
    if len(excited) > _MOST_LINES * len(power):  # not a line spectrum
        power = scipy.ndimage.uniform_filter1d(power, _NEIGHBOURS)
        peak = float(power.max())
    above = power[excited] > 0.03 * peak
    runs = np.split(np.arange(len(excited)), np.flatnonzero(np.diff(above.astype(int))) + 1)
    inside = [excited[run] for run in runs if above[run[0]]]
    best = max(inside, key=lambda run: int(run[-1] - run[0]))
    return Passband(float(frequency[best[0]]), float(frequency[best[-1]]), best)


def band_energy(outputs: Array, rate: float, low: float, high: float) -> Array:
    """Band energy (2.1); outputs (..., samples, p) sampled at `rate` in Hz to (..., p)."""
    frequency, power = scipy.signal.periodogram(outputs, rate, detrend=False, axis=-2)
    step = float(frequency[1] - frequency[0])
    rounding = 1e-6 * step
    inside = (frequency >= low - rounding) & (frequency <= high + rounding)
    return np.asarray(step * np.sum(power[..., inside, :], axis=-2))


@dataclass(frozen=True)
class TransferFunction:
    """Transfer function estimate with coherence."""

    frequency: Array  # Hz (f,)
    response: ComplexArray  # Output over input (f, p)
    coherence: Array  # (f, p); always 1 for a single trial


def transfer_function(
    inputs: Array, outputs: Array, rate: float, band: Passband
) -> TransferFunction:
    """Estimate from `inputs` (trials, samples) and `outputs` (trials, samples, p)."""
    U = np.fft.rfft(inputs)[:, band.excited, None]
    Y = np.fft.rfft(outputs, axis=1)[:, band.excited]
    power = np.sum(np.abs(U) ** 2, axis=0)
    cross = np.sum(Y * np.conj(U), axis=0)
    total = power * np.sum(np.abs(Y) ** 2, axis=0)
    coherence = np.divide(np.abs(cross) ** 2, total, out=np.zeros(total.shape), where=total > 0)
    frequency = np.asarray(band.excited * (rate / np.shape(inputs)[1]))
    return TransferFunction(frequency, cross / power, coherence)
