"""Least squares with unknowns that all trials share and others that belong to one trial each.

    minimise  sum over trials i  |r_i(u, v_i)|^2 + |w (u - u_0)|^2 + w_own^2 |v - v_0|^2

The derivative has the shape of an arrow: columns of v_i are zero outside of trial i. Its QR
factorisation eliminates v_i trial by trial, so that time and memory grow with the number of trials;
a singular value decomposition of all columns takes its cube: 4.8 GB and a minute a step for 500
trials. The search is the trust region of scipy's `least_squares` (Moré 1978; Branch, Coleman and Li
1999), with the same steps and the same ends.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.linalg

from impc.arrays import Array

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["ArrowRows", "Prior", "Tolerances", "arrow_least_squares", "triangular_rows"]

_BLOCK = 4096

# Of scipy's trust region: how near to its radius a step shall end, and in how many tries.
_NEAR, _TRIES = 0.01, 10


@dataclass(frozen=True)
class ArrowRows:
    """Residual and derivative at a point; trials with fewer rows are filled up with zeros.

    Attributes
    ----------
    residual : Array
        (trials, w).
    shared, own : Array
        Its derivative with respect to u, (trials, w, a), and to the trial's v, (trials, w, n).
    """

    residual: Array
    shared: Array
    own: Array


@dataclass(frozen=True)
class Prior:
    """Where u (a,) and v (trials, n) are thought to be.

    Attributes
    ----------
    u, v : Array
        The middle, (a,) and (trials, n).
    shared : Array
        Weight of each entry of u (a,); 0 for none.
    own : float
        Weight of all of v.
    """

    u: Array
    v: Array
    shared: Array
    own: float


@dataclass(frozen=True)
class Tolerances:
    """When a search ends.

    Attributes
    ----------
    ftol, xtol, gtol : float
        Of scipy's `least_squares`: share of the misfit, share of the step, largest slope.
    max_nfev : int
        Calls at most.
    """

    ftol: float
    xtol: float
    gtol: float
    max_nfev: int


def arrow_least_squares(
    rows: Callable[[Array, Array], ArrowRows], prior: Prior, u: Array, v: Array, ends: Tolerances
) -> tuple[Array, Array, int]:
    """Search for u and v.

    Parameters
    ----------
    rows : callable
        (u, v) -> residual and derivative.
    prior : Prior
    u, v : Array
        Where the search begins, (a,) and (trials, n).
    ends : Tolerances

    Returns
    -------
    u, v : Array
        Where it ends, (a,) and (trials, n).
    spent : int
        Calls of `rows`.
    """
    here = _Here.at(rows, prior, u, v)
    radius, alpha, spent = _norm(u, v) or 1.0, 0.0, 1
    while here.slope >= ends.gtol and spent < ends.max_nfev:
        gained, done = -1.0, False
        while gained <= 0 and spent < ends.max_nfev and not done:
            du, dv, alpha = here.step(radius, alpha)
            size = _norm(du, dv)
            there = _Here.at(rows, prior, here.u + du, here.v + dv)
            spent += 1
            if not np.isfinite(there.cost):
                radius = size / 4
                continue
            gained = here.cost - there.cost
            ratio, before = _ratio(gained, here.promised(du, dv)), radius
            if ratio < 0.25:
                radius = size / 4
            elif ratio > 0.75 and size > 0.95 * radius:
                radius *= 2
            done = (gained < ends.ftol * here.cost and ratio > 0.25) or (
                size < ends.xtol * (ends.xtol + _norm(here.u, here.v))
            )
            alpha *= before / radius
        if gained > 0:
            here = there
        if done:
            break
    return here.u, here.v, spent


@dataclass(frozen=True)
class _Here:
    """A point of the search: rows with those of the prior below them."""

    u: Array
    v: Array
    rows: ArrowRows
    prior: Prior

    @classmethod
    def at(
        cls, rows: Callable[[Array, Array], ArrowRows], prior: Prior, u: Array, v: Array
    ) -> _Here:
        found = rows(u, v)
        trials, n = v.shape
        pull = np.broadcast_to(prior.own * np.eye(n), (trials, n, n))
        nothing = np.zeros((trials, n, len(u)))
        return cls(
            u,
            v,
            ArrowRows(
                np.hstack([found.residual, prior.own * (v - prior.v)]),
                np.concatenate([found.shared, nothing], axis=1),
                np.concatenate([found.own, pull], axis=1),
            ),
            prior,
        )

    @property
    def pull(self) -> Array:
        """Residual of the prior of u (a,)."""
        return np.asarray(self.prior.shared * (self.u - self.prior.u))

    @property
    def cost(self) -> float:
        return float(np.sum(self.rows.residual**2) + np.sum(self.pull**2)) / 2

    @property
    def gradient(self) -> tuple[Array, Array]:
        on_u = np.einsum("twa,tw->a", self.rows.shared, self.rows.residual)
        on_v = np.einsum("twn,tw->tn", self.rows.own, self.rows.residual)
        return on_u + self.prior.shared * self.pull, on_v

    @property
    def slope(self) -> float:
        return float(max(np.max(np.abs(part), initial=0.0) for part in self.gradient))

    def promised(self, du: Array, dv: Array) -> float:
        """What the linear model says that a step gains."""
        moved = self.rows.shared @ du + np.einsum("twn,tn->tw", self.rows.own, dv)
        on_u, on_v = self.gradient
        bent = float(np.sum(moved**2) + np.sum((self.prior.shared * du) ** 2)) / 2
        return -bent - float(on_u @ du + np.sum(on_v * dv))

    def step(self, radius: float, alpha: float) -> tuple[Array, Array, float]:
        """The best step of the linear model within a radius, and its multiplier."""
        gradient, low = _norm(*self.gradient), 0.0
        factor = _factor(self, 0.0)
        if factor.full_rank:
            du, dv, size, falls = factor.solved()
            if size <= radius:
                return du, dv, 0.0
            low = (size - radius) / falls
        high = gradient / radius
        if not factor.full_rank and alpha == 0:
            alpha = max(0.001 * high, np.sqrt(low * high))
        for _ in range(_TRIES):
            if not low <= alpha <= high:
                alpha = max(0.001 * high, float(np.sqrt(low * high)))
            du, dv, size, falls = _factor(self, alpha).solved()
            over, used = size - radius, alpha
            if over < 0:
                high = alpha
            low = max(low, alpha + over / falls)
            alpha += (over + radius) * over / falls / radius
            if abs(over) < _NEAR * radius:
                break
        share = min(1.0, radius / size)
        return share * du, share * dv, used


@dataclass(frozen=True)
class _Factor:
    """Triangle of the rows with sqrt(alpha) I below them: that of each v_i, then that of u."""

    own: Array  # (trials, n, n)
    beside: Array  # (trials, n, a)
    own_side: Array  # (trials, n)
    last: Array  # (a, a)
    last_side: Array  # (a,)

    @property
    def full_rank(self) -> bool:
        sizes = np.concatenate(
            [np.abs(np.einsum("tii->ti", self.own)).ravel(), np.abs(np.diag(self.last))]
        )
        return bool(np.min(sizes) > np.finfo(np.float64).eps * sizes.size * np.max(sizes))

    def solved(self) -> tuple[Array, Array, float, float]:
        """The step, its norm, and how fast the norm falls with alpha."""
        du: Array = np.asarray(-np.linalg.solve(self.last, self.last_side), dtype=np.float64)
        side = self.own_side + self.beside @ du
        step = -np.linalg.solve(self.own, side[..., None])[..., 0]
        dv: Array = np.asarray(step, dtype=np.float64)
        size = _norm(du, dv)
        if size == 0:
            return du, dv, size, 1.0
        back_v: Any = np.linalg.solve(np.swapaxes(self.own, 1, 2), dv[..., None])[..., 0]
        rest = du - np.einsum("tna,tn->a", self.beside, back_v)
        back_u: Any = np.linalg.solve(self.last.T, rest)
        return du, dv, size, _norm(back_u, back_v) ** 2 / size


def _factor(here: _Here, alpha: float) -> _Factor:
    trials, n = here.v.shape
    a, root = len(here.u), np.sqrt(alpha)
    table = np.concatenate([here.rows.own, here.rows.shared, here.rows.residual[..., None]], axis=2)
    damped = np.zeros((trials, max(n, n + a + 1 - table.shape[1]), n + a + 1))
    damped[:, :n, :n] = root * np.eye(n)
    upper: Any = np.linalg.qr(np.concatenate([table, damped], axis=1), mode="r")
    below = [upper[:, n:, n:].reshape(-1, a + 1)]
    below.append(np.hstack([np.diag(here.prior.shared), here.pull[:, None]]))
    below.append(np.hstack([root * np.eye(a), np.zeros((a, 1))]))
    last: Any = np.linalg.qr(np.concatenate(below), mode="r")
    return _Factor(
        upper[:, :n, :n], upper[:, :n, n : n + a], upper[:, :n, -1], last[:a, :a], last[:a, -1]
    )


def _norm(u: Array, v: Array) -> float:
    return float(np.sqrt(np.sum(u**2) + np.sum(v**2)))


def _ratio(gained: float, promised: float) -> float:
    if promised > 0:
        return gained / promised
    return 1.0 if promised == gained == 0 else 0.0


def triangular_rows(columns: list[Array]) -> Array:
    """R (w, w) of a QR factorisation of `columns`, arrays (r, k) side by side, block by block.

    Norms and inner products of its columns are those of the given ones.

    Blocks of a few thousand rows stay in the processor's cache: a recording ten times as long
    takes ten times the time, not fifteen.

    Returns
    -------
    Array
        (w, w), w columns in all; of fewer rows where there are fewer.
    """
    width = sum(part.shape[1] for part in columns)
    triangle = np.zeros((0, width))
    for first in range(0, len(columns[0]), _BLOCK):
        block = np.hstack([part[first : first + _BLOCK] for part in columns])
        # "raw" copies the triangle alone, "r" all rows below it too.
        _, upper = scipy.linalg.qr(np.vstack([triangle, block]), mode="raw", check_finite=False)
        triangle = np.asarray(upper, dtype=np.float64)
    return triangle
