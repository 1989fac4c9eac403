"""The relaxed optimality conditions of a plan, stage by stage, and their sparse linear system.

With multipliers nu of the dynamics and lam of the rows, and slacks s,

    grad L = 0,    f(x_k, u_k) - x_{k+1} = 0,    h + s = 0,    s lam = mu,    s, lam > 0,
    L = e + lam_N' h_N + sum_k l + nu_k'(f - x_{k+1}) + lam_k' h

define x, u smoothly in theta and x_0 (Fiacco 1976). Eliminating ds and dlam leaves

    [H + G'SG   J'] [dz ]     [grad L + G'(S (h + s) + (mu - s lam) / s)]
    [J          0 ] [dnu] = - [c                                        ],     S = lam / s,

which is banded in the order u_0, nu_0, x_1, u_1, nu_1, x_2 ...: one LU factorisation (LAPACK's
gbtrf) of 2n + m - 1 diagonals on either side serves Newton's step, every parameter and every x_0.
docs/nonlinear.md.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np
from scipy.linalg import lapack

from impc.arrays import Array, BoolArray, Frozen, IntArray

if TYPE_CHECKING:
    from impc.nonlinear.problem import OptimalControlProblem


@dataclass(frozen=True, eq=False)
class Point(Frozen):
    """States, inputs, multipliers and slacks."""

    x: Array  # (N + 1, n)
    u: Array  # (N, m)
    nu: Array  # Multipliers of the dynamics (N, n)
    lam: Array  # Multipliers and slacks of the rows (N, q)
    s: Array
    lam_end: Array  # Of those at the end (qN,)
    s_end: Array


class Conditions(NamedTuple):
    """Values and derivatives at a point; w = (x, u), sizes as in `Point`."""

    cost: float  # Of all stages and the end
    gradient: Array  # Of l + nu'f + lam'h by w (N, n + m)
    f: Array  # (N, n) and (N, q); rows that are not asked for have -1
    h: Array
    H: Array  # Second derivative (N, n + m, n + m), f_w (N, n, n + m) and h_w (N, q, n + m)
    F: Array
    G: Array
    gradient_end: Array  # The same at the end: (n,), (qN,), (n, n), (qN, n)
    h_end: Array
    H_end: Array
    G_end: Array


class System(NamedTuple):
    """A factorised system."""

    lu: Array  # Of gbtrf: (3 diagonals + 1, size) and (size,)
    pivots: Array
    bandwidth: int  # Diagonals on either side
    H: Array  # H + G'SG of each stage (N, n + m, n + m)
    H_end: Array  # The same at the end (n, n)
    regular: bool  # Whether no pivot is zero

    def solve(self, sides: Array) -> Array:
        """Solutions (size, k) for right sides (size, k)."""
        found, _ = lapack.dgbtrs(self.lu, self.bandwidth, self.bandwidth, sides, self.pivots)
        return np.asarray(found)


class _Compiled(NamedTuple):
    stage: Any
    stage_sides: Any
    end: Any
    end_sides: Any


@functools.lru_cache(maxsize=16)
def _compiled(problem: OptimalControlProblem) -> _Compiled:
    """Stage functions with derivatives; those of a stage are mapped over the horizon."""
    f, cost, e, h, h_end = problem.functions
    plain = all(item.is_a("SXFunction") for item in problem.functions)
    kind: Any = ca.SX if plain else ca.MX
    n, m, p = problem.n, problem.m, len(problem.parameter_names)
    q, q_end = len(problem.rows), len(problem.terminal_rows)
    w, d, theta = kind.sym("w", n + m), kind.sym("d", problem.disturbance_count), kind.sym("t", p)
    nu, lam, lam_end = kind.sym("nu", n), kind.sym("lam", q), kind.sym("lam_end", q_end)
    x, u = w[:n], w[n:]
    given = (x, u, d, theta)
    next_x, rows = f(*given), h(*given)
    lagrangian = cost(*given) + ca.dot(nu, next_x) + ca.dot(lam, rows)
    H, gradient = ca.hessian(lagrangian, w)
    dense = ca.densify
    inputs = [w, d, theta, nu, lam]
    stage = ca.Function("stage", inputs, [
        cost(*given), dense(gradient), dense(next_x), dense(rows),
        dense(H), dense(ca.jacobian(next_x, w)), dense(ca.jacobian(rows, w)),
    ])  # fmt: skip
    sides = ca.Function("stage_sides", inputs, [
        dense(ca.jacobian(item, theta)) for item in (gradient, next_x, rows)
    ])  # fmt: skip
    last = kind.sym("last", n)
    at_end = (last, kind.zeros(m), kind.zeros(problem.disturbance_count), theta)
    rows_end = h_end(*at_end)
    H_end, gradient_end = ca.hessian(e(*at_end) + ca.dot(lam_end, rows_end), last)
    inputs_end = [last, theta, lam_end]
    end = ca.Function("end", inputs_end, [
        e(*at_end), dense(gradient_end), dense(rows_end), dense(H_end),
        dense(ca.jacobian(rows_end, last)),
    ])  # fmt: skip
    end_sides = ca.Function("end_sides", inputs_end, [
        dense(ca.jacobian(item, theta)) for item in (gradient_end, rows_end)
    ])  # fmt: skip
    N = problem.horizon
    return _Compiled(stage.map(N), sides.map(N), end, end_sides)


@functools.lru_cache(maxsize=16)
def wanted_rows(problem: OptimalControlProblem) -> BoolArray:
    """Which rows are asked for (N, q): at k = 0 those that an input moves."""
    found = np.ones((problem.horizon, len(problem.rows)), dtype=bool)
    found[0] = problem.movable
    return found


def _arguments(
    problem: OptimalControlProblem, theta: Array, d: Array, point: Point
) -> tuple[Any, ...]:
    w = np.hstack([point.x[:-1], point.u]).T
    return w, d.T, np.repeat(theta[:, None], problem.horizon, axis=1), point.nu.T, point.lam.T


def _stacks(values: Any, horizon: int) -> list[Array]:
    """(rows, N columns) -> (N, rows, columns) of each."""
    return [item.full().reshape(item.shape[0], horizon, -1).transpose(1, 0, 2)
            if item.shape[0] else np.zeros((horizon, 0, item.shape[1] // horizon))
            for item in values]  # fmt: skip


def conditions(problem: OptimalControlProblem, theta: Array, d: Array, point: Point) -> Conditions:
    """Evaluate at parameters theta (p,) and disturbances d (N, d) that the plan reckons with."""
    made, N = _compiled(problem), problem.horizon
    cost, gradient, f, h, H, F, G = _stacks(made.stage(*_arguments(problem, theta, d, point)), N)
    end = made.end(point.x[-1], theta, point.lam_end)
    e, gradient_end, h_end, H_end, G_end = (item.full() for item in end)
    rows = np.where(wanted_rows(problem), h[:, :, 0], -1.0)
    return Conditions(
        float(cost.sum() + e.sum()), gradient[:, :, 0], f[:, :, 0], rows, H, F, G,
        gradient_end.ravel(), h_end.ravel(), H_end, G_end.reshape(-1, problem.n),
    )  # fmt: skip


class Residuals(NamedTuple):
    """What is left of each condition, in the order of the module's text."""

    u: Array  # Gradient by u_k (N, m) and by x_{k+1} (N, n)
    x: Array
    c: Array  # Dynamics (N, n)
    rows: Array  # h + s: (N, q), (qN,)
    rows_end: Array
    products: Array  # s lam - mu: (N, q), (qN,)
    products_end: Array


def residuals(problem: OptimalControlProblem, point: Point, at: Conditions, mu: float) -> Residuals:
    """The relaxed conditions of `at`, evaluated at the point, for the product mu."""
    n = problem.n
    by_x = np.vstack([at.gradient[1:, :n], at.gradient_end[None]]) - point.nu
    return Residuals(
        at.gradient[:, n:],
        by_x,
        at.f - point.x[1:],
        at.h + point.s,
        at.h_end + point.s_end,
        point.s * point.lam - mu * wanted_rows(problem),
        point.s_end * point.lam_end - mu,
    )


@functools.lru_cache(maxsize=16)
def _places(N: int, n: int, m: int) -> tuple[int, IntArray, IntArray]:
    """Diagonals, and where the entries of the blocks stand in LAPACK's band storage.

    Entries of the N blocks (m + 2n square), then those left of them, then those above.
    """
    band, size = 2 * n + m - 1, m + 2 * n
    k = np.arange(N)[:, None, None] * size
    i, j = np.arange(size)[:, None], np.arange(size)
    main = np.broadcast_arrays(k + i, k + j)
    coupled = np.broadcast_arrays(
        k[1:] + np.arange(m + n)[:, None], k[1:] - n + np.arange(n)
    )  # u_k and nu_k with x_k
    rows = np.concatenate([main[0].ravel(), coupled[0].ravel(), coupled[1].ravel()])
    columns = np.concatenate([main[1].ravel(), coupled[1].ravel(), coupled[0].ravel()])
    return band, 2 * band + rows - columns, columns


def system(problem: OptimalControlProblem, point: Point, at: Conditions) -> System:
    """Assemble and factorise the banded system at a point."""
    N, n, m = problem.horizon, problem.n, problem.m
    weight, weight_end = point.lam / point.s, point.lam_end / point.s_end
    H = at.H + np.einsum("kqi,kq,kqj->kij", at.G, weight, at.G)
    H_end = at.H_end + (at.G_end.T * weight_end) @ at.G_end
    blocks = np.zeros((N, m + 2 * n, m + 2 * n))
    blocks[:, :m, :m] = H[:, n:, n:]
    blocks[:, m : m + n, :m] = at.F[:, :, n:]
    blocks[:, :m, m : m + n] = at.F[:, :, n:].transpose(0, 2, 1)
    one = np.eye(n)
    blocks[:, m : m + n, m + n :] = -one
    blocks[:, m + n :, m : m + n] = -one
    blocks[:-1, m + n :, m + n :] = H[1:, :n, :n]
    blocks[-1, m + n :, m + n :] = H_end
    coupled = np.concatenate([H[1:, n:, :n], at.F[1:, :, :n]], axis=1)
    band, rows, columns = _places(N, n, m)
    values = np.concatenate([blocks.ravel(), coupled.ravel(), coupled.ravel()])
    matrix = np.zeros((3 * band + 1, N * (m + 2 * n)))
    matrix[rows, columns] = values
    lu, pivots, info = lapack.dgbtrf(matrix, band, band)
    return System(lu, pivots, band, H, H_end, info == 0)


def parameter_sides(
    problem: OptimalControlProblem, theta: Array, d: Array, point: Point, more: int
) -> Residuals:
    """Derivatives of the conditions with respect to theta (p,), and zeros for `more` columns.

    Each has one more axis (..., p + more); d is (N, d).
    """
    made, p, n, N = _compiled(problem), len(theta), problem.n, problem.horizon
    stage = made.stage_sides(*_arguments(problem, theta, d, point))
    gradient, f, h = _stacks(stage, N)
    end = made.end_sides(point.x[-1], theta, point.lam_end)
    gradient_end, h_end = (item.full().reshape(-1, p) for item in end)
    h = h * wanted_rows(problem)[:, :, None]
    by_x = np.concatenate([gradient[1:, :n], gradient_end[None]])
    parts = (gradient[:, n:], by_x, f, h, h_end, np.zeros_like(h), np.zeros_like(h_end))
    return Residuals(*(
        np.concatenate([part, np.zeros((*part.shape[:-1], more))], axis=-1) for part in parts
    ))  # fmt: skip


def solve_conditions(
    problem: OptimalControlProblem,
    point: Point,
    at: Conditions,
    factors: System,
    sides: Residuals,
    first: Array,
    refinements: int = 0,
) -> Point:
    """Steps that take away the residuals `sides`, to first order; c of them beside each other.

    `sides` (..., c); `first` (n, c); returns (..., c).
    """
    found = _reduced(problem, point, at, factors, sides, first)
    for _ in range(refinements):
        left = _left(problem, point, at, sides, found)
        more = _reduced(problem, point, at, factors, left, np.zeros_like(first))
        found = Point(*(a + b for a, b in zip(vars(found).values(), vars(more).values(),
                                              strict=True)))  # fmt: skip
    return found


def _reduced(
    problem: OptimalControlProblem,
    point: Point,
    at: Conditions,
    factors: System,
    sides: Residuals,
    first: Array,
) -> Point:
    n, m, N = problem.n, problem.m, problem.horizon
    columns = first.shape[1]
    lam, s = point.lam[:, :, None], point.s[:, :, None]
    lam_end, s_end = point.lam_end[:, None], point.s_end[:, None]
    by_w = at.G.transpose(0, 2, 1) @ ((lam * sides.rows - sides.products) / s)
    by_end = at.G_end.T @ ((lam_end * sides.rows_end - sides.products_end) / s_end)
    right = np.concatenate([
        sides.u + by_w[:, n:], sides.c, sides.x + np.concatenate([by_w[1:, :n], by_end[None]]),
    ], axis=1)  # fmt: skip
    right[0, :m] += factors.H[0, n:, :n] @ first
    right[0, m : m + n] += at.F[0, :, :n] @ first
    found = factors.solve(-right.reshape(-1, columns)).reshape(N, m + 2 * n, columns)
    x, u = np.concatenate([first[None], found[:, m + n :]]), found[:, :m]
    ds = -sides.rows - at.G @ np.concatenate([x[:-1], u], axis=1)
    ds = ds * wanted_rows(problem)[:, :, None]
    ds_end = -sides.rows_end - at.G_end @ x[-1]
    dlam, dlam_end = (
        (-sides.products - lam * ds) / s,
        (-sides.products_end - lam_end * ds_end) / s_end,
    )
    return Point(x, u, found[:, m : m + n], dlam, ds, dlam_end, ds_end)


def _left(
    problem: OptimalControlProblem, point: Point, at: Conditions, sides: Residuals, step: Point
) -> Residuals:
    """The residuals after a step, by the equations themselves and not by the reduced ones."""
    n = problem.n
    w = np.concatenate([step.x[:-1], step.u], axis=1)
    by_w = at.H @ w + at.F.transpose(0, 2, 1) @ step.nu + at.G.transpose(0, 2, 1) @ step.lam
    by_end = at.H_end @ step.x[-1] + at.G_end.T @ step.lam_end
    wanted = wanted_rows(problem)[:, :, None]
    return Residuals(
        sides.u + by_w[:, n:],
        sides.x + np.concatenate([by_w[1:, :n], by_end[None]]) - step.nu,
        sides.c + at.F @ w - step.x[1:],
        (sides.rows + at.G @ w) * wanted + step.s,
        sides.rows_end + at.G_end @ step.x[-1] + step.s_end,
        sides.products + point.lam[:, :, None] * step.s + point.s[:, :, None] * step.lam,
        sides.products_end
        + point.lam_end[:, None] * step.s_end
        + point.s_end[:, None] * step.lam_end,
    )
