"""Compiled code: what is expected of a command that is clipped, where it is only expected.

The filter of `likelihood` asks for it (docs/noisy-people.md, section "The likelihood").
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impc.jit import njit

# A bound that is so many deviations away is not met: a normal number is there once in 1e13.
_FAR, _EXACT = 7.5, 1e-12


class Clip(NamedTuple):
    """How one input follows from a law that has no bound at the present sample.

    The cost of a plan is convex in its first input, so the input is that of the program without
    bounds at the present sample, clipped. Where the filter expects it to be g with a deviation s,

        E clip,   its slope  P(low < g + s xi < high) times that of g,   and a variance beside

    follow from the normal distribution (statistical linearisation).
    """

    used: bool  # Whether it is clipped at all; several inputs take the law as it is, with its slope
    low: float  # Bounds of the input, in its unit
    high: float
    unit: float  # A deviation of s below 1e-12 of this is none


class Clipped(NamedTuple):
    """What is expected of min(max(g + s xi, low), high), xi normal, and its derivatives."""

    beyond: int  # 1 where g itself is beyond a bound, else 0
    near: bool  # Whether a bound is anywhere near; where none is, nothing is clipped
    value: float  # The expectation, and its derivative along s; that along g is `inside`
    value_s: float
    inside: float  # Probability of no bound, by which slopes are multiplied, and its derivatives
    inside_g: float
    inside_s: float
    variance: float  # What no slope explains, and its derivatives
    variance_g: float
    variance_s: float


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def clipped(clip: Clip, g: float, s: float) -> Clipped:
    """What is expected of a command that is expected to be g, with a deviation s."""
    low, high = clip.low - g, clip.high - g
    if low < -_FAR * s and high > _FAR * s:
        return Clipped(0, False, g, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    beyond = 0 if low < 0 < high else 1
    if not s > _EXACT * clip.unit:
        value = min(max(g, clip.low), clip.high)
        return Clipped(beyond, True, value, 0.0, 1.0 - beyond, 0.0, 0.0, 0.0, 0.0, 0.0)
    first, second = _tail(low / s, s), _tail(-high / s, s)
    inside = 1.0 - first[0] - second[0]
    bell, lever = first[1] - second[1], first[2] + second[2]
    mean = first[3] - second[3] + s * bell
    square = first[4] + second[4] + s**2 * (inside + lever)
    variance = max(square - mean**2 - (inside * s) ** 2, 0.0)
    variance_g = 2 * (s * bell * (1 - inside) - mean * inside)
    variance_s = 2 * (s * (inside + lever) - mean * bell - inside * s * lever - inside**2 * s)
    return Clipped(
        beyond,
        True,
        g + mean,
        bell,
        inside,
        bell / s,
        lever / s,
        variance,
        variance_g,
        variance_s,
    )


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _tail(a: float, s: float) -> tuple[float, float, float, float, float]:
    """Of a normal number below a: its probability, density, a times it; and s a, squared, below."""
    if a == -np.inf:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    below = math.erfc(-a / np.sqrt(2.0)) / 2
    density = np.exp(-(a**2) / 2) / np.sqrt(2 * np.pi)
    return below, density, a * density, s * a * below, (s * a) ** 2 * below
