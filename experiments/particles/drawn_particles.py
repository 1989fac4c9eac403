"""Compiled code: likelihood of a clipped regulator by look-ahead particles.

Each particle is a path of unclipped commands g. Given the path and the outputs, the state is normal
with a covariance common to all particles (`gains`). With psi of `lookahead` and
Psi_t(m) = E psi_t(z), z normal about m, a particle that expects the state m before output t

    is weighted by   p(y_t | m) E_g Psi_t+1(m+(g)) / Psi_t(m),
    and draws g with a density proportional to   N(g; h'm_y, v) Psi_t+1(m+(g)),

where m_y is the expected state given y_t and m+(g) the expected next state given g. m+ is affine in
g below, between and above the bounds, so both are exact sums over three pieces of normal densities.
"""

from __future__ import annotations

import math

import numpy as np

from experiments.particles.clipped_regulator import ClippedRegulator
from experiments.particles.gains import Gains
from experiments.particles.lookahead import Twist
from impc.arrays import Buffer
from impc.jit import njit

__all__ = ["particles"]

# Particles are resampled when their effective share is below this.
_SHARE = 0.5


@njit(nogil=True)
def particles(
    regulator: ClippedRegulator,
    known: Gains,
    ahead: Twist,
    outputs: Buffer,
    disturbance: Buffer,
    start: Buffer,
    seed: int,
    count: int,
) -> float:
    """Log-likelihood of a recording, nats.

    Parameters
    ----------
    regulator, known, ahead : ClippedRegulator, Gains, Twist
    outputs, disturbance, start : Buffer
        (samples, p), (samples, d), and the expected first state (z,).
    seed : int
        Seed of the random numbers.
    count : int
        Number of particles.
    """
    F, B, E, C, _, _, _, _, h, low, high, _, least_spread = regulator
    last = len(outputs) - 1
    np.random.seed(seed)
    pieces, offset = (-np.inf, low, high, np.inf), (low, 0.0, high)
    z = np.zeros((len(F), count))
    z[:] = start[:, None]
    bend, pulled, level = _average(known.P[0], ahead, 0)
    expected = _psi(bend, pulled, level, z)
    weight, total = expected.copy(), 0.0
    masses, tops = np.zeros((3, count)), np.zeros((3, count))
    for t in range(last + 1):
        e = outputs[t][:, None] - C @ z
        weight -= (known.volume[t] + np.sum(e * (known.weight[t] @ e), axis=0)) / 2 + expected
        if t == last:
            break
        z += known.K[t] @ e
        g = h @ z
        variance = max(known.spread[t], least_spread)
        bend, pulled, level = _average(known.P[t + 1], ahead, t + 1)
        base = F @ (z - known.L[t][:, None] * g) + (E @ disturbance[t])[:, None]
        slope, steep = F @ known.L[t], np.zeros(3)
        for k in range(3):
            line = slope + B if k == 1 else slope
            steep[k] = 1 / variance + line @ (bend @ line)
            _weigh_piece(
                (pieces[k], pieces[k + 1]), base + (B * offset[k])[:, None] if k != 1 else base,
                line, g, variance, steep[k], (bend, pulled, level), masses[k], tops[k],
            )  # fmt: skip
        both = _logarithm_of_sum(masses)
        weight += both
        if _effective(weight) < _SHARE:
            total += _logarithm_of_mean(weight)
            chosen = _systematic(weight)
            base, masses, tops = base[:, chosen], masses[:, chosen], tops[:, chosen]
            both, weight = both[chosen], np.zeros(count)
        g = _drawn(masses, both, tops, steep, pieces)
        z = base + slope[:, None] * g + B[:, None] * np.clip(g, low, high)
        expected = _psi(bend, pulled, level, z)
    return total + _logarithm_of_mean(weight)


@njit()
def _average(P: Buffer, ahead: Twist, t: int) -> tuple[Buffer, Buffer, float]:
    """A, a and c of log E psi_t(z) = c - m'A m / 2 + a'm, z normal about m with covariance P."""
    L, a = ahead.L[t], ahead.a[t]
    inner = np.eye(len(P)) + L @ P
    bend, pulled = np.linalg.solve(inner, L), np.linalg.solve(inner, a)
    level = (a @ (P @ pulled) - np.linalg.slogdet(inner)[1]) / 2
    return (bend + bend.T) / 2, pulled, level


@njit()
def _psi(bend: Buffer, pulled: Buffer, level: float, z: Buffer) -> Buffer:
    """Logarithm (count,) of the expected psi of all particles (z, count)."""
    found: Buffer = level + pulled @ z - np.sum(z * (bend @ z), axis=0) / 2
    return found


@njit()
def _weigh_piece(
    ends: tuple[float, float],
    base: Buffer,
    line: Buffer,
    g: Buffer,
    variance: float,
    steep: float,
    psi: tuple[Buffer, Buffer, float],
    mass: Buffer,
    top: Buffer,
) -> None:
    """Write log of N(g) Psi(base + line g) integrated over a piece, and its mode `top`.

    Along g the logarithm is a parabola of curvature `steep`. Beyond an infinite bound the piece is
    empty.
    """
    if ends[0] == ends[1]:
        mass[:] = -np.inf
        return
    bend, pulled, level = psi
    turned = bend @ line
    top[:] = (g / variance - turned @ base + pulled @ line) / steep
    mass[:] = _psi(bend, pulled, level, base) + steep * top**2 / 2 - g**2 / variance / 2
    mass -= math.log(variance * steep) / 2
    for j in range(len(top)):
        root = math.sqrt(steep)
        mass[j] += _log_normal((ends[0] - top[j]) * root, (ends[1] - top[j]) * root)


@njit()
def _log_normal(low: float, high: float) -> float:
    """Log-probability that a standard normal variable lies between two ends."""
    if low > 0:
        low, high = -high, -low
    share = math.erfc(-high / math.sqrt(2.0)) - math.erfc(-low / math.sqrt(2.0))
    return math.log(share / 2) if share > 0 else -np.inf


@njit()
def _logarithm_of_sum(values: Buffer) -> Buffer:
    """Log of the sum of the exponentials of three rows (3, count)."""
    top = np.maximum(np.maximum(values[0], values[1]), values[2])
    found: Buffer = top + np.log(
        np.exp(values[0] - top) + np.exp(values[1] - top) + np.exp(values[2] - top)
    )
    return found


@njit()
def _logarithm_of_mean(weight: Buffer) -> float:
    top = np.max(weight)
    return float(top + math.log(np.mean(np.exp(weight - top))))


@njit()
def _effective(weight: Buffer) -> float:
    """Effective share of the particles: 1 if all weights are equal."""
    share = np.exp(weight - np.max(weight))
    return float(np.sum(share) ** 2 / np.sum(share**2) / len(share))


@njit()
def _systematic(weight: Buffer) -> Buffer:
    """Indices of the particles kept by systematic resampling."""
    share = np.exp(weight - np.max(weight))
    step, at = np.sum(share) / len(share), np.random.random()
    found, j, reached = np.zeros(len(share), np.int64), 0, share[0]
    for i in range(len(share)):
        while reached < (i + at) * step and j < len(share) - 1:
            j += 1
            reached += share[j]
        found[i] = j
    return found


@njit()
def _drawn(
    masses: Buffer,
    both: Buffer,
    tops: Buffer,
    steep: Buffer,
    pieces: tuple[float, float, float, float],
) -> Buffer:
    """Draw g for each particle: a piece by its mass, then a truncated normal variable."""
    g = np.zeros(len(both))
    for j in range(len(g)):
        left, k = np.random.random(), 0
        while k < 2 and left > math.exp(masses[k, j] - both[j]):
            left -= math.exp(masses[k, j] - both[j])
            k += 1
        k = 1 if masses[k, j] == -np.inf else k
        root, top = math.sqrt(steep[k]), tops[k, j]
        g[j] = top + _normal_between((pieces[k] - top) * root, (pieces[k + 1] - top) * root) / root
    return g


@njit()
def _normal_between(low: float, high: float) -> float:
    """Truncated standard normal variable, by rejection (Robert 1995)."""
    sign = 1.0
    if low + high < 0:
        low, high, sign = -high, -low, -1.0
    near, width = max(low, 0.0), high - low
    if low < 0.5 and width > 0.7:
        while True:
            z = np.random.normal()
            if low < z < high:
                return sign * z
    if width * max(near, 1.0) < 1.0:
        while True:
            z = low + width * np.random.random()
            if np.random.random() < math.exp((near**2 - z**2) / 2):
                return sign * z
    while True:
        z = low - math.log(1 - np.random.random()) / near
        if z < high and np.random.random() < math.exp(-((z - near) ** 2) / 2):
            return sign * z
