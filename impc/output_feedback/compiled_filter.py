"""Compiled code: filter of plant and estimate over one trial with derivatives, and simulation.

The equations are those of `likelihood`. With the filter gain g = P C'S^-1 and the updated
covariance P|t,

    P|t = P - g C P,    P+ = F P|t F' + Q,     L = F g,    G = F - L C,    dG = dF - L dC
    dP+ = G dP G' + dG P|t F' + F P|t dG' + dQ + L dR L'

as in `kalman`: g minimises P|t, so that dg does not enter dP+. F includes the command's slope. Of
the q directions only the first k change covariances; k is the first axis of their derivatives.
Away from bounds the covariance soon becomes stationary.

The cost of a plan is convex in its first input: with one input it is that of the program without
bounds at the present sample, clipped. If that has mean g and standard deviation s, the moments of
min(max(g + s xi, low), high), xi normal, follow from the normal distribution (statistical
linearisation): `clipped`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impc.arrays import Buffer
from impc.control.compiled_dual import substitute_all
from impc.control.compiled_kernel import LARGEST, deviate, law, return_to
from impc.control.compiled_values import (
    DIVERGED,
    SOFTENED,
    Aim,
    LoopMatrices,
    RowDirections,
    Rows,
    Workspace,
)
from impc.jit import inner, njit

# The covariance counts as stationary if no entry differs by more than the first tolerance, in the
# standard deviations of its row and column, and its derivative by no more than the second.
_STEADY, _STEADY_SLOPE = 1e-10, 1e-8
# The initial state is forgotten once no direction of it moves an innovation by more than this, in
# its standard deviation.
_FORGOTTEN = 1e-9
# Bounds beyond this many standard deviations are ignored (normal tail probability 1e-13).
_FAR, _EXACT = 7.5, 1e-12


class JointLoop(NamedTuple):
    """System matrices, or their derivatives along k directions (first axis)."""

    F: Buffer  # (z, z), transition
    B: Buffer  # (z, m), commands
    E: Buffer  # (z, d), perturbations
    G: Buffer  # (z, m), motor noise
    C: Buffer  # (p, z)
    Q: Buffer  # (z, z), covariance of the process noise
    R: Buffer  # (p, p), covariance of the recording noise
    P0: Buffer  # (z, z), covariance of the first state
    share: Buffer  # (m,), signal-dependent motor noise as a share of the command


class Clip(NamedTuple):
    """Clipping of the command by its bounds at the present sample."""

    used: bool  # whether to clip; with several inputs the law and its slope are used as they are
    low: float  # bounds of the input, in its unit
    high: float
    unit: float  # s below 1e-12 of this counts as zero


class Clipped(NamedTuple):
    """Moments of the clipped command, and their derivatives."""

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


class FilterParts(NamedTuple):
    """Model of the filter, along q directions of which the first k change covariances."""

    # controller, as in `compiled_loop.run`, along all q directions; unit (m,)
    loop: LoopMatrices
    dloop: LoopMatrices
    rows: Rows
    drows: RowDirections
    unit: Buffer
    clip: Clip  # clipping of the command
    joint: JointLoop  # system, and its derivatives along the first k directions
    djoint: JointLoop
    moving: bool  # whether any direction changes B, C, E or G
    turning: Buffer  # (k,), which directions change F or Q
    known: bool  # whether a stationary covariance exists
    P: Buffer  # (z, z), the stationary covariance of z given all earlier outputs
    dP: Buffer  # (k, z, z)
    at: int  # first index of the estimate in z
    lasting: int  # number of leading directions that change more than the initial state


class Likelihood(NamedTuple):
    """Output of the filter for one trial, one row per sample."""

    identified: Buffer  # (samples,), log-likelihood of each sample given the earlier ones, nats
    score: Buffer  # (samples, q), its gradient
    information: Buffer  # (q, q), expected Fisher information
    innovations: Buffer  # (samples, p), recorded minus predicted outputs
    spreads: Buffer  # (samples, p, p), covariances of the innovations
    filtered: Buffer  # (samples, z), mean of z given all outputs up to the sample
    status: Buffer  # (samples,), `Status`
    counted: int  # first sample in the log-likelihood; earlier ones are conditioned on

    @property
    def value(self) -> float:
        """Log-likelihood, nats."""
        return float(np.sum(self.identified))


class Trace(NamedTuple):
    """What a simulation writes."""

    z: Buffer  # (steps + 1, z)
    u: Buffer  # (steps, m)
    status: Buffer  # (steps,)


class Belief(NamedTuple):
    """Moments of z given all earlier outputs, with derivatives; the filter overwrites them."""

    z: Buffer  # (z,)
    dz: Buffer  # (z, q)
    P: Buffer  # (z, z)
    dP: Buffer  # (k, z, z)


class _Command(NamedTuple):
    """Expected command, its slope by the estimate, and its own noise, with derivatives."""

    u: Buffer  # (m,)
    du: Buffer  # (m, q)
    slope: Buffer  # (m, n)
    dslope: Buffer  # (k, m, n)
    noise: Buffer  # (m,), variance of each command in addition to motor noise
    dnoise: Buffer  # (k, m)


class _Weighed(NamedTuple):
    """Quantities that follow from the covariance of z before a sample."""

    S: Buffer  # (p, p), covariance of the innovation
    inverse: Buffer  # (p, p), S^-1
    volume: float  # log det S
    gain: Buffer  # (z, p), g
    left: Buffer  # (z, z), P|t
    dPC: Buffer  # (k, z, p), derivatives of P C'
    dS: Buffer  # (k, p, p)
    weighed: Buffer  # (k, p, p), dS S^-1
    half: Buffer  # (k, k), tr(S^-1 dS S^-1 dS) / 2 for each pair of directions


@njit(nogil=True)
def run_filter(
    parts: FilterParts,
    outputs: Buffer,
    disturbance: Buffer,
    aim: Aim,
    belief: Belief,
    result: Likelihood,
    first: int,
    work: Workspace,
) -> int:
    """Filter one trial from sample `first` on; return the sample at which it stops.

    It stops after the last sample; at a sample whose status is set, where the law has no solution
    or the state diverges; and at the first sample at which the initial state is forgotten, from
    where `lasting` directions suffice. `belief` is that before this sample.
    `outputs` (samples, p); `disturbance` (samples, d), with an aim per sample.
    """
    z, dz, P, dP = belief
    joint, djoint, at = parts.joint, parts.djoint, parts.at
    (m, n), q, k, rows = parts.loop.K.shape, dz.shape[1], len(dP), parts.rows
    lam = np.zeros(len(rows.b))
    u, du = np.empty(m), np.empty((m, q))
    plain = np.ascontiguousarray(parts.dloop.K[:, :, :k].transpose((2, 0, 1)))
    settled, quiet = False, 0
    known = _weigh(parts, P, dP)
    for t in range(first, len(outputs)):
        if quiet > 2 * len(z) and q > parts.lasting:
            return t
        quiet = quiet + 1 if _update(parts, known, outputs[t], belief, result, t) else 0
        x, dx = z[at : at + n].copy(), dz[at : at + n].copy()
        deviate(aim, rows, parts.drows, work, t, x, dx)
        status, _, _ = law(
            parts.loop, parts.dloop, rows, parts.drows, parts.unit, work, x, dx, lam, False, u, du
        )
        near = status > 0
        result.status[t] = status
        if status > SOFTENED:
            return t
        return_to(aim, t, u, du)
        slope, dslope = _slope_of_law(parts, work, plain)
        command = _Command(u, du, slope, dslope, np.zeros(m), np.zeros((k, m)))
        if parts.clip.used:
            beyond, clipping = _clip_command(parts, known, dP, command)
            near = near or clipping
            result.status[t] = max(status, beyond)
        moved = joint.F @ z + joint.B @ u + joint.E @ disturbance[t]
        dmoved = joint.F @ dz + joint.B @ du
        dmoved[:, :k] += _times(djoint.F[:k], z)
        if parts.moving:
            dmoved[:, :k] += _times(djoint.B[:k], u) + _times(djoint.E[:k], disturbance[t])
        z[:], dz[:] = moved, dmoved
        if not np.max(np.abs(z)) < LARGEST:
            result.status[t] = DIVERGED
            return t
        if not settled or near:
            _advance(parts, known, belief, command)
            settled = parts.known and not near and _is_steady(parts, P, dP)
            if settled:
                P[:], dP[:] = parts.P, parts.dP[:k]
            known = _weigh(parts, P, dP)
    return len(outputs)


@inner()
def _times(changes: Buffer, vector: Buffer) -> Buffer:
    """Product of changes (k, i, j) with a vector (j,), as columns (i, k)."""
    k, i, j = changes.shape
    return (changes.reshape(k * i, j) @ vector).reshape(k, i).T


@inner()
def _weigh(parts: FilterParts, P: Buffer, dP: Buffer) -> _Weighed:
    """Innovation covariance, gain and updated covariance from P (z, z) and dP (k, z, z)."""
    joint, djoint, C = parts.joint, parts.djoint, parts.joint.C
    (p, size), k = C.shape, len(dP)
    CP = C @ P
    S = CP @ C.T + joint.R
    inverse = np.linalg.inv(S)
    gain = CP.T @ inverse
    dPC = (dP.reshape(k * size, size) @ C.T).reshape(k, size, p)
    if parts.moving:
        for c in range(k):
            dPC[c] += P @ djoint.C[c].T
    dCP = np.ascontiguousarray(dPC.transpose((0, 2, 1)))
    dS = (dCP.reshape(k * p, size) @ C.T).reshape(k, p, p) + djoint.R[:k]
    if parts.moving:
        for c in range(k):
            dS[c] += CP @ djoint.C[c].T
    weighed = (dS.reshape(k * p, p) @ inverse).reshape(k, p, p)
    turned = np.ascontiguousarray(weighed.transpose((0, 2, 1)))
    half = weighed.reshape(k, p * p) @ turned.reshape(k, p * p).T / 2
    volume = np.linalg.slogdet(S)[1]
    return _Weighed(S, inverse, volume, gain, P - gain @ CP, dPC, dS, weighed, half)


@inner()
def _update(
    parts: FilterParts, known: _Weighed, output: Buffer, belief: Belief, result: Likelihood, t: int
) -> bool:
    """Log-likelihood and score of one sample; condition z and dz on it.

    Returns whether directions from `lasting` on change neither the innovation nor its covariance.
    """
    C, S, inverse, dS, k = parts.joint.C, known.S, known.inverse, known.dS, len(known.dS)
    z, dz, p, lasting = belief.z, belief.dz, len(C), parts.lasting
    e, de = output - C @ z, -(C @ dz)
    if parts.moving:
        de[:, :k] -= _times(parts.djoint.C[:k], z)
    we, wde = inverse @ e, inverse @ de
    moved = _times(dS, we)
    if t >= result.counted:
        result.identified[t] = -(np.dot(e, we) + known.volume + p * np.log(2 * np.pi)) / 2
        score = result.score[t, : dz.shape[1]]
        score -= we @ de
        score[:k] += we @ moved / 2
        for a in range(p):
            score[:k] -= known.weighed[:, a, a] / 2
        result.information[: len(score), : len(score)] += de.T @ wde
        result.information[:k, :k] += known.half
    # The gain is P C'S^-1: with w = S^-1 e its effect changes by (d(P C') - gain dS) w.
    z += known.gain @ e
    dz += known.gain @ de
    dz[:, :k] += _times(known.dPC, we) - known.gain @ moved
    result.innovations[t], result.spreads[t], result.filtered[t] = e, S, z
    for a in range(p):
        if not np.all(np.abs(de[a, lasting:]) <= _FORGOTTEN * np.sqrt(S[a, a])):
            return False
        if not np.all(np.abs(dS[lasting:, a, a]) <= _FORGOTTEN * S[a, a]):
            return False
    return True


@inner()
def _slope_of_law(parts: FilterParts, work: Workspace, plain: Buffer) -> tuple[Buffer, Buffer]:
    """Slope of the command by the state (m, n) for the active rows, derivatives (k, m, n).

    With the active rows a it is -K - (Gram_aa^-1 N_a0)' T_a, N_a0 the columns of the first stage.
    `plain` (k, m, n): derivatives of the gain.
    """
    loop, dloop, rows, drows = parts.loop, parts.dloop, parts.rows, parts.drows
    m, active = len(loop.K), work.active[0]
    slope, dslope = -loop.K, -plain
    if active == 0:
        return slope, dslope
    free = work.free[:active]
    N, T, dM, dT = rows.N[free], rows.T[free], drows.M[free], drows.T[free]
    first = N[:, :m].copy()
    substitute_all(work.factor, active, first)
    pulled = N.T @ first
    slope -= first.T @ T
    flat, width, k = dM.reshape(active, -1), N.shape[1], len(plain)
    for i in range(m):
        # Gram^-1 (dN_0 - dGram first), with dN = (dM - N dS) S^-1, dGram = dN M' + N dM'.
        own, across = first[:, i].copy(), pulled[:, i].copy()
        change = (own @ flat).reshape(width, -1)
        for j in range(width):
            for h in range(m):
                change[j] -= dloop.S[j % m, h] * across[j - j % m + h]
        right = -(N @ change)
        for a in range(active):
            right[a] -= across @ dM[a]
            for h in range(m):
                right[a] += dM[a, h] * loop.S[h, i]
                for g in range(m):
                    right[a] -= N[a, g] * dloop.S[g, h] * loop.S[h, i]
        substitute_all(work.factor, active, right)
        turned = (own @ dT.reshape(active, -1)).reshape(T.shape[1], -1)
        dslope[:, i] -= (T.T @ right + turned).T[:k]
    return slope, dslope


@inner()
def _clip_command(
    parts: FilterParts, known: _Weighed, dP: Buffer, command: _Command
) -> tuple[int, bool]:
    """Replace a command by the moments of the clipped one; return `beyond` and `near`."""
    u, du, slope, dslope, noise, dnoise = command
    C, at, n, k = parts.joint.C, parts.at, slope.shape[1], len(dslope)
    seen = np.zeros(len(known.left))
    seen[at : at + n] = slope[0]
    weighed = known.left @ seen
    s = np.sqrt(max(np.dot(seen, weighed), 0.0))
    found = clipped(parts.clip, u[0], s)
    if not found.near:
        return found.beyond, False
    ds, along = np.zeros(k), du[0, :k].copy()
    if found.inside_g != 0.0 or found.inside_s != 0.0:
        # Derivative of seen' P|t seen: d(P|t) = (I - g C) dP (I - g C)' + g dR g' minus dC terms.
        answer = seen @ known.gain
        before = seen - C.T @ answer
        ds += before @ _times(dP, before)
        for c in range(k):
            ds[c] += np.dot(answer, parts.djoint.R[c] @ answer)
            if parts.moving:
                ds[c] -= 2 * np.dot(answer, parts.djoint.C[c] @ weighed)
            ds[c] = ds[c] / (2 * s) + np.dot(dslope[c, 0], weighed[at : at + n]) / s
    noise[0] = found.variance
    dnoise[:, 0] = found.variance_g * along + found.variance_s * ds
    turned = found.inside_g * along + found.inside_s * ds
    for c in range(k):
        dslope[c, 0] = found.inside * dslope[c, 0] + turned[c] * slope[0]
    du *= found.inside
    du[0, :k] += found.value_s * ds
    u[0] = found.value
    slope *= found.inside
    return found.beyond, True


@inner()
def _advance(parts: FilterParts, known: _Weighed, belief: Belief, command: _Command) -> None:
    """Predict P and dP for the next sample."""
    P, dP = belief.P, belief.dP
    u, du, slope, dslope, noise, dnoise = command
    joint, djoint, at, B, Gm = parts.joint, parts.djoint, parts.at, parts.joint.B, parts.joint.G
    (m, n), size, k, p, C = slope.shape, len(P), len(dP), len(joint.C), joint.C
    F = joint.F.copy()
    F[:, at : at + n] += B @ slope
    ahead, L = F @ known.left, F @ known.gain
    G = F - L @ C
    share = (joint.share * u) ** 2
    following = ahead @ F.T + joint.Q + (B * noise) @ B.T + (Gm * share) @ Gm.T
    P[:] = (following + following.T) / 2
    product = (dP.reshape(k * size, size) @ G.T).reshape(k, size, size)
    turned = np.ascontiguousarray(product.transpose((0, 2, 1)))
    product = (turned.reshape(k * size, size) @ G.T).reshape(k, size, size)
    # The remaining terms have few columns; half of them is formed and added with its transpose.
    columns = np.concatenate((B, Gm, L), axis=1)
    changes, estimate = np.empty((k, size, 2 * m + p)), np.ascontiguousarray(ahead[:, at : at + n])
    for c in range(k):
        changes[c, :, :m] = estimate @ dslope[c].T + B * dnoise[c] / 2
        shared = joint.share * u * (joint.share * du[:, c] + djoint.share[c] * u)
        changes[c, :, m : 2 * m] = Gm * shared
        changes[c, :, 2 * m :] = L * np.diag(djoint.R[c]) / 2
    rest = (changes.reshape(k * size, 2 * m + p) @ columns.T).reshape(k, size, size)
    for c in range(k):
        if parts.turning[c]:
            rest[c] += ahead @ djoint.F[c].T + djoint.Q[c] / 2
        if parts.moving:
            rest[c] -= ahead @ (L @ djoint.C[c]).T
            rest[c] += (
                estimate @ (djoint.B[c] @ slope).T
                + (B * noise) @ djoint.B[c].T
                + (Gm * share) @ djoint.G[c].T
            )
        for i in range(size):
            for j in range(i + 1):
                dP[c, i, j] = product[c, i, j] + rest[c, i, j] + rest[c, j, i]
                dP[c, j, i] = dP[c, i, j]


@inner()
def _is_steady(parts: FilterParts, P: Buffer, dP: Buffer) -> bool:
    """Whether covariance and derivatives are stationary within tolerance."""
    deviations = np.sqrt(np.diag(parts.P))
    unit = np.outer(deviations, deviations)
    if not np.all(np.abs(P - parts.P) <= _STEADY * unit):
        return False
    return bool(np.all(np.abs(dP - parts.dP[: len(dP)]) <= _STEADY_SLOPE * unit))


@inner()
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
        beyond, True, g + mean, bell, inside, bell / s, lever / s, variance, variance_g, variance_s
    )


@inner()
def _tail(a: float, s: float) -> tuple[float, float, float, float, float]:
    """For a standard normal number below a: probability, density, a density, s a p, (s a)^2 p."""
    if a == -np.inf:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    below = math.erfc(-a / np.sqrt(2.0)) / 2
    density = np.exp(-(a**2) / 2) / np.sqrt(2 * np.pi)
    return below, density, a * density, s * a * below, (s * a) ** 2 * below


@njit(nogil=True)
def run_noisy(
    loop: LoopMatrices,
    dloop: LoopMatrices,
    rows: Rows,
    drows: RowDirections,
    unit: Buffer,
    joint: JointLoop,
    at: int,
    driven: tuple[Buffer, Buffer, Buffer],
    aim: Aim,
    trace: Trace,
    work: Workspace,
) -> int:
    """Simulate from z[0]; `driven`: disturbance, noise, and noise in proportion to commands."""
    (z, u, status), (disturbance, noise, shared), n = trace, driven, loop.K.shape[1]
    lam, dx, du = np.zeros(len(rows.b)), np.zeros((n, 0)), np.zeros((u.shape[1], 0))
    for t in range(len(u)):
        x = z[t, at : at + n].copy()
        deviate(aim, rows, drows, work, t, x, dx)
        status[t], _, _ = law(loop, dloop, rows, drows, unit, work, x, dx, lam, False, u[t], du)
        if status[t] > SOFTENED:
            return t
        return_to(aim, t, u[t], du)
        z[t + 1] = joint.F @ z[t] + joint.B @ u[t] + joint.E @ disturbance[t] + noise[t]
        z[t + 1] += joint.G @ (joint.share * u[t] * shared[t])
        if not np.max(np.abs(z[t + 1])) < LARGEST:
            status[t] = DIVERGED
            return t
    return len(u)
