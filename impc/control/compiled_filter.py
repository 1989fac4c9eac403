"""Compiled code: the filter of plant and estimate together, with its exact derivatives.

The filter is that of `joint_likelihood` (docs/noisy-people.md). It calls the least-distance
problem of `compiled_loop`. numba's cache looks at this file only: a change of the other one must
change `COMPILED_WITH` below, which tests/control/test_joint_likelihood.py asks for.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impc.arrays import Buffer
from impc.control.compiled_loop import (
    LoopMatrices,
    Workspace,
    law,
    substitute_all,
    workspace,
)
from impc.control.constraint_rows import RowDirections, Rows
from impc.control.joint_loop import JointLoop
from impc.jit import njit

__all__ = ["COMPILED_WITH", "Clip", "FilterResult", "Steady", "run_filter", "run_person"]

#: First digits of the SHA-256 of compiled_loop.py.
COMPILED_WITH = "7ac3d621e593d752"

_SOFTENED, _DIVERGED = 2, 5
# A bound that is so many deviations away is not met: a normal number is there once in 1e13.
_FAR, _EXACT = 7.5, 1e-12
# An expectation beyond this ends the filter.
_LARGEST = 1e100
# The covariance is taken for the stationary one when no entry differs by more than this, of the
# deviations of its row and column; nor its derivative by more than the second.
_STEADY, _STEADY_SLOPE = 1e-10, 1e-8
# A first state is forgotten when none of its directions moves an innovation by more than this, of
# its deviation.
_FORGOTTEN = 1e-11


class Steady(NamedTuple):
    """The stationary filter where no bound is active, and its derivatives along k directions.

    Attributes
    ----------
    P, dP : Buffer
        Covariance of z given all earlier outputs (z, z), and (z, z, k).
    known : bool
        Whether there is one.
    """

    P: Buffer
    dP: Buffer
    known: bool


class Clip(NamedTuple):
    """How one input follows from a law that has no bound at the present sample.

    The cost of a plan is convex in its first input, so the input is that of the program without
    bounds at the present sample, clipped. Where the filter expects it to be g with a deviation s,

        E clip,   its slope  P(low < g + s xi < high) times that of g,   and a variance beside

    follow from the normal distribution (statistical linearisation).

    Attributes
    ----------
    used : bool
        Whether it is clipped at all; several inputs take the law as it is, with its slope.
    low, high : float
        Bounds of the input, in its unit.
    unit : float
        A deviation of s below 1e-12 of this is none.
    """

    used: bool
    low: float
    high: float
    unit: float


class FilterResult(NamedTuple):
    """What the filter writes, sample by sample.

    Attributes
    ----------
    told : Buffer
        Log-likelihood of each sample given the earlier ones (samples,).
    score : Buffer
        Its derivatives along the q directions (samples, q).
    information : Buffer
        Sum of their expected products (q, q).
    innovation, spread : Buffer
        Recorded outputs minus what is expected (samples, p), and their covariance (samples, p, p).
    filtered : Buffer
        Expected z given all outputs so far (samples, z).
    u : Buffer
        Command expected there (samples, m).
    status : Buffer
        Of each sample: the value of `closed_loop.Status` (samples,).
    """

    told: Buffer
    score: Buffer
    information: Buffer
    innovation: Buffer
    spread: Buffer
    filtered: Buffer
    u: Buffer
    status: Buffer


class _Update(NamedTuple):
    """What one sample of the outputs does to any expectation, of one covariance of z.

    PC, S, S^-1, the gain, their derivatives, half of the information; and P after the sample. Room
    for the derivative of the next P, and for a product on the way to it.
    """

    PC: Buffer
    S: Buffer
    inverse: Buffer
    gain: Buffer
    dPC: Buffer
    dS: Buffer
    dgain: Buffer
    half: Buffer
    P: Buffer
    dP: Buffer
    ahead: Buffer
    product: Buffer


@njit(cache=True, nogil=True)
def run_filter(
    loop: LoopMatrices,
    dloop: LoopMatrices,
    rows: Rows,
    drows: RowDirections,
    unit: Buffer,
    clip: Clip,
    joint: JointLoop,
    djoint: JointLoop,
    steady: Steady,
    at: int,
    shared: int,
    outputs: Buffer,
    disturbance: Buffer,
    z: Buffer,
    dz: Buffer,
    result: FilterResult,
) -> int:
    """Filter one recording; directions that move covariances stand first among all q.

    Parameters
    ----------
    loop, dloop, rows, drows, unit
        Of the controller's law, as in `compiled_loop.run`, along all q directions; unit (m,).
    clip : Clip
        What is done to the law's command.
    joint, djoint : JointLoop
        The system, and its derivatives along the first k directions.
    steady : Steady
        The stationary filter.
    at : int
        Where the estimate stands in z.
    shared : int
        How many directions, the first ones, move more than the first state. Covariances are
        followed along these alone once the first state is forgotten.
    outputs, disturbance : Buffer
        (samples, p) and (samples, d).
    z, dz : Buffer
        Expected first state (z,) and its derivatives (z, q); overwritten.
    result : FilterResult
        Written.

    Returns
    -------
    int
        Samples before the one at which the law has no answer or the state leaves every range; all
        when there is none.
    """
    n, m, q = loop.K.shape[1], loop.K.shape[0], dz.shape[1]
    k = djoint.F.shape[2]
    work = workspace(rows, m, q)
    lam, du = np.zeros(len(rows.b)), np.empty((m, q))
    here = _room(len(z), outputs.shape[1], k)
    drift = np.zeros(k + 1)
    varies, settled, moves = bool(np.any(joint.share)), False, _moving(djoint.F)
    _weigh(joint, djoint, joint.P0, djoint.P0, here)
    quiet = 0
    for t in range(len(outputs)):
        forgotten = _update(joint, djoint, here, outputs[t], z, dz, result, t, shared)
        quiet = quiet + 1 if forgotten else 0
        if quiet > 2 * len(z) and k > shared:
            k = shared
            djoint, steady, here = _without_start(djoint, steady, here, k)
            drift, moves = np.zeros(k + 1), _moving(djoint.F)
        u, x, dx = result.u[t], z[at : at + n], dz[at : at + n]
        status, _, _ = law(loop, dloop, rows, drows, unit, work, x, dx, lam, False, u, du)
        if status > _SOFTENED:
            result.status[t] = status
            return t
        slope, dslope = _slope(loop, dloop, rows, drows, work, k)
        met = status > 0
        if clip.used:
            beyond, near = _clipped(clip, here, at, slope, dslope, u, du, drift)
            status, met = max(status, beyond), met or near
        result.status[t] = status
        if not settled or met:
            P = _spread(joint, djoint, moves, here, slope, dslope, at, u, du, drift)
            settled = steady.known and not met and not varies and _near(P, here.ahead, steady)
            if settled:
                _weigh(joint, djoint, steady.P, steady.dP, here)
            else:
                _weigh(joint, djoint, P, here.ahead, here)
        _ahead(joint, djoint, moves, u, du, disturbance[t], z, dz)
        if not np.max(np.abs(z)) < _LARGEST:
            result.status[t] = _DIVERGED
            return t
    return len(outputs)


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _moving(dF: Buffer) -> Buffer:
    """Between which directions each entry moves (z, z, 2); none where both are the same."""
    found = np.zeros((dF.shape[0], dF.shape[1], 2), dtype=np.int64)
    for i in range(dF.shape[0]):
        for j in range(dF.shape[1]):
            for c in range(dF.shape[2]):
                if dF[i, j, c] != 0.0:
                    if found[i, j, 1] == 0:
                        found[i, j, 0] = c
                    found[i, j, 1] = c + 1
    return found


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _room(size: int, p: int, k: int) -> _Update:
    return _Update(
        np.empty((size, p)),
        np.empty((p, p)),
        np.empty((p, p)),
        np.empty((size, p)),
        np.empty((size, p, k)),
        np.empty((p, p, k)),
        np.empty((size, p, k)),
        np.empty((k, k)),
        np.empty((size, size)),
        np.empty((size, size, k)),
        np.empty((size, size, k)),
        np.empty((size, size, k)),
    )


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _fewer(given: Buffer, k: int) -> Buffer:
    """The first k directions of derivatives."""
    return np.ascontiguousarray(given[..., :k])


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _without_start(
    djoint: JointLoop, steady: Steady, here: _Update, k: int
) -> tuple[JointLoop, Steady, _Update]:
    """What a first state no longer moves: all of it along the first k directions only."""
    fewer = JointLoop(
        _fewer(djoint.F, k),
        _fewer(djoint.B, k),
        _fewer(djoint.E, k),
        _fewer(djoint.G, k),
        _fewer(djoint.C, k),
        _fewer(djoint.Q, k),
        _fewer(djoint.R, k),
        _fewer(djoint.P0, k),
        _fewer(djoint.share, k),
    )
    update = _room(len(here.P), len(here.S), k)
    update.PC[:], update.S[:], update.inverse[:] = here.PC, here.S, here.inverse
    update.gain[:], update.P[:] = here.gain, here.P
    update.dPC[:], update.dS[:] = here.dPC[:, :, :k], here.dS[:, :, :k]
    update.dgain[:], update.dP[:] = here.dgain[:, :, :k], here.dP[:, :, :k]
    update.half[:] = here.half[:k, :k]
    return fewer, Steady(steady.P, _fewer(steady.dP, k), steady.known), update


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _clipped(
    clip: Clip,
    here: _Update,
    at: int,
    slope: Buffer,
    dslope: Buffer,
    u: Buffer,
    du: Buffer,
    drift: Buffer,
) -> tuple[int, bool]:
    """Command and slope become those that are expected of a clipped command; see `Clip`.

    Returns whether the command itself is beyond a bound, and whether a bound is anywhere near. The
    variance that no slope explains goes to drift[0], its derivatives behind it.
    """
    n, k, g = slope.shape[1], dslope.shape[2], u[0]
    weighed, variance = np.zeros(n), 0.0
    for i in range(n):
        for j in range(n):
            weighed[i] += here.P[at + i, at + j] * slope[0, j]
        variance += slope[0, i] * weighed[i]
    s = np.sqrt(max(variance, 0.0))
    drift[:] = 0.0
    low, high = clip.low - g, clip.high - g
    if low < -_FAR * s and high > _FAR * s:
        return 0, False
    beyond = 0 if low < 0 < high else 1
    if not s > _EXACT * clip.unit:
        if beyond:
            u[0] = min(max(g, clip.low), clip.high)
            du[0] = 0.0
            slope[:] = 0.0
            dslope[:] = 0.0
        return beyond, True
    ds = np.zeros(k)
    for i in range(n):
        for c in range(k):
            ds[c] += dslope[0, i, c] * weighed[i] / s
            for j in range(n):
                ds[c] += slope[0, i] * here.dP[at + i, at + j, c] * slope[0, j] / (2 * s)
    first, second = _tail(low / s, s), _tail(-high / s, s)
    inside = 1.0 - first[0] - second[0]
    bell, lever = first[1] - second[1], first[2] + second[2]
    mean = first[3] - second[3] + s * bell
    square = first[4] + second[4] + s**2 * (inside + lever)
    drift[0] = max(square - mean**2 - (inside * s) ** 2, 0.0)
    u[0] = g + mean
    for c in range(k):
        dg = du[0, c]
        du[0, c] = inside * dg + bell * ds[c]
        change = (bell * dg + lever * ds[c]) / s
        for j in range(n):
            dslope[0, j, c] = inside * dslope[0, j, c] + change * slope[0, j]
        drift[1 + c] = 2 * (s * bell * (1 - inside) - mean * inside) * dg
        other = s * (inside + lever) - mean * bell - inside * s * lever - inside**2 * s
        drift[1 + c] += 2 * other * ds[c]
    slope[0] *= inside
    return beyond, True


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _tail(a: float, s: float) -> tuple[float, float, float, float, float]:
    """Of a normal number below a: its probability, density, a times it; and s a, squared, below."""
    if a == -np.inf:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    below = math.erfc(-a / np.sqrt(2.0)) / 2
    density = np.exp(-(a**2) / 2) / np.sqrt(2 * np.pi)
    return below, density, a * density, s * a * below, (s * a) ** 2 * below


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _weigh(joint: JointLoop, djoint: JointLoop, P: Buffer, dP: Buffer, here: _Update) -> None:
    """Gain and covariance of the next innovation, with half of what they tell of the noise."""
    size, p, k = len(P), len(joint.C), dP.shape[2]
    here.PC[:] = P @ joint.C.T
    here.S[:] = joint.C @ here.PC + joint.R
    here.inverse[:] = np.linalg.inv(here.S)
    here.gain[:] = here.PC @ here.inverse
    here.dPC[:] = 0.0
    here.dS[:] = djoint.R
    for a in range(p):
        for j in range(size):
            if joint.C[a, j] != 0.0:
                for i in range(size):
                    for c in range(k):
                        here.dPC[i, a, c] += dP[i, j, c] * joint.C[a, j]
            if np.any(djoint.C[a, j]):
                for i in range(size):
                    for c in range(k):
                        here.dPC[i, a, c] += P[i, j] * djoint.C[a, j, c]
    for a in range(p):
        for b in range(p):
            for i in range(size):
                for c in range(k):
                    here.dS[a, b, c] += joint.C[a, i] * here.dPC[i, b, c]
                    here.dS[a, b, c] += djoint.C[a, i, c] * here.PC[i, b]
    here.dgain[:] = 0.0
    for i in range(size):
        for a in range(p):
            for c in range(k):
                left = here.dPC[i, a, c]
                for b in range(p):
                    left -= here.gain[i, b] * here.dS[b, a, c]
                for b in range(p):
                    here.dgain[i, b, c] += left * here.inverse[a, b]
    _weigh_noise(here)
    _shrink(P, dP, here)


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _weigh_noise(here: _Update) -> None:
    """tr(S^-1 dS S^-1 dS) / 2 for each pair of directions."""
    p, k = len(here.S), here.dS.shape[2]
    told = np.zeros((k, p, p))
    for c in range(k):
        for a in range(p):
            for b in range(p):
                for j in range(p):
                    told[c, a, b] += here.inverse[a, j] * here.dS[j, b, c]
    for c in range(k):
        for d in range(c + 1):
            total = 0.0
            for a in range(p):
                for b in range(p):
                    total += told[c, a, b] * told[d, b, a]
            here.half[c, d] = total / 2
            here.half[d, c] = total / 2


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _update(
    joint: JointLoop,
    djoint: JointLoop,
    here: _Update,
    output: Buffer,
    z: Buffer,
    dz: Buffer,
    result: FilterResult,
    t: int,
    shared: int,
) -> bool:
    """Likelihood and score of one sample; z and dz become those given the sample.

    Returns whether directions from `shared` on move the innovation and its covariance by nothing.
    """
    size, p, k, q = len(z), len(output), here.dS.shape[2], dz.shape[1]
    e, de = output - joint.C @ z, np.zeros((p, q))
    for a in range(p):
        for i in range(size):
            if joint.C[a, i] != 0.0:
                for c in range(q):
                    de[a, c] -= joint.C[a, i] * dz[i, c]
            for c in range(k):
                de[a, c] -= djoint.C[a, i, c] * z[i]
    weighed = here.inverse @ e
    result.innovation[t] = e
    result.spread[t] = here.S
    volume = np.log(np.linalg.det(here.S)) + p * np.log(2 * np.pi)
    result.told[t] = -(np.dot(e, weighed) + volume) / 2
    wde = here.inverse @ de
    score = result.score[t]
    score[:] = -(weighed @ de)
    for a in range(p):
        for b in range(p):
            apart = (weighed[a] * weighed[b] - here.inverse[a, b]) / 2
            for c in range(k):
                score[c] += apart * here.dS[a, b, c]
    for c in range(q):
        for a in range(p):
            for d in range(q):
                result.information[c, d] += de[a, c] * wde[a, d]
    for c in range(k):
        for d in range(k):
            result.information[c, d] += here.half[c, d]
    for i in range(size):
        for a in range(p):
            z[i] += here.gain[i, a] * e[a]
            for c in range(q):
                dz[i, c] += here.gain[i, a] * de[a, c]
            for c in range(k):
                dz[i, c] += here.dgain[i, a, c] * e[a]
    result.filtered[t] = z
    for a in range(p):
        for c in range(shared, q):
            if not abs(de[a, c]) <= _FORGOTTEN * np.sqrt(here.S[a, a]):
                return False
        for c in range(shared, k):
            if not abs(here.dS[a, a, c]) <= _FORGOTTEN * here.S[a, a]:
                return False
    return True


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _slope(
    loop: LoopMatrices,
    dloop: LoopMatrices,
    rows: Rows,
    drows: RowDirections,
    work: Workspace,
    k: int,
) -> tuple[Buffer, Buffer]:
    """Slope of the input with the state (m, n), and its derivative (m, n, k): exact.

    With the active rows a it is -K - (Gram_aa^-1 N_a0)' T_a, N_a0 the columns of the first stage.
    """
    (m, n), active, free = loop.K.shape, work.active[0], work.free
    slope, dslope = -loop.K, -dloop.K[:, :, :k].copy()
    if active == 0:
        return slope, dslope
    first = np.empty((active, m))
    for a in range(active):
        first[a] = rows.N[free[a], :m]
    substitute_all(work.factor, active, first)
    dfirst = _first_changes(loop, dloop, rows, drows, work, first, k)
    for i in range(m):
        for a in range(active):
            for j in range(n):
                slope[i, j] -= first[a, i] * rows.T[free[a], j]
                for c in range(k):
                    dslope[i, j, c] -= dfirst[a, i * k + c] * rows.T[free[a], j]
                    dslope[i, j, c] -= first[a, i] * drows.T[free[a], j, c]
    return slope, dslope


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _first_changes(
    loop: LoopMatrices,
    dloop: LoopMatrices,
    rows: Rows,
    drows: RowDirections,
    work: Workspace,
    first: Buffer,
    k: int,
) -> Buffer:
    """Derivative (a, m k) of `first` = Gram^-1 N_0: Gram^-1 (dN_0 - dGram first)."""
    (active, m), free, width = first.shape, work.free, rows.N.shape[1]
    pulled, moved = np.zeros((m, width)), np.zeros((m, width, k))
    for i in range(m):
        for a in range(active):
            for j in range(width):
                pulled[i, j] += rows.N[free[a], j] * first[a, i]
                for c in range(k):
                    moved[i, j, c] += drows.M[free[a], j, c] * first[a, i]
        for j in range(width):
            for h in range(m):
                for c in range(k):
                    moved[i, j, c] -= dloop.S[j % m, h, c] * pulled[i, j - j % m + h]
    result = np.zeros((active, m * k))
    for a in range(active):
        for i in range(m):
            for c in range(k):
                left = drows.M[free[a], i, c]
                for h in range(m):
                    left -= rows.N[free[a], h] * dloop.S[h, i, c]
                for h in range(m):
                    result[a, h * k + c] += left * loop.S[i, h]
            for j in range(width):
                for c in range(k):
                    result[a, i * k + c] -= drows.M[free[a], j, c] * pulled[i, j]
                    result[a, i * k + c] -= rows.N[free[a], j] * moved[i, j, c]
    substitute_all(work.factor, active, result)
    return result


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _spread(
    joint: JointLoop,
    djoint: JointLoop,
    moves: Buffer,
    here: _Update,
    slope: Buffer,
    dslope: Buffer,
    at: int,
    u: Buffer,
    du: Buffer,
    drift: Buffer,
) -> Buffer:
    """Covariance of the next z, given the outputs so far; its derivative goes to here.ahead."""
    size, k, n = len(here.P), here.dP.shape[2], slope.shape[1]
    F = joint.F.copy()
    F[:, at : at + n] += joint.B @ slope
    ahead = here.P @ F.T
    P, dP = F @ ahead + joint.Q, here.ahead
    # What is symmetric is filled from its upper half, which is half of the work.
    np.dot(F, here.dP.reshape(size, size * k), here.product.reshape(size, size * k))
    for i in range(size):
        np.dot(F[i:], here.product[i], dP[i, i:])
    _add_turns(joint, djoint, moves, slope, dslope, at, ahead, dP)
    for a in range(len(u)):
        if joint.share[a] != 0.0:
            size_of = joint.share[a] * u[a]
            dvariance = np.zeros(k)
            for c in range(k):
                change = joint.share[a] * du[a, c] + djoint.share[a, c] * u[a]
                dvariance[c] = 2 * size_of * change
            _add_noise(joint.G[:, a], djoint.G[:, a], size_of**2, dvariance, P, dP)
    if drift[0] > 0.0:
        _add_noise(joint.B[:, 0], djoint.B[:, 0], drift[0], drift[1:], P, dP)
    for i in range(size):
        for j in range(i, size):
            for c in range(k):
                dP[i, j, c] += djoint.Q[i, j, c]
            dP[j, i] = dP[i, j]
    return (P + P.T) / 2  # type: ignore[no-any-return]


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _add_noise(
    column: Buffer, dcolumn: Buffer, variance: float, dvariance: Buffer, P: Buffer, dP: Buffer
) -> None:
    """Add the covariance of noise that enters by a column, and the upper half of its derivative."""
    turns = bool(np.any(dcolumn))
    for i in range(len(P)):
        for j in range(len(P)):
            both = column[i] * column[j]
            P[i, j] += both * variance
            if both != 0.0 and j >= i:
                for c in range(len(dvariance)):
                    dP[i, j, c] += both * dvariance[c]
            if turns and j >= i:
                for c in range(len(dvariance)):
                    moved = dcolumn[i, c] * column[j] + column[i] * dcolumn[j, c]
                    dP[i, j, c] += moved * variance


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _shrink(P: Buffer, dP: Buffer, here: _Update) -> None:
    """Covariance once a sample of the outputs is known, and its derivative."""
    size, p, k = len(P), len(here.S), dP.shape[2]
    here.P[:] = P - here.gain @ here.PC.T
    here.dP[:] = dP
    weighed = np.zeros((size, p, k))
    for i in range(size):
        for a in range(p):
            for b in range(p):
                for c in range(k):
                    weighed[i, a, c] += here.gain[i, b] * here.dS[b, a, c] / 2
            for c in range(k):
                weighed[i, a, c] -= here.dPC[i, a, c]
    for i in range(size):
        for j in range(i, size):
            for a in range(p):
                first, second = here.gain[j, a], here.gain[i, a]
                for c in range(k):
                    here.dP[i, j, c] += weighed[i, a, c] * first + second * weighed[j, a, c]
            here.dP[j, i] = here.dP[i, j]


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _add_turns(
    joint: JointLoop,
    djoint: JointLoop,
    moves: Buffer,
    slope: Buffer,
    dslope: Buffer,
    at: int,
    ahead: Buffer,
    dP: Buffer,
) -> None:
    """Add dF P F' and its transpose to the upper half of dP, with `ahead` = P F'."""
    size, k, (m, n) = len(dP), dP.shape[2], slope.shape
    commanded, moved = np.zeros((m, size)), np.zeros((m, size, k))
    for a in range(m):
        for j in range(n):
            for b in range(size):
                commanded[a, b] += slope[a, j] * ahead[at + j, b]
                for c in range(k):
                    moved[a, b, c] += dslope[a, j, c] * ahead[at + j, b]
    turns = np.empty((size, k))
    for i in range(size):
        turns[:] = 0.0
        for j in range(size):
            first, last = moves[i, j]
            if last > first:
                for b in range(size):
                    for c in range(first, last):
                        turns[b, c] += djoint.F[i, j, c] * ahead[j, b]
        for a in range(m):
            if joint.B[i, a] != 0.0:
                for b in range(size):
                    for c in range(k):
                        turns[b, c] += joint.B[i, a] * moved[a, b, c]
            if np.any(djoint.B[i, a]):
                for b in range(size):
                    for c in range(k):
                        turns[b, c] += djoint.B[i, a, c] * commanded[a, b]
        for b in range(size):
            low, high = min(i, b), max(i, b)
            times = 2.0 if b == i else 1.0
            for c in range(k):
                dP[low, high, c] += times * turns[b, c]


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _near(P: Buffer, dP: Buffer, steady: Steady) -> bool:
    """Whether covariance and derivative are the stationary ones, but for what is left out."""
    for i in range(len(P)):
        for j in range(len(P)):
            unit = np.sqrt(steady.P[i, i] * steady.P[j, j])
            if not abs(P[i, j] - steady.P[i, j]) <= _STEADY * unit:
                return False
            for c in range(dP.shape[2]):
                if not abs(dP[i, j, c] - steady.dP[i, j, c]) <= _STEADY_SLOPE * unit:
                    return False
    return True


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _ahead(
    joint: JointLoop,
    djoint: JointLoop,
    moves: Buffer,
    u: Buffer,
    du: Buffer,
    disturbance: Buffer,
    z: Buffer,
    dz: Buffer,
) -> None:
    """z becomes F z + B u + E d, and dz its derivative."""
    size, k = len(z), djoint.F.shape[2]
    before, dbefore = z.copy(), dz.copy()
    z[:] = joint.F @ before + joint.B @ u + joint.E @ disturbance
    dz[:] = 0.0
    for i in range(size):
        for j in range(size):
            if joint.F[i, j] != 0.0:
                for c in range(dz.shape[1]):
                    dz[i, c] += joint.F[i, j] * dbefore[j, c]
            for c in range(moves[i, j, 0], moves[i, j, 1]):
                dz[i, c] += djoint.F[i, j, c] * before[j]
        for a in range(len(u)):
            if joint.B[i, a] != 0.0:
                for c in range(dz.shape[1]):
                    dz[i, c] += joint.B[i, a] * du[a, c]
            for c in range(k):
                dz[i, c] += djoint.B[i, a, c] * u[a]
        for a in range(len(disturbance)):
            for c in range(k):
                dz[i, c] += djoint.E[i, a, c] * disturbance[a]


@njit(cache=True, nogil=True)
def run_person(
    loop: LoopMatrices,
    dloop: LoopMatrices,
    rows: Rows,
    drows: RowDirections,
    unit: Buffer,
    joint: JointLoop,
    at: int,
    disturbance: Buffer,
    noise: Buffer,
    shared: Buffer,
    z: Buffer,
    u: Buffer,
    status: Buffer,
) -> int:
    """Simulate from z[0] with noise that has been drawn, without derivatives.

    Parameters
    ----------
    loop, dloop, rows, drows, unit, joint, at
        As in `run_filter`, along no direction; unit (m,).
    disturbance, noise : Buffer
        (samples, d), and what is added to the next z (samples, z).
    shared : Buffer
        Normal numbers (samples, m), for the noise that is a share of the command.
    z, u, status : Buffer
        Written: (samples + 1, z) after the first, (samples, m) and (samples,).

    Returns
    -------
    int
        Samples before the one at which the law has no answer; all when it always has.
    """
    n = loop.K.shape[1]
    work = workspace(rows, u.shape[1], 0)
    lam, dx, du = np.zeros(len(rows.b)), np.zeros((n, 0)), np.zeros((u.shape[1], 0))
    for t in range(len(u)):
        x = z[t, at : at + n]
        status[t], _, _ = law(loop, dloop, rows, drows, unit, work, x, dx, lam, False, u[t], du)
        if status[t] > _SOFTENED:
            return t
        z[t + 1] = joint.F @ z[t] + joint.B @ u[t] + joint.E @ disturbance[t] + noise[t]
        z[t + 1] += joint.G @ (joint.share * u[t] * shared[t])
        if not np.max(np.abs(z[t + 1])) < _LARGEST:
            status[t] = _DIVERGED
            return t
    return len(u)
