"""Compiled code: approximate likelihood of later outputs given a state, for look-ahead particles.

Particles that use past outputs only degenerate, because a command appears in the outputs only
samples later. Those of `drawn_particles` are drawn and weighted with

    psi_t(z) = exp(-z' L_t z / 2 + a_t' z),    approximately p(y_t, ..., y_T | z_t = z)

which is this density if each command is replaced by c + rho g plus noise, fitted to the
distribution of g given all outputs (`compiled_clip`; posterior linearisation, García-Fernández et
al. 2017; twisted particles, Guarniero, Johansen and Lee 2017). The particle likelihood is unbiased
for any psi; a better psi gives less variance.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from experiments.particles.clipped_regulator import ClippedRegulator
from impc.arrays import Buffer
from impc.jit import njit
from impc.output_feedback.compiled_filter import Clip, clipped

__all__ = ["Twist", "twist"]


class Twist(NamedTuple):
    """Coefficients of psi: information of the outputs from a sample on about its state.

    Attributes
    ----------
    L, a : Buffer
        Shapes (samples, z, z) and (samples, z).
    """

    L: Buffer
    a: Buffer


@njit(nogil=True)
def twist(
    regulator: ClippedRegulator, outputs: Buffer, disturbance: Buffer, start: Buffer, rounds: int
) -> Twist:
    """Compute psi for every sample.

    Parameters
    ----------
    regulator : ClippedRegulator
    outputs, disturbance : Buffer
        (samples, p) and (samples, d).
    start : Buffer
        Expected first state, shape (z,).
    rounds : int
        Number of linearisations of the commands; the first uses earlier outputs only, the others
        all outputs.
    """
    samples, size = len(outputs), len(regulator.F)
    lines = np.zeros((samples, 3))
    means, spreads = np.zeros((samples, size)), np.zeros((samples, size, size))
    found = Twist(np.zeros((samples, size, size)), np.zeros((samples, size)))
    _expect(regulator, outputs, disturbance, start, True, lines, means, spreads)
    for count in range(rounds):
        if count > 0:
            _expect(regulator, outputs, disturbance, start, False, lines, means, spreads)
        _look_back(regulator, outputs, disturbance, lines, found)
        _smooth(regulator, means, spreads, found, lines)
    _look_back(regulator, outputs, disturbance, lines, found)
    return found


@njit()
def _line(regulator: ClippedRegulator, g: float, variance: float, line: Buffer) -> None:
    """Write offset, slope and residual variance of the linearised clipped command."""
    clip = Clip(True, regulator.low, regulator.high, regulator.unit)
    found = clipped(clip, g, math.sqrt(max(variance, 0.0)))
    line[0], line[1], line[2] = found.value - found.inside * g, found.inside, found.variance


@njit()
def _expect(
    regulator: ClippedRegulator,
    outputs: Buffer,
    disturbance: Buffer,
    start: Buffer,
    own: bool,
    lines: Buffer,
    means: Buffer,
    spreads: Buffer,
) -> None:
    """Write mean and covariance of each state before its output; with `own`, its line too."""
    F, B, E, C, Q, _, R, P0, h, _, _, _, _ = regulator
    z, P = start.copy(), P0.copy()
    for t in range(len(outputs)):
        means[t], spreads[t] = z, P
        CP = C @ P
        gain = np.linalg.solve(CP @ C.T + R, CP).T
        z = z + gain @ (outputs[t] - C @ z)
        P = P - gain @ CP
        if own:
            _line(regulator, h @ z, h @ (P @ h), lines[t])
        moved = F + lines[t, 1] * np.outer(B, h)
        z = moved @ z + B * lines[t, 0] + E @ disturbance[t]
        P = moved @ P @ moved.T + Q + lines[t, 2] * np.outer(B, B)
        P = (P + P.T) / 2


@njit()
def _look_back(
    regulator: ClippedRegulator, outputs: Buffer, disturbance: Buffer, lines: Buffer, found: Twist
) -> None:
    """Write psi of each sample, from the last to the first."""
    F, B, E, C, _, root, R, _, h, _, _, _, _ = regulator
    rank = root.shape[1]
    seen = np.linalg.solve(R, C).T
    here = seen @ C
    noise = np.zeros((len(F), rank + 1))
    noise[:, :rank] = root
    L, a = here.copy(), seen @ outputs[-1]
    found.L[-1], found.a[-1] = L, a
    for t in range(len(outputs) - 2, -1, -1):
        noise[:, rank] = B * math.sqrt(lines[t, 2])
        turned = L @ noise
        inner = np.eye(rank + 1) + noise.T @ turned
        taken = np.linalg.solve(inner, np.ascontiguousarray(turned.T)).T
        L, a = L - turned @ taken.T, a - taken @ (noise.T @ a)
        moved = F + lines[t, 1] * np.outer(B, h)
        a = moved.T @ (a - L @ (B * lines[t, 0] + E @ disturbance[t])) + seen @ outputs[t]
        L = moved.T @ L @ moved + here
        L = (L + L.T) / 2
        found.L[t], found.a[t] = L, a


@njit()
def _smooth(
    regulator: ClippedRegulator, means: Buffer, spreads: Buffer, found: Twist, lines: Buffer
) -> None:
    """Write the linearisation of each command given all outputs."""
    h, size = regulator.h, len(regulator.h)
    both = np.zeros((size, 2))
    for t in range(len(means)):
        P = spreads[t]
        both[:, 0], both[:, 1] = means[t] + P @ found.a[t], P @ h
        solved = np.linalg.solve(np.eye(size) + P @ found.L[t], both)
        _line(regulator, float(h @ solved[:, 0].copy()), float(h @ solved[:, 1].copy()), lines[t])
