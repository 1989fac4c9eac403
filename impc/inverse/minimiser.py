"""Levenberg-Marquardt with a normal prior, for shared and trial-specific unknowns.

    F(u, v) = -2 log L(u, v) + |w_u (u - u_0)|^2 + |w_v (v - v_0)|^2

F is -2 log posterior, up to a constant. Half the gradient of -2 log L is J'r / s, and half its
curvature is approximated by J'J / s. For N residuals r of white noise of unknown variance,
-2 log L = N log |r|^2 and s = |r|^2 / N. Any other likelihood gives a factor J of its Fisher
information, the r that belongs to its score, and s = 1.

Columns of v_i are zero outside trial i, so each v_i is eliminated by a QR factorisation of its own
trial: time and memory grow linearly with the number of trials.

A search has converged where the undamped Gauss-Newton step promises less than `Stop.promise`. It is
stuck where steps of any length no longer lower F although more is promised: at a crease, where the
set of saturated samples changes, or at the end of a bent valley. That is no minimum.

Steps can include geodesic acceleration (Transtrum and Sethna 2012), at the cost of one more
evaluation without derivatives:

    d_2 = -1/2 (J'J + damping)^-1 J' r'',     r'' = 2/h ((r(z + h d_1) - r(z))/h - J d_1)
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import numpy as np

from impc.arrays import Array

# Initial and least damping; its factors after a rejected or poor and after a good step, by ratios
# of the gained to the predicted decrease.
_DAMPING, _LEAST, _UP, _DOWN, _GOOD, _POOR = 1e-3, 1e-12, 6.0, 0.2, 0.5, 0.1
# Least damping after a rejected step that cost as much as derivatives.
_SHORTENED = 0.1
# A search is stuck after this many rejected steps in a row, or if this many accepted ones together
# lower F by less than this share of what is still promised; at a crease, also by less than counts
# (`Stop.promise`) and than a larger share.
_TRIES, _CREEPING, _DELIVERED, _PART = 14, 3, 0.03, 0.25
# The same share where a value costs as much as derivatives.
_HURRIED = 0.1
# Damping of the step that counts as undamped: directions that nothing identifies stay.
_NONE = 1e-10
# Least squared norm of a column in the damping, relative to the largest.
_FLOOR = 1e-6
# Probe length h; acceleration above this share of the step means the step is too long.
_PROBE, _BEND = 0.1, 0.375
#: Decrease of F that counts as none.
PROMISE = 0.01
#: Decrease that a search often promises at a crease, where no step lowers F. One that is stuck
#: although more is promised may go on from there.
CREASE = 10.0


class Ended(Enum):
    """How a search ended."""

    EXACT = "the residual is at rounding level"
    CONVERGED = "no step promises a lower misfit"
    STUCK = "no step lowers the misfit, although a lower one is promised"
    STOPPED = "the largest number of evaluations was reached"
    INFEASIBLE = "the start cannot be simulated"


@dataclass(frozen=True)
class Rows:
    """Residual and derivatives at a point; shorter trials are padded with zero rows."""

    residual: Array  # (trials, w)
    # Derivatives with respect to u, (trials, w, a), and to the v of the trial, (trials, w, n)
    shared: Array
    own: Array
    value: float  # -2 log L
    variance: float  # s
    curved: bool = False  # Whether steps from here use geodesic acceleration

    @classmethod
    def of_white_noise(
        cls, count: int, residual: Array, shared: Array, own: Array, *, curved: bool = False
    ) -> Rows:
        """Rows of `count` residuals of unknown variance."""
        square = _square(residual)
        return cls(residual, shared, own, log_square(count, square), square / count, curved)

    @property
    def square(self) -> float:
        """Squared 2-norm of the residual."""
        return _square(self.residual)


@dataclass(frozen=True)
class Prior:
    """Independent normal prior of u and v."""

    u: Array  # Mean of u (a,) and of v (trials, n)
    v: Array
    shared: Array  # 1 / SD of u (a,)
    own: Array | float  # 1 / SD of v (trials, n)

    def square(self, u: Array, v: Array) -> float:
        """-2 log density at `u` (a,), `v` (trials, n), up to a constant."""
        return _square(self.shared * (u - self.u)) + _square(self.own * (v - self.v))


@dataclass(frozen=True)
class Stop:
    """Stopping rule of a search."""

    promise: float  # Decrease of F by an undamped step below which the search has converged
    square: float  # Squared residual at rounding level
    evaluations: int  # Largest number of evaluations with derivatives
    # Whether a value costs as much as derivatives: rejected steps are shortened at once, and ones
    # that promise less than half of `promise` are not tried
    costly: bool = False


@dataclass(frozen=True)
class End:
    """End of a search."""

    u: Array  # Minimiser (a,), and (trials, n)
    v: Array
    evaluations: int  # Evaluations with derivatives
    ended: Ended
    promised: float  # Decrease of F that an undamped step from here promises

    @property
    def converged(self) -> bool:
        """Whether this is a minimum."""
        return self.ended in (Ended.EXACT, Ended.CONVERGED)


class Model(Protocol):
    """Likelihood as a function of u (a,) and v (trials, n)."""

    def rows(self, u: Array, v: Array) -> Rows | None:
        """Residual and derivatives at `u` (a,), `v` (trials, n); None if infeasible."""

    def value(self, u: Array, v: Array) -> float:
        """-2 log L at `u` (a,), `v` (trials, n); infinite if infeasible."""

    def bend(self, du: Array, dv: Array, share: float) -> tuple[Array, Array] | None:
        """J' (r(z + share d) - r(z)) at the last point z of `rows`, d = (`du`, `dv`)."""


def minimise(model: Model, prior: Prior, begin: tuple[Array, Array], stop: Stop) -> End:
    """Minimise F over u (a,), v (trials, n)."""
    u, v = begin
    damping, spent, gains = _DAMPING, 0, [np.inf]
    scale: tuple[Array, Array] = np.zeros(len(u)), np.zeros(v.shape)
    while True:
        here, spent = model.rows(u, v), spent + 1
        if here is None:
            return End(u, v, spent, Ended.INFEASIBLE, np.inf)
        if here.square <= stop.square:
            return End(u, v, spent, Ended.EXACT, 0.0)
        scale = _scaled(here, prior, scale)
        last = _Step(here, prior, (u, v), _NONE, scale)
        promised = last.predicted
        if promised <= stop.promise:
            if _gained(model, prior, here, (u, v), (last.du, last.dv)) > 0:
                u, v = u + last.du, v + last.dv
            return End(u, v, spent, Ended.CONVERGED, promised)
        share = _HURRIED if stop.costly else _DELIVERED
        counts = min(stop.promise, _PART * promised) if promised < CREASE else 0.0
        little = max(share * promised, counts)
        if sum(gains[-_CREEPING:]) <= little:
            return End(u, v, spent, Ended.STUCK, promised)
        if spent >= stop.evaluations:
            return End(u, v, spent, Ended.STOPPED, promised)
        moved, gained = None, -np.inf
        for _ in range(_TRIES):
            step = _Step(here, prior, (u, v), damping, scale)
            if stop.costly and step.predicted < stop.promise / 2:
                break
            moved = step.bent(model) if here.curved else (step.du, step.dv)
            gained = -np.inf
            if moved is not None:
                gained = _gained(model, prior, here, (u, v), moved)
            if gained > 0:
                break
            damping = max(_UP * damping, _SHORTENED if stop.costly else 1e-8)
        if moved is None or gained <= 0:
            return End(u, v, spent, Ended.STUCK, promised)
        # A tiny step can predict 0 in rounding, and is poor then.
        ratio = gained / step.predicted if step.predicted else 0.0
        damping *= _DOWN if ratio > _GOOD else _UP if ratio < _POOR else 1.0
        damping = max(damping, _LEAST)
        u, v = u + moved[0], v + moved[1]
        gains.append(gained)


def _gained(
    model: Model, prior: Prior, here: Rows, at: tuple[Array, Array], moved: tuple[Array, Array]
) -> float:
    """Decrease of F by a step from `at`."""
    u, v = at[0] + moved[0], at[1] + moved[1]
    return here.value - model.value(u, v) + prior.square(*at) - prior.square(u, v)


def _scaled(here: Rows, prior: Prior, before: tuple[Array, Array]) -> tuple[Array, Array]:
    """Squared column norms for the damping; a norm shrinks by at most half per step."""
    shared = np.sum(here.shared**2, axis=(0, 1)) + here.variance * prior.shared**2
    own = np.sum(here.own**2, axis=1) + here.variance * np.square(prior.own)
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
        damping: float,
        scale: tuple[Array, Array],
    ) -> None:
        (trials, n), a, variance = at[1].shape, len(at[0]), here.variance
        self.weights = (
            np.sqrt(variance * prior.shared**2 + damping * scale[0]),
            np.sqrt(variance * np.square(prior.own) + damping * scale[1]),
        )
        pull_u = variance * prior.shared**2 * (at[0] - prior.u)
        pull_v = variance * np.square(prior.own) * (at[1] - prior.v)
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


def log_square(count: int, square: float) -> float:
    """-2 log L of `count` residuals of white noise of unknown variance."""
    return float(count * np.log(max(square, 1e-300)))


def _square(values: Array) -> float:
    return float(np.sum(values**2))
