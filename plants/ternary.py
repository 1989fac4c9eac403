"""Pseudorandom ternary sequence: a perturbation with a flat spectrum and no even harmonics.

A register of five stages over the three-element field GF(3) is shifted by

    new = r_3 - r_4 - r_5   (mod 3),    r_1 the newest stage,

and outputs each new value; 0, 1, 2 mean 0, +1, -1. Its period is the largest possible, 3^5 - 1 =
242, the second half of a period is the negative of the first, and the autocorrelation is zero at
every shift that is not a multiple of half a period.

Source: Peterka, J Neurophysiol 88, 2002. There the sequence is the velocity of a tilting platform;
here it is the torque.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from plants._checks import Array, finite_number, whole_number

_PERIOD = 3**5 - 1


def ternary_sequence(length: int = _PERIOD, *, seed: int | None = None) -> NDArray[np.int64]:
    """Return values -1, 0, +1 of Peterka's register.

    Parameters
    ----------
    length : int
        Number of values; default: one period.
    seed : int, optional
        Seed of a random start; default: the register starts at 2, 0, 2, 0, 2, as Peterka's. All
        starts lie on the same cycle, so a seed only shifts the sequence in time.

    Returns
    -------
    ndarray of int of shape (length,)

    Raises
    ------
    ValueError
        If an argument is out of range.
    """
    length = whole_number("length", length, "ask for fewer values", least=1, most=10**8)
    register = [2, 0, 2, 0, 2]
    if seed is not None:
        seed = whole_number("seed", seed, "None gives the usual start", least=0, most=2**63 - 1)
        drawn = int(np.random.default_rng(seed).integers(1, _PERIOD + 1))
        register = [drawn // 3**place % 3 for place in range(5)]
    values = np.empty(min(length, _PERIOD), dtype=np.int64)
    for k in range(len(values)):
        values[k] = (register[2] - register[3] - register[4]) % 3
        register = [int(values[k]), *register[:-1]]
    signed = np.where(values == 2, -1, values)
    return np.resize(signed, length)  # repeats the period


def ternary_torque(
    amplitude: float = 5.0,
    dwell: float = 0.125,
    duration: float = 30.0,
    rate: float = 100.0,
    *,
    seed: int | None = None,
) -> Array:
    """Return samples of a ternary torque with hold time ``dwell``.

    The defaults are those of the seated-balance benchmark: 242 steps of 0.125 s, cut at 30 s.

    Parameters
    ----------
    amplitude : float
        Amplitude in N m, not negative.
    dwell : float
        Hold time of each value in s, at least one sample. It need not be a whole number of samples:
        sample k has the value at time k / rate.
    duration : float
        Duration in s.
    rate : float
        Samples per s.
    seed : int, optional
        See `ternary_sequence`.

    Returns
    -------
    Array
        Torque in N m (samples,), samples = round(duration * rate).

    Raises
    ------
    ValueError
        If an argument is out of range.
    """
    amplitude = finite_number("amplitude", amplitude, "give it in Nm", least=0.0)
    rate = finite_number("rate", rate, "give it in samples per second", above=0.0)
    duration = finite_number("duration", duration, "give a sample or more, in s", least=1.0 / rate)
    dwell = finite_number("dwell", dwell, "hold for a sample or more, in s", least=1.0 / rate)
    # 1e-9: a step that starts at a sample belongs to it in spite of rounding of k / (rate dwell).
    steps = np.floor(np.arange(round(duration * rate)) / (rate * dwell) + 1e-9).astype(np.int64)
    sequence = ternary_sequence(int(steps[-1]) + 1, seed=seed)
    return amplitude * sequence[steps].astype(np.float64)
