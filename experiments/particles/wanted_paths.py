"""Compiled code: paths of wanted commands, given which a clipped regulator is linear and normal.

With the wanted commands g given, recordings and g have a density in closed form,

    log p(y, g) = sum_t  log N(y_t; C z_t, S_t) + log N(g_t; h'z_t|y, v_t)

of a Kalman filter that is told y_t and then g_t itself; its gains depend on neither. Here are those
gains, that density, its derivative along a path, and paths drawn from p(g | y), backward through
particles (Godsill, Doucet and West 2004).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from experiments.particles.clipped_regulator import ClippedRegulator
from impc.arrays import Buffer
from impc.jit import njit

__all__ = ["Gains", "complete", "drawn_back", "gains", "pull"]

# The gains are taken for stationary when no variance of a state changes by more, of itself.
_STILL = 1e-12
# To such a variance a wanted command is told on the way back, of the square of the unit.
_TOLD = 1e-10


class Gains(NamedTuple):
    """The filter that is told outputs and wanted commands, sample by sample.

    Attributes
    ----------
    P : Buffer
        Covariance of z before the output (samples, z, z).
    K, weight, volume : Buffer
        Gain of the outputs (samples, z, p), the inverse of the innovation's covariance
        (samples, p, p), and the logarithm of the determinant of 2 pi times that (samples,).
    L, spread : Buffer
        Gain of the wanted command (samples, z), and its variance (samples,): zero where it is
        known.
    """

    P: Buffer
    K: Buffer
    weight: Buffer
    volume: Buffer
    L: Buffer
    spread: Buffer


@njit(cache=True, nogil=True)
def gains(regulator: ClippedRegulator, samples: int) -> Gains:
    """The gains of each sample.

    Parameters
    ----------
    regulator : ClippedRegulator
    samples : int
        How many there are.
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


@njit(cache=True, nogil=True)
def complete(
    regulator: ClippedRegulator,
    known: Gains,
    outputs: Buffer,
    disturbance: Buffer,
    start: Buffer,
    wanted: Buffer,
    missed: Buffer,
    innovation: Buffer,
) -> Buffer:
    """log p(y, g) of each path (paths,), nats.

    Parameters
    ----------
    regulator, known : ClippedRegulator, Gains
    outputs, disturbance, start : Buffer
        (samples, p), (samples, d), and what is expected of the first state (z,).
    wanted : Buffer
        Paths of wanted commands, of all samples but the last (samples - 1, paths).
    missed, innovation : Buffer
        Written, for one sample or for all of them: what the filter misses of the outputs
        (1 or samples, p, paths) and of the wanted commands (1 or samples, paths).
    """
    F, B, E, C, _, _, _, _, h, low, high, _, _ = regulator
    samples, paths = len(outputs), wanted.shape[1]
    z, told = np.zeros((len(F), paths)), np.zeros(paths)
    z[:] = start[:, None]
    for t in range(samples):
        at = t % len(missed)
        e = outputs[t][:, None] - C @ z
        missed[at] = e
        told -= (known.volume[t] + np.sum(e * (known.weight[t] @ e), axis=0)) / 2
        if t == samples - 1:
            break
        z += known.K[t] @ e
        d = wanted[t] - h @ z
        innovation[at] = d
        if known.spread[t] > 0.0:
            told -= (math.log(2 * math.pi * known.spread[t]) + d**2 / known.spread[t]) / 2
            z += known.L[t][:, None] * d
        z = F @ z + (E @ disturbance[t])[:, None]
        z += B[:, None] * np.clip(wanted[t], low, high)
    return told


@njit(cache=True, nogil=True)
def pull(
    regulator: ClippedRegulator,
    known: Gains,
    wanted: Buffer,
    missed: Buffer,
    innovation: Buffer,
) -> Buffer:
    """Derivative of log p(y, g) along each wanted command (samples - 1, paths), backward.

    Parameters
    ----------
    regulator, known : ClippedRegulator, Gains
    wanted : Buffer
        As in `complete` (samples - 1, paths).
    missed, innovation : Buffer
        As `complete` wrote them for all samples, (samples, p, paths) and (samples, paths).
    """
    F, B, _, C, _, _, _, _, h, low, high, _, _ = regulator
    slope = np.zeros(wanted.shape)
    along = C.T @ (known.weight[-1] @ missed[-1])
    for t in range(len(wanted) - 1, -1, -1):
        inside = (wanted[t] > low) & (wanted[t] < high)
        slope[t] = (B @ along) * inside
        along = F.T @ along
        if known.spread[t] > 0.0:
            gone = known.L[t] @ along - innovation[t] / known.spread[t]
            slope[t] += gone
            along -= h[:, None] * gone
        along += C.T @ (known.weight[t] @ missed[t] - known.K[t].T @ along)
    return slope


@njit(cache=True, nogil=True)
def drawn_back(
    regulator: ClippedRegulator,
    known: Gains,
    outputs: Buffer,
    disturbance: Buffer,
    means: Buffer,
    weights: Buffer,
    commands: Buffer,
    seed: int,
    paths: int,
) -> Buffer:
    """Paths of wanted commands from what all outputs say of them (samples - 1, paths).

    Parameters
    ----------
    regulator, known : ClippedRegulator, Gains
    outputs, disturbance : Buffer
        (samples, p) and (samples, d).
    means, weights, commands : Buffer
        Of each sample's particles, as `particles` wrote them: the next state that each expects
        (samples, z, count), logarithms of weights for what is recorded until then, and wanted
        commands (samples, count).
    seed : int
        Of all numbers drawn.
    paths : int
        How many are drawn.
    """
    F, B, E, C, _, root, R, _, h, low, high, unit, _ = regulator
    np.random.seed(seed)
    found = np.zeros((len(outputs) - 1, paths))
    seen = np.linalg.solve(R, C).T
    here, back = seen @ C, np.ascontiguousarray(F.T)
    L, a = here.copy(), np.zeros((len(F), paths))
    a[:] = (seen @ outputs[-1])[:, None]
    for t in range(len(found) - 1, -1, -1):
        _choose(known.P[t + 1], L, a, means[t], weights[t], commands[t], found[t])
        turned = L @ root
        inner = np.eye(root.shape[1]) + root.T @ turned
        taken = np.linalg.solve(inner, np.ascontiguousarray(turned.T)).T
        L, a = L - turned @ taken.T, a - taken @ (root.T @ a)
        pushed = B[:, None] * np.clip(found[t], low, high)
        a = back @ (a - L @ (pushed + (E @ disturbance[t])[:, None]))
        a += (seen @ outputs[t])[:, None] + h[:, None] * found[t] / (_TOLD * unit**2)
        L = back @ L @ F + here + np.outer(h, h) / (_TOLD * unit**2)
        L = (L + L.T) / 2
    return found


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _choose(
    P: Buffer, L: Buffer, a: Buffer, means: Buffer, weights: Buffer, commands: Buffer, found: Buffer
) -> None:
    """Draw for each path the particle it comes from, its weight times what the path says of it."""
    inner = np.eye(len(P)) + L @ P
    bend, pulled = np.linalg.solve(inner, L), np.linalg.solve(inner, a)
    alone = weights - np.sum(means * (bend @ means), axis=0) / 2
    both = np.ascontiguousarray(pulled.T) @ means
    for k in range(len(found)):
        share = alone + both[k]
        share = np.exp(share - np.max(share))
        left, j = np.random.random() * np.sum(share), 0
        while left > share[j] and j < len(share) - 1:
            left -= share[j]
            j += 1
        found[k] = commands[j]
