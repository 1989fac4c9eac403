"""Pseudorandom ternary sequences: perturbations with a flat spectrum and no even harmonics.

A register of n stages over the three-element field GF(3) is shifted by

    new = c_1 r_1 + c_2 r_2 + ... + c_n r_n   (mod 3),    r_1 the newest stage,

and outputs each new value; 0, 1, 2 mean 0, +1, -1. If x^n - c_1 x^(n-1) - ... - c_n is primitive,
the period is 3^n - 1, the second half of a period is the negative of the first, and the
autocorrelation is zero at every shift that is not a multiple of half a period.

Source: Peterka, J Neurophysiol 88, 2002, whose register of five stages is the default. There the
sequence is the velocity of a tilting platform; here it is the torque.
"""

from __future__ import annotations

import itertools
import math
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from plants._checks import Array, finite_number, whole_number

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

__all__ = ["MAX_STAGES", "maximal_recurrence", "ternary_sequence", "ternary_torque"]

#: Largest number of stages; the search for 24 stages takes half a second.
MAX_STAGES = 24

# Register of Peterka: new = r3 - r4 - r5, started at [2 0 2 0 2].
_PUBLISHED = {5: (0, 0, 1, 2, 2)}


@cache
def maximal_recurrence(stages: int) -> tuple[int, ...]:
    """Return the feedback of a register with the maximal period 3^stages - 1.

    Five stages have Peterka's feedback; other registers the first primitive polynomial, ordered by
    number and place of taps. A polynomial is primitive exactly if the order of its companion matrix
    is 3^stages - 1, which is verified.

    Parameters
    ----------
    stages : int
        From 1 to ``MAX_STAGES``.

    Returns
    -------
    tuple of int
        c_1 ... c_n in 0, 1, 2, newest stage first.

    Raises
    ------
    ValueError
        If the number of stages is out of range.
    """
    stages = whole_number("stages", stages, "5 is usual", least=1, most=MAX_STAGES)
    period = 3**stages - 1
    primes = _prime_factors(period)
    candidates = [_PUBLISHED[stages]] if stages in _PUBLISHED else _feedbacks(stages)
    # Primitive polynomials exist for every degree.
    return next(c for c in candidates if _has_order(c, period, primes))


def ternary_sequence(
    stages: int = 5,
    length: int | None = None,
    *,
    start: Sequence[int] | None = None,
    seed: int | None = None,
) -> NDArray[np.int64]:
    """Return values -1, 0, +1 of a maximal register.

    Parameters
    ----------
    stages : int
        Number of stages of the register, from 1 to ``MAX_STAGES``.
    length : int, optional
        Number of values; default: one period, 3^stages - 1.
    start : sequence of int, optional
        Initial contents of the register, newest stage first, each 0, 1 or 2 and not all 0.
        Default: 2, 0, 2, 0, ..., as in Peterka.
    seed : int, optional
        Seed of a random start. All starts lie on the same cycle, so a seed only shifts the sequence
        in time.

    Returns
    -------
    ndarray of int of shape (length,)

    Raises
    ------
    ValueError
        If an argument is out of range, or both a start and a seed are given.
    """
    feedback = maximal_recurrence(stages)
    period = 3**stages - 1
    length = whole_number(
        "length", period if length is None else length, "ask for fewer values", least=1, most=10**8
    )
    register = _start(stages, start, seed)
    taps = [(place, c) for place, c in enumerate(feedback) if c]
    values = np.empty(min(length, period), dtype=np.int64)
    for k in range(len(values)):
        values[k] = sum(c * register[place] for place, c in taps) % 3
        register = [int(values[k]), *register[:-1]]
    signed = np.where(values == 2, -1, values)
    return np.resize(signed, length)  # repeats the period


def ternary_torque(
    amplitude: float = 5.0,
    dwell: float = 0.125,
    duration: float = 30.0,
    rate: float = 100.0,
    stages: int = 5,
    *,
    start: Sequence[int] | None = None,
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
    stages, start, seed
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
    sequence = ternary_sequence(stages, int(steps[-1]) + 1, start=start, seed=seed)
    return amplitude * sequence[steps].astype(np.float64)


def _start(stages: int, start: Sequence[int] | None, seed: int | None) -> list[int]:
    if start is not None and seed is not None:
        raise ValueError(f"seed: start is given too, got {seed!r:.60}; give one of them")
    if seed is not None:
        seed = whole_number("seed", seed, "None gives the usual start", least=0, most=2**63 - 1)
        drawn = int(np.random.default_rng(seed).integers(1, 3**stages))
        return [drawn // 3**place % 3 for place in range(stages)]
    register = [2 * (1 - place % 2) for place in range(stages)] if start is None else list(start)
    if len(register) != stages or not any(register) or not set(register) <= {0, 1, 2}:
        raise ValueError(
            f"start: expected {stages} values from 0, 1, 2, not all 0, got {start!r:.60}; "
            "give one for each stage"
        )
    return [int(value) for value in register]


def _feedbacks(stages: int) -> Iterator[tuple[int, ...]]:
    """All feedbacks with a tap at the oldest stage, fewest taps first."""
    for taps in range(stages):
        for places in itertools.combinations(range(stages - 1), taps):
            for signs in itertools.product((1, 2), repeat=taps + 1):
                feedback = [0] * stages
                for place, sign in zip((*places, stages - 1), signs, strict=True):
                    feedback[place] = sign
                yield tuple(feedback)


def _has_order(feedback: tuple[int, ...], order: int, primes: list[int]) -> bool:
    n = len(feedback)
    companion = np.eye(n, k=-1, dtype=np.int64)
    companion[0] = feedback
    identity = np.eye(n, dtype=np.int64)
    return np.array_equal(_power(companion, order), identity) and not any(
        np.array_equal(_power(companion, order // prime), identity) for prime in primes
    )


def _power(matrix: NDArray[np.int64], exponent: int) -> NDArray[np.int64]:
    result = np.eye(len(matrix), dtype=np.int64)
    while exponent:
        if exponent % 2:
            result = result @ matrix % 3
        matrix = matrix @ matrix % 3
        exponent //= 2
    return result


def _prime_factors(number: int) -> list[int]:
    primes = []
    divisor = 2
    while divisor <= math.isqrt(number):
        if number % divisor == 0:
            primes.append(divisor)
            while number % divisor == 0:
                number //= divisor
        divisor += 1
    return [*primes, number] if number > 1 else primes
