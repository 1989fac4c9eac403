"""Nonlinear least squares with a normal prior, for shared and trial-specific unknowns.

    minimise over (u, v)   N log |r(u, v)|^2 + |w_u (u - u_0)|^2 + |w_v (v - v_0)|^2,   r of N rows

This is the posterior mode for white noise of unknown variance |r|^2 / N. The method is
Levenberg-Marquardt. Columns of v_i are zero outside trial i, so each v_i is eliminated by a QR
factorisation of its own trial: time and memory grow linearly with the number of trials.

Steps can include geodesic acceleration (Transtrum and Sethna 2012), at the cost of one more
evaluation without derivatives:

    d_2 = -1/2 (J'J + damping)^-1 J' r'',     r'' = 2/h ((r(z + h d_1) - r(z))/h - J d_1)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
import scipy.linalg

from impc.arrays import Array

if TYPE_CHECKING:
    from collections.abc import Sequence

_BLOCK = 4096
# Initial and least damping; its factors after a rejected and after a good step.
_DAMPING, _LEAST, _UP, _DOWN = 1e-3, 1e-12, 6.0, 0.2
# A search ends after this many rejected steps in a row.
_TRIES = 14
# Least squared norm of a column in the damping, relative to the largest.
_FLOOR = 1e-6
# Probe length h; acceleration above this share of the step means the step is too long.
_PROBE, _BEND = 0.1, 0.375


@dataclass(frozen=True)
class Rows:
    """Residual and derivatives at a point; shorter trials are padded with zero rows."""

    residual: Array  # (trials, w)
    # Derivatives with respect to u, (trials, w, a), and to the v of the trial, (trials, w, n)
    shared: Array
    own: Array
    curved: bool = False  # Whether steps from here use geodesic acceleration

    @property
    def square(self) -> float:
        """Squared 2-norm of the residual."""
        return float(np.sum(self.residual**2))


@dataclass(frozen=True)
class Prior:
    """Independent normal prior of u and v."""

    u: Array  # Mean of u (a,) and of v (trials, n)
    v: Array
    shared: Array  # 1 / SD of u (a,)
    own: float  # 1 / SD of each entry of v

    def square(self, u: Array, v: Array) -> float:
        """-2 log density at `u` (a,), `v` (trials, n), up to a constant."""
        return float(np.sum((self.shared * (u - self.u)) ** 2) + self.own**2 * _square(v - self.v))


@dataclass(frozen=True)
class Stop:
    """Stopping rule of a search."""

    nats: float  # Predicted decrease of the objective
    square: float  # Squared residual at rounding level
    evaluations: int  # Largest number of evaluations with derivatives


class Model(Protocol):
    """Residual as a function of u (a,) and v (trials, n)."""

    @property
    def count(self) -> int:
        """Number of residuals N."""

    def rows(self, u: Array, v: Array) -> Rows | None:
        """Residual and derivatives at `u` (a,), `v` (trials, n); None if infeasible."""

    def square(self, u: Array, v: Array) -> float:
        """Squared residual at `u` (a,), `v` (trials, n); infinite if infeasible."""

    def bend(self, du: Array, dv: Array, share: float) -> tuple[Array, Array] | None:
        """J' (r(z + share d) - r(z)) at the last point z of `rows`, d = (`du`, `dv`)."""


def minimise(
    model: Model, prior: Prior, begin: tuple[Array, Array], stop: Stop
) -> tuple[Array, Array, int, bool]:
    """Minimise over u (a,), v (trials, n): minimiser, evaluations, whether it converged."""
    u, v = begin
    here, spent, damping = model.rows(u, v), 1, _DAMPING
    scale: tuple[Array, Array] = np.zeros(len(u)), np.zeros(v.shape)
    while here is not None and here.square > stop.square:
        variance = here.square / model.count
        scale = _scaled(here, prior, variance, scale)
        for _ in range(_TRIES):
            step = _Step(here, prior, (u, v), variance, damping, scale)
            predicted = step.predicted
            moved = step.bent(model) if here.curved else (step.du, step.dv)
            gained, there = -np.inf, np.inf
            if moved is not None:
                there = model.square(u + moved[0], v + moved[1])
                gained = model.count * (np.log(here.square) - np.log(max(there, 1e-300)))
                gained += prior.square(u, v) - prior.square(u + moved[0], v + moved[1])
            if gained > 0:
                break
            if predicted <= stop.nats:
                return u, v, spent, True
            damping = max(_UP * damping, 1e-8)
        if moved is None or gained <= 0:
            return u, v, spent, False
        damping = max(damping * (_DOWN if gained > predicted / 2 else 1.0), _LEAST)
        u, v = u + moved[0], v + moved[1]
        if gained <= stop.nats or there <= stop.square:
            return u, v, spent, True
        if spent >= stop.evaluations:
            return u, v, spent, False
        here, spent = model.rows(u, v), spent + 1
    return u, v, spent, here is not None


def _scaled(
    here: Rows, prior: Prior, variance: float, before: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Squared column norms for the damping; a norm shrinks by at most half per step."""
    shared = np.sum(here.shared**2, axis=(0, 1)) + variance * prior.shared**2
    own = np.sum(here.own**2, axis=1) + variance * prior.own**2
    floor = _FLOOR * max(np.max(shared, initial=0.0), np.max(own, initial=0.0)) + 1e-300
    return (
        np.maximum(before[0] / 2, np.maximum(shared, floor)),
        np.maximum(before[1] / 2, np.maximum(own, floor)),
    )


class _Step:
    """Damped step from u and v.

    Prior and damping share rows of weight d with right-hand side c, where d c is that of the prior.
    """

    def __init__(
        self,
        here: Rows,
        prior: Prior,
        at: tuple[Array, Array],
        variance: float,
        damping: float,
        scale: tuple[Array, Array],
    ) -> None:
        (trials, n), a = at[1].shape, len(at[0])
        self.weights = (
            np.sqrt(variance * prior.shared**2 + damping * scale[0]),
            np.sqrt(variance * prior.own**2 + damping * scale[1]),
        )
        pull_u = variance * prior.shared**2 * (at[0] - prior.u)
        pull_v = variance * prior.own**2 * (at[1] - prior.v)
        table = np.concatenate([here.own, here.shared, here.residual[..., None]], axis=2)
        below = np.zeros((trials, max(n, n + a + 1 - table.shape[1]), n + a + 1))
        below[:, np.arange(n), np.arange(n)] = self.weights[1]
        below[:, :n, -1] = pull_v / self.weights[1]
        upper = np.asarray(np.linalg.qr(np.concatenate([table, below], axis=1), mode="r"))
        self.own, self.beside = upper[:, :n, :n], upper[:, :n, n : n + a]
        rest = upper[:, n:, n:].reshape(-1, a + 1)
        last = np.column_stack([np.diag(self.weights[0]), pull_u / self.weights[0]])
        whole = np.asarray(np.linalg.qr(np.concatenate([rest, last]), mode="r"))
        self.shared = whole[:a, :a]
        self.du, self.dv = self._back(-whole[:a, a], -upper[:, :n, -1])
        moved = here.shared @ self.du + np.einsum("twn,tn->tw", here.own, self.dv)
        fall = (here.square - _square(here.residual + moved)) / variance
        #: Predicted decrease of the objective in the linear model, nats.
        self.predicted = fall - prior.square(at[0] + self.du, at[1] + self.dv) + prior.square(*at)
        self.linear = self._products(here, moved)

    def bent(self, model: Model) -> tuple[Array, Array] | None:
        """Step with geodesic acceleration; None if the acceleration is too large."""
        change = model.bend(self.du, self.dv, _PROBE)
        if change is None:
            return None
        second = [
            2 / _PROBE * (part / _PROBE - linear)
            for part, linear in zip(change, self.linear, strict=True)
        ]
        du, dv = self._solved(-second[0] / 2, -second[1] / 2)
        if self._size(du, dv) > _BEND * self._size(self.du, self.dv):
            return None
        return self.du + du, self.dv + dv

    def _size(self, du: Array, dv: Array) -> float:
        return float(np.sqrt(_square(self.weights[0] * du) + _square(self.weights[1] * dv)))

    def _products(self, here: Rows, moved: Array) -> tuple[Array, Array]:
        """J' J d of the residual rows only."""
        return (
            np.einsum("twa,tw->a", here.shared, moved),
            np.einsum("twn,tw->tn", here.own, moved),
        )

    def _back(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Solve with the triangular factor R, for right-hand sides (a,) and (trials, n)."""
        du = np.linalg.solve(self.shared, u)
        dv = np.linalg.solve(self.own, (v - self.beside @ du)[..., None])[..., 0]
        return np.asarray(du), np.asarray(dv)

    def _solved(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Solve with R'R, for a gradient (a,) and (trials, n)."""
        y_v = np.linalg.solve(np.swapaxes(self.own, 1, 2), v[..., None])[..., 0]
        y_u = np.linalg.solve(self.shared.T, u - np.einsum("tna,tn->a", self.beside, y_v))
        return self._back(np.asarray(y_u), np.asarray(y_v))


def _square(values: Array) -> float:
    return float(np.sum(values**2))


def triangular_rows(columns: list[Array]) -> Array:
    """Triangular factor R (w, w) of `columns`, arrays (r, k) side by side, by row blocks.

    R has the norms and inner products of the columns, and fewer rows if r < w. Blocks of a few
    thousand rows fit into the cache of the processor.
    """
    width = sum(part.shape[1] for part in columns)
    triangle = np.zeros((0, width))
    for first in range(0, len(columns[0]), _BLOCK):
        block = np.hstack([part[first : first + _BLOCK] for part in columns])
        # mode "r" would also copy all rows below the triangle.
        _, upper = scipy.linalg.qr(np.vstack([triangle, block]), mode="raw", check_finite=False)
        triangle = np.asarray(upper, dtype=np.float64)
    return triangle


# Columns that the others explain up to this share of their norm count as dependent.
_ROUNDING = 1e-10


@dataclass(frozen=True)
class TrialSpan:
    """Orthonormal basis of trial-specific and shared columns."""

    own: tuple[Array, ...]  # Per trial (rows, k), k <= n; zero outside the trial
    shared: Array  # Remaining columns (r, c), orthogonal to `own`

    def without(self, columns: Array) -> Array:
        """Residual of `columns` (r, k) after projection on the basis."""
        left = _without(self.own, columns)
        return np.asarray(left - self.shared @ (self.shared.T @ left))

    def upper(self, trials: int, rows: int) -> TrialSpan:
        """Restriction to the first `trials` trials, `rows` rows."""
        return TrialSpan(self.own[:trials], self.shared[:rows])

    def plus(self, columns: Array) -> TrialSpan:
        """Basis extended by orthonormal `columns` (r, k) orthogonal to it."""
        return TrialSpan(self.own, np.hstack([self.shared, columns]))


def trial_span(own: Array, sizes: Sequence[int], shared: Array) -> TrialSpan:
    """Basis of the scaled columns `own` (r, n) by trial and `shared` (r, c), to 1e-10."""
    parts = np.split(own, np.cumsum(sizes)[:-1])
    bases = tuple(_basis(_of_length_one(part)) for part in parts)
    return TrialSpan(bases, _basis(_without(bases, _of_length_one(shared))))


def _of_length_one(columns: Array) -> Array:
    size = np.linalg.norm(columns, axis=0)
    return np.asarray(columns[:, size > 0] / size[size > 0])


def _basis(columns: Array) -> Array:
    if columns.size == 0:
        return np.zeros((len(columns), 0))
    left, values, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(left[:, values > _ROUNDING])


def _without(bases: Sequence[Array], columns: Array) -> Array:
    left, row = np.array(columns), 0
    for basis in bases:
        mine = slice(row, row + len(basis))
        row = mine.stop
        left[mine] -= basis @ (basis.T @ left[mine])
    return left
