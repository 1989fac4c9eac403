"""Nonlinear least squares with a normal prior, for shared unknowns and others of one trial each.

    minimise over (u, v)   N log |r(u, v)|^2 + |w_u (u - u_0)|^2 + |w_v (v - v_0)|^2,   r of N rows

This is the mode of the posterior density for white noise of unknown variance |r|^2 / N: no noise
level has to be guessed, and exact data outweigh any prior. The method is Levenberg's and
Marquardt's. Columns of v_i are zero outside trial i, so each v_i is eliminated by a QR
factorisation of its own trial: time and memory grow with the number of trials. A point that cannot
be simulated is a rejected step.

Exact data of few samples lie at the end of curved valleys, along which straight steps creep. There
each step d_1 is bent by the second derivative of the residual along it (Transtrum and Sethna 2012,
"geodesic acceleration"), for one more evaluation without derivatives:

    d_2 = -1/2 (J'J + damping)^-1 J' r'',     r'' = 2/h ((r(z + h d_1) - r(z))/h - J d_1)

`TrialSpan` is what initial states, trial by trial, and other columns can explain of a residual.
Side by side these columns would take the square of the number of trials: 8 GB for 500 of 500
samples (docs/speed.md).
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
# Damping at the start, its least value, and how it changes after a poor and after a good step.
_DAMPING, _LEAST, _UP, _DOWN = 1e-3, 1e-12, 6.0, 0.2
# Rejected steps in a row that end a search.
_TRIES = 14
# Marquardt's scale of a column: at least this share of the largest squared norm.
_FLOOR = 1e-6
# h, and how much of a step its bend may be: beyond, the step is too long for a second derivative.
_PROBE, _BEND = 0.1, 0.375


@dataclass(frozen=True)
class Rows:
    """Residual and derivatives at a point; trials with fewer rows are filled up with zeros."""

    residual: Array  # (trials, w)
    # Its derivative with respect to u, (trials, w, a), and to the trial's v, (trials, w, n)
    shared: Array
    own: Array
    curved: bool = False  # Whether a second derivative says something: steps from here are bent

    @property
    def square(self) -> float:
        """Squared 2-norm of the residual."""
        return float(np.sum(self.residual**2))


@dataclass(frozen=True)
class Prior:
    """A normal prior."""

    u: Array  # Its centre (a,), (trials, n)
    v: Array
    shared: Array  # One over the standard deviations of u (a,)
    own: float  # One over that of each entry of v

    def square(self, u: Array, v: Array) -> float:
        """-2 log of its density at `u` (a,), `v` (trials, n), but for a constant."""
        return float(np.sum((self.shared * (u - self.u)) ** 2) + self.own**2 * _square(v - self.v))


@dataclass(frozen=True)
class Stop:
    """When a search ends."""

    nats: float  # Predicted decrease of the objective
    square: float  # Squared residual of rounding
    evaluations: int  # Evaluations with derivatives, at most


class Model(Protocol):
    """What is fitted, as a function of u (a,) and v (trials, n)."""

    @property
    def count(self) -> int:
        """N."""

    def rows(self, u: Array, v: Array) -> Rows | None:
        """Residual and derivatives at `u` (a,), `v` (trials, n); None where there are none."""

    def square(self, u: Array, v: Array) -> float:
        """Squared residual at `u` (a,), `v` (trials, n); infinite where there is none."""

    def bend(self, du: Array, dv: Array, share: float) -> tuple[Array, Array] | None:
        """J' (r(z + share d) - r(z)), (a,) and (trials, n), of `du` (a,), `dv` (trials, n).

        At the last point z of `rows`.
        """


def minimise(
    model: Model, prior: Prior, begin: tuple[Array, Array], stop: Stop
) -> tuple[Array, Array, int, bool]:
    """Search for u (a,) and v (trials, n): where it ends, evaluations, and whether it converged."""
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
    """Marquardt's scale, squared norms of columns: it grows at once and shrinks by halves."""
    shared = np.sum(here.shared**2, axis=(0, 1)) + variance * prior.shared**2
    own = np.sum(here.own**2, axis=1) + variance * prior.own**2
    floor = _FLOOR * max(np.max(shared, initial=0.0), np.max(own, initial=0.0)) + 1e-300
    return (
        np.maximum(before[0] / 2, np.maximum(shared, floor)),
        np.maximum(before[1] / 2, np.maximum(own, floor)),
    )


class _Step:
    """A damped step from u and v.

    Rows of prior and damping are one: of weight d, and a side c with d c that of the prior alone.
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
        #: By how much the linear model says that the step lowers the objective, nats.
        self.predicted = fall - prior.square(at[0] + self.du, at[1] + self.dv) + prior.square(*at)
        self.linear = self._products(here, moved)

    def bent(self, model: Model) -> tuple[Array, Array] | None:
        """The step with its acceleration; None where that is too large."""
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
        """J' J d of the residual's rows alone."""
        return (
            np.einsum("twa,tw->a", here.shared, moved),
            np.einsum("twn,tw->tn", here.own, moved),
        )

    def _back(self, u: Array, v: Array) -> tuple[Array, Array]:
        """R^-1 of a side (a,), (trials, n)."""
        du = np.linalg.solve(self.shared, u)
        dv = np.linalg.solve(self.own, (v - self.beside @ du)[..., None])[..., 0]
        return np.asarray(du), np.asarray(dv)

    def _solved(self, u: Array, v: Array) -> tuple[Array, Array]:
        """(R'R)^-1 of a gradient (a,), (trials, n)."""
        y_v = np.linalg.solve(np.swapaxes(self.own, 1, 2), v[..., None])[..., 0]
        y_u = np.linalg.solve(self.shared.T, u - np.einsum("tna,tn->a", self.beside, y_v))
        return self._back(np.asarray(y_u), np.asarray(y_v))


def _square(values: Array) -> float:
    return float(np.sum(values**2))


def triangular_rows(columns: list[Array]) -> Array:
    """R (w, w) of a QR factorisation of `columns`, arrays (r, k) side by side, block by block.

    Norms and inner products of its columns are those of the given ones; of fewer rows than w where
    there are fewer. Blocks of a few thousand rows stay in the processor's cache: a recording ten
    times as long takes ten times the time, not fifteen.
    """
    width = sum(part.shape[1] for part in columns)
    triangle = np.zeros((0, width))
    for first in range(0, len(columns[0]), _BLOCK):
        block = np.hstack([part[first : first + _BLOCK] for part in columns])
        # "raw" copies the triangle alone, "r" all rows below it too.
        _, upper = scipy.linalg.qr(np.vstack([triangle, block]), mode="raw", check_finite=False)
        triangle = np.asarray(upper, dtype=np.float64)
    return triangle


# A column that the others explain to that of its length adds nothing but rounding.
_ROUNDING = 1e-10


@dataclass(frozen=True)
class TrialSpan:
    """An orthonormal basis."""

    own: tuple[Array, ...]  # Of each trial (rows, k), k at most n; zero in the rows of the others
    shared: Array  # Of the rest (r, c), orthogonal to those

    def without(self, columns: Array) -> Array:
        """What the basis does not explain of `columns` (r, k), of that shape."""
        left = _without(self.own, columns)
        return np.asarray(left - self.shared @ (self.shared.T @ left))

    def upper(self, trials: int, rows: int) -> TrialSpan:
        """The first rows alone, those of so many trials."""
        return TrialSpan(self.own[:trials], self.shared[:rows])

    def plus(self, columns: Array) -> TrialSpan:
        """With orthonormal `columns` (r, k) that are orthogonal to this basis."""
        return TrialSpan(self.own, np.hstack([self.shared, columns]))


def trial_span(own: Array, sizes: Sequence[int], shared: Array) -> TrialSpan:
    """Span of columns, each in its own scale, to 1e-10; `own` (r, n); `shared` (r, c)."""
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
