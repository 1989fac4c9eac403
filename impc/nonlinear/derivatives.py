"""Exact derivatives of a plan, with respect to every parameter and the initial state at once.

Differentiating the relaxed conditions of docs/nonlinear.md gives, with S = lam / s,

    [H + G'SG   J'] [dz ]     [L_zp + G'S g_p]
    [J          0 ] [dnu] = - [c_p           ],      ds = -(G dz + g_p),    dlam = -S ds,

the system that Newton's method has factorised, with a right side for every parameter. As mu falls
to zero S selects the active rows by itself. A row whose slack and multiplier are of one size is
neither: the plan has a kink there, and what is returned lies between its two slopes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen
from impc.nonlinear.conditions import (
    Point,
    conditions,
    parameter_sides,
    solve_conditions,
    system,
)

if TYPE_CHECKING:
    from impc.nonlinear.plan import Plan

# Multiplier over slack: at mu = 1e-10 an active row with a multiplier of one has 1e10, an inactive
# one with a slack of one 1e-10.
_WEAK = (1e-3, 1e3)
# Singular value of active rows along the dynamics, relative to the largest, below which they are
# dependent: a row given twice has 1e-17.
_DEPENDENT = 1e-10
_REFINEMENTS = 2


@dataclass(frozen=True, eq=False)
class PlanDerivatives(Frozen):
    """With respect to theta and x_0: the last axis has p + n entries."""

    x: Array  # (N + 1, n, p + n)
    u: Array  # (N, m, p + n)
    nu: Array  # (N, n, p + n)
    lam: Array  # (N, q, p + n)
    s: Array
    lam_end: Array  # (qN, p + n)
    s_end: Array

    def step(self, change: Array) -> Point:
        """The first-order change of the plan when theta and x_0 change by (p + n,)."""
        return Point(*(item @ change for item in vars(self).values()))


def differentiate_plan(plan: Plan) -> PlanDerivatives:
    """Derivatives of all that a plan consists of; the system of a plan is regular."""
    problem, point = plan.problem, plan.point
    n, p = problem.n, len(plan.theta)
    at = conditions(problem, plan.theta, plan.d, point)
    sides = parameter_sides(problem, plan.theta, plan.d, point, n)
    first = np.hstack([np.zeros((n, p)), np.eye(n)])
    factors = system(problem, point, at)
    found = solve_conditions(problem, point, at, factors, sides, first, _REFINEMENTS)
    return PlanDerivatives(*vars(found).values())


def weakly_active_rows(plan: Plan) -> tuple[tuple[str, int], ...]:
    """Name and sample of the rows where the derivative is between two slopes."""
    low, high = _WEAK
    ratio, last = plan.point.lam / plan.point.s, plan.point.lam_end / plan.point.s_end
    weak = (ratio > low) & (ratio < high)
    found = [(plan.problem.rows[int(j)], int(k)) for k, j in np.argwhere(weak)]
    ends = np.flatnonzero((last > low) & (last < high))
    return (*found, *((plan.problem.terminal_rows[int(j)], plan.problem.horizon) for j in ends))


def dependent_rows(plan: Plan) -> tuple[tuple[str, int], ...]:
    """Name and sample of active rows that do not move apart: their multipliers are not told.

    The plan and its derivative are what they are; only the multipliers are not unique.
    """
    problem, point = plan.problem, plan.point
    n, m, N = problem.n, problem.m, problem.horizon
    at = conditions(problem, plan.theta, plan.d, point)
    moves = np.zeros((n, N * m))  # of x_k by all inputs
    rows, labels = [], []
    for k in range(N + 1):
        if k == N:
            G, active, names = at.G_end, point.lam_end > point.s_end, problem.terminal_rows
            slopes = G @ moves
        else:
            G, active, names = at.G[k], point.lam[k] > point.s[k], problem.rows
            here = np.zeros((m, N * m))
            here[:, k * m : (k + 1) * m] = np.eye(m)
            slopes = G @ np.vstack([moves, here])
            moves = at.F[k] @ np.vstack([moves, here])
        for j in np.flatnonzero(active):
            rows.append(slopes[j] / max(float(np.linalg.norm(slopes[j])), 1e-300))
            labels.append((names[int(j)], k))
    if not rows:
        return ()
    left, values, _ = np.linalg.svd(np.array(rows))
    rank = int(np.count_nonzero(values > _DEPENDENT * values[0]))
    involved = np.max(np.abs(left[:, rank:]), axis=1, initial=0.0) > 1e-6
    return tuple(label for label, yes in zip(labels, involved, strict=True) if yes)
