"""Compiled code: Kalman gains of a clipped regulator whose unclipped commands g are given.

Given g the system is linear and normal, and recordings and g have the density

    log p(y, g) = sum_t  log N(y_t; C z_t, S_t) + log N(g_t; h'z_t|y, v_t)

of a Kalman filter that observes y_t and then g_t. Its gains depend on neither.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from experiments.particles.clipped_regulator import ClippedRegulator
from impc.arrays import Buffer
from impc.jit import njit

__all__ = ["Gains", "gains"]

# Gains are stationary if no variance of a state changes by more than this relative amount.
_STILL = 1e-12


class Gains(NamedTuple):
    """Gains of the filter that observes outputs and unclipped commands, sample by sample.

    Attributes
    ----------
    P : Buffer
        Covariance of z before the output, shape (samples, z, z).
    K, weight, volume : Buffer
        Gain of the outputs (samples, z, p), the inverse of the innovation's covariance
        (samples, p, p), and the logarithm of the determinant of 2 pi times that (samples,).
    L, spread : Buffer
        Gain of the unclipped command (samples, z), and its variance (samples,): zero if exact.
    """

    P: Buffer
    K: Buffer
    weight: Buffer
    volume: Buffer
    L: Buffer
    spread: Buffer


@njit(nogil=True)
def gains(regulator: ClippedRegulator, samples: int) -> Gains:
    """Compute the gains of each sample.

    Parameters
    ----------
    regulator : ClippedRegulator
    samples : int
        Number of samples.
    """
    F, _, _, C, Q, _, R, P0, h, _, _, _, known = regulator
    size, p = len(F), len(C)
    found = Gains(
        np.zeros((samples, size, size)),
        np.zeros((samples, size, p)),
        np.zeros((samples, p, p)),
        np.zeros(samples),
        np.zeros((samples, size)),
        np.zeros(samples),
    )
    P, still = P0.copy(), False
    for t in range(samples):
        found.P[t] = P
        if still:
            found.K[t], found.weight[t] = found.K[t - 1], found.weight[t - 1]
            found.volume[t], found.spread[t] = found.volume[t - 1], found.spread[t - 1]
            found.L[t] = found.L[t - 1]
            continue
        CP = C @ P
        S = CP @ C.T + R
        found.weight[t] = np.linalg.inv(S)
        found.volume[t] = np.linalg.slogdet(S)[1] + p * math.log(2 * math.pi)
        found.K[t] = np.ascontiguousarray(CP.T) @ found.weight[t]
        P = P - found.K[t] @ CP
        wanted = P @ h
        variance = h @ wanted
        if variance > known:
            found.spread[t], found.L[t] = variance, wanted / variance
            P = P - np.outer(wanted, wanted) / variance
        P = F @ P @ F.T + Q
        P = (P + P.T) / 2
        still = t > size
        for i in range(size):
            still = still and abs(P[i, i] - found.P[t, i, i]) <= _STILL * P[i, i]
    return found
