"""Whether the response follows the perturbation: no effect before its cause.

From the recorded loop, with S the spectra over half-overlapping segments,

    H(f) = S_dy(f) / S_dd(f),    h = inverse transform of H over the frequencies that d excites

h at negative lags is response before cause. The share of its energy there is near zero for a
causal loop, and near one where the response is shifted ahead.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.signal

if TYPE_CHECKING:
    from impc.arrays import Array

__all__ = ["misaligned"]

_LONGEST = 20.0  # s of a segment
_SEGMENTS = 7  # half-overlapping, at least
_BEFORE = 0.5  # share of the energy before the cause, from which it is a finding
_EXCITED = 1e-2  # of the largest power: frequencies below are noise over noise
_LEVEL = 0.01  # probability of a finding where there is no connection


def misaligned(disturbance: Array, response: Array, dt: float) -> str:
    """What is wrong with the order of cause and effect, as the end of a sentence; or nothing.

    Parameters
    ----------
    disturbance, response : Array
        (samples,), on the plant's clock.
    dt : float
        s.
    """
    length = min(int(_LONGEST / dt), 2 * len(response) // (_SEGMENTS + 1))
    if length < 64:
        return ""  # too short to tell
    common: dict[str, Any] = {"fs": 1 / dt, "nperseg": length, "detrend": "constant"}
    _, power = scipy.signal.welch(disturbance, **common)
    _, output = scipy.signal.welch(response, **common)
    _, cross = scipy.signal.csd(disturbance, response, **common)
    excited = power > _EXCITED * power.max()
    excited[0] = False
    coherence = np.abs(cross[excited]) ** 2 / (power[excited] * output[excited])
    segments = 2 * len(response) // length - 1
    if _chance(coherence, segments):
        return "has nothing in common with it (coherence as by chance): a wrong column or trial?"
    transfer = np.where(excited, cross / np.maximum(power, 1e-300), 0.0)
    impulse = np.fft.irfft(transfer, length)
    energy = impulse**2
    middle = length // 2
    before = float(energy[middle:].sum() / energy.sum())
    if before <= _BEFORE:
        return ""
    lead = (length - middle - int(np.argmax(energy[middle:]))) * dt
    return (
        f"comes before it: {before:.0%} of their connection lies ahead of the cause, most of it "
        f"by {lead:.2g} s; shift one of the two, or name the right column"
    )


def _chance(coherence: Array, segments: int) -> bool:
    """Whether coherence is as high as by chance: P(C > c) = (1 - c)^(n - 1) at one frequency."""
    if len(coherence) == 0 or segments < 3:
        return False
    # Of m frequencies the largest exceeds this with probability _LEVEL.
    each = 1 - (1 - _LEVEL) ** (1 / len(coherence))
    # Half-overlapping Hann segments are worth about 0.9 of as many independent ones.
    free = max(0.9 * segments - 1, 1.0)
    return bool(coherence.max() < 1 - each ** (1 / free))
