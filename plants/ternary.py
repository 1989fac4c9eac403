"""Pseudorandom ternary sequences: perturbations with a flat spectrum and no even harmonics.

A register of n stages over the three-element field GF(3) is shifted by

    new = c_1 r_1 + c_2 r_2 + ... + c_n r_n   (mod 3),    r_1 the newest stage,

and gives each new value; 0, 1, 2 stand for 0, +1, -1. When x^n - c_1 x^(n-1) - ... - c_n is
primitive the period is 3^n - 1, the second half of a period is the first with its sign changed,
and the autocorrelation is zero at every shift that is not a multiple of half a period.

Source: Peterka, J Neurophysiol 88, 2002, whose register of five stages is the default. There the
sequence is the velocity of a tilting platform; here it is the torque itself.
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

# At 24 stages the search takes half a second, and a period lasts 1100 years at a dwell of 0.125 s.
#: Largest register that is searched for.
MAX_STAGES = 24

# Five stages in posture research: new = r3 - r4 - r5, started at [2 0 2 0 2].
_PUBLISHED = {5: (0, 0, 1, 2, 2)}


@cache
def maximal_recurrence(stages: int) -> tuple[int, ...]:
    """Return the feedback of a register whose period is the greatest, 3^stages - 1.

    Five stages have Peterka's feedback; for others the first primitive polynomial is taken, in
    the order of fewest taps, then of their places. Each candidate is proved by the order of its
    companion matrix: that is 3^stages - 1 exactly when the polynomial is primitive.

    Parameters
    ----------
    stages : int
        From 1 to ``MAX_STAGES``.

    Returns
    -------
    tuple of int
        c_1 ... c_n in 0, 1, 2, the newest stage first.

    Raises
    ------
    ValueError
        When the number of stages is out of range.
    """
    stages = whole_number("stages", stages, "5 is usual", least=1, most=MAX_STAGES)
    period = 3**stages - 1
    primes = _prime_factors(period)
    candidates = [_PUBLISHED[stages]] if stages in _PUBLISHED else _feedbacks(stages)
    # Primitive polynomials exist for every degree, so that one is always found.
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
        Stages of the register, from 1 to ``MAX_STAGES``.
    length : int, optional
        Number of values; a whole period, 3^stages - 1, by default.
    start : sequence of int, optional
        First contents of the register, newest stage first, each 0, 1 or 2 and not all 0. By
        default 2, 0, 2, 0, ..., Peterka's.
    seed : int, optional
        Draws the start instead. Every start lies on the one cycle of the register, so a seed
        shifts the sequence in time and changes nothing else.

    Returns
    -------
    ndarray of int, shape (length,)

    Raises
    ------
    ValueError
        When an argument is out of range, or both a start and a seed are given.
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
    """Sample a ternary torque that is held for ``dwell`` between the steps of its register.

    The defaults are those of the seated-balance benchmark: 242 steps of 0.125 s, cut at 30 s.

    Parameters
    ----------
    amplitude : float
        Nm, not negative.
    dwell : float
        Time in s for which each value is held, at least one sample. It need not be a whole
        number of samples: sample k has the value at time k / rate.
    duration : float
        s.
    rate : float
        Samples per s.
    stages, start, seed
        See `ternary_sequence`.

    Returns
    -------
    Array
        Torque in Nm (samples,), samples = round(duration * rate).

    Raises
    ------
    ValueError
        When an argument is out of range.
    """
    amplitude = finite_number("amplitude", amplitude, "give it in Nm", least=0.0)
    rate = finite_number("rate", rate, "give it in samples per second", above=0.0)
    duration = finite_number("duration", duration, "give a sample or more, in s", least=1.0 / rate)
    dwell = finite_number("dwell", dwell, "hold for a sample or more, in s", least=1.0 / rate)
    # A step that starts at a sample belongs to it: 1e-9 of a dwell is more than the rounding of
    # k / (rate dwell) and less than any step of the clock.
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
    """Every feedback with a tap at the oldest stage, fewest taps first."""
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
