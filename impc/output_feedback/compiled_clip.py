"""Compiled code: moments of a clipped normal command.

Used by the filter of `likelihood` (docs/why/output_feedback.md).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impc.jit import njit

# Bounds beyond this many standard deviations are ignored (normal tail probability 1e-13).
_FAR, _EXACT = 7.5, 1e-12


class Clip(NamedTuple):
    """Clipping of the command by its bounds at the present sample.

    The cost of a plan is convex in its first input, so the input is that of the program without
    bounds at the present sample, clipped. If that has mean g and standard deviation s, then

        E clip,   its slope  P(low < g + s xi < high) times that of g,   and a further variance

    follow from the normal distribution (statistical linearisation).
    """

    used: bool  # whether to clip; with several inputs the law and its slope are used as they are
    low: float  # bounds of the input, in its unit
    high: float
    unit: float  # s below 1e-12 of this counts as zero


class Clipped(NamedTuple):
    """Moments of min(max(g + s xi, low), high), xi normal, and their derivatives."""

    beyond: int  # 1 if g itself is beyond a bound, else 0
    near: bool  # whether a bound is near; otherwise nothing is clipped
    value: float  # mean; its derivative with respect to g is `inside`
    value_s: float  # derivative of the mean with respect to s
    inside: float  # probability of no active bound, by which slopes are multiplied
    inside_g: float
    inside_s: float
    variance: float  # variance that the slope does not explain
    variance_g: float
    variance_s: float


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def clipped(clip: Clip, g: float, s: float) -> Clipped:
    """Moments of the clipped command with mean g and standard deviation s."""
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
    """For a standard normal number below a: probability, density, a density, s a p, (s a)^2 p."""
    if a == -np.inf:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    below = math.erfc(-a / np.sqrt(2.0)) / 2
    density = np.exp(-(a**2) / 2) / np.sqrt(2 * np.pi)
    return below, density, a * density, s * a * below, (s * a) ** 2 * below
