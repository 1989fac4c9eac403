"""The controller (3.1) as a quadratic program in u with a hundred digits, without the package.

    minimise over u_0 .. u_{N-1}    x_N'P x_N / 2 + sum_k (x_k'Q x_k + u_k'R u_k) / 2
    subject to    u_min <= u_k <= u_max,    E x_k <= b (k < N),    H x_N <= h

from (Q, R, P), P by Newton's iteration on the Riccati equation. `first_input` searches by Goldfarb
and Idnani's method (Math. Programming 27, 1983) from a guess, and proves what it found in the
plainest recursions: x_k forward and the multipliers backward give every Karush-Kuhn-Tucker
condition; where there is no answer, they give the best that inputs within their bounds can do
against the multipliers of excluded rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal, getcontext
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg

Exact = Any  # an array of Decimal: numpy has no type for it
getcontext().prec = 100  # numbers grow by 2^60, their squares by 1e36
ZERO: Any = Decimal(0)
#: Zero, relative to what it is the difference of: rounding of a hundred digits is below 1e-60.
NOTHING = Decimal("1e-40")
#: A state on its bound was rounded there: what a row may be exceeded by, as a share of its bound.
ROUNDED = Decimal("1e-12")


def exact(values: Any) -> Exact:
    """The same numbers as decimals."""
    return np.vectorize(Decimal, otypes=[object])(np.asarray(values, dtype=float))


def zeros(*shape: int) -> Exact:
    """Zeros as decimals."""
    return np.full(shape, ZERO)


@dataclass(frozen=True)
class ExactProgram:
    """The program of a horizon.

    Its rows, in order: the inputs' upper bounds, stage by stage, then their lower bounds, the rows
    `E x_k <= b` for k = 0 .. N-1, and `H x_N <= h`.
    """

    A: np.ndarray
    B: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    horizon: int
    u_min: np.ndarray
    u_max: np.ndarray
    stage: tuple[np.ndarray, np.ndarray] | None = None
    terminal: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def width(self) -> int:
        """Number of unknowns N m."""
        return self.horizon * len(self.u_max)

    @cached_property
    def matrices(self) -> tuple[Exact, Exact, Exact, Exact]:
        """A, B, Q, R."""
        return exact(self.A), exact(self.B), exact(self.Q), exact(self.R)

    @cached_property
    def P(self) -> Exact:
        """The terminal weight (n, n)."""
        return _riccati(self.A, self.B, self.Q, self.R)

    @cached_property
    def rows(self) -> tuple[np.ndarray, Exact, Exact]:
        """Stage (r,), normal (r, n) and right side (r,) of the rows of states."""
        n = self.A.shape[0]
        stages, normals, sides = [np.zeros(0, dtype=int)], [np.zeros((0, n))], [np.zeros(0)]
        for k in range(self.horizon + 1):
            given = self.stage if k < self.horizon else self.terminal
            if given is not None:
                stages.append(np.full(len(given[1]), k))
                normals.append(given[0])
                sides.append(given[1])
        return np.concatenate(stages), exact(np.concatenate(normals)), exact(np.concatenate(sides))

    @cached_property
    def sides(self) -> Exact:
        """Right side of every row (2 N m + r,)."""
        upper, lower = (np.tile(exact(side), self.horizon) for side in (self.u_max, -self.u_min))
        return np.concatenate([upper, lower, self.rows[2]])

    @cached_property
    def dense(self) -> tuple[Exact, Exact]:
        """Inverse of the Hessian (N m, N m), and the rows (2 N m + r, N m), of the inputs alone."""
        origin, nothing = zeros(len(self.A)), zeros(len(self.sides))
        hessian, rows = [], []
        for unit in exact(np.eye(self.width)).reshape(-1, self.horizon, len(self.u_max)):
            plan = self.states(origin, unit)
            hessian.append(self.pull(plan, unit, nothing).ravel())
            rows.append(self.heights(plan, unit))
        return solve(np.array(hessian), exact(np.eye(self.width))), np.array(rows).T

    def states(self, x: Exact, u: Exact) -> Exact:
        """States (N + 1, n) from the first on, with inputs (N, m)."""
        A, B, _, _ = self.matrices
        found = [x]
        for k in range(self.horizon):
            found.append(A @ found[-1] + B @ u[k])
        return np.array(found)

    def heights(self, x: Exact, u: Exact) -> Exact:
        """Left side of every row (2 N m + r,)."""
        stage, normal, _ = self.rows
        return np.concatenate([u.ravel(), -u.ravel(), (normal * x[stage]).sum(axis=1)])

    def pull(self, x: Exact, u: Exact, cost_weight: Exact) -> Exact:
        """Derivative of the Lagrangian by the inputs (N, m), with the rows' multipliers."""
        A, B, Q, R = self.matrices
        p = self.P @ x[-1]
        found = self.push(cost_weight)
        found += (cost_weight[: self.width] - cost_weight[self.width : 2 * self.width]).reshape(
            u.shape
        )
        for k in range(self.horizon - 1, -1, -1):
            found[k] += R @ u[k] + p @ B
            p = Q @ x[k] + p @ A
        return found

    def push(self, cost_weight: Exact) -> Exact:
        """Derivative by the inputs (N, m) of the rows of states, weighted by their multipliers."""
        A, B, _, _ = self.matrices
        stage, normal, _ = self.rows
        pushed = zeros(self.horizon + 1, len(A))
        for row in np.flatnonzero(cost_weight[2 * self.width :]):
            pushed[stage[row]] += cost_weight[2 * self.width + row] * normal[row]
        p, found = pushed[-1], zeros(self.horizon, B.shape[1])
        for k in range(self.horizon - 1, -1, -1):
            found[k] = p @ B
            p = pushed[k] + p @ A
        return found

    def is_optimal(self, x: Exact, u: Exact, cost_weight: Exact, kept: Decimal) -> bool:
        """Karush, Kuhn and Tucker, of the program whose rows are moved by less than `kept`.

        What the derivative g misses of zero moves u by |g| / min eig(R) at most.
        """
        plan = self.states(x, u)
        excess, room = self.heights(plan, u) - self.sides, kept * self.sides
        reach = np.min(self.sides[: 2 * self.width]) * Decimal(np.linalg.eigvalsh(self.R)[0])
        return bool(
            np.all(cost_weight >= 0)
            and np.all(excess <= room)
            and np.all(abs(excess[cost_weight > 0]) <= room[cost_weight > 0])
            and np.max(abs(self.pull(plan, u, cost_weight))) <= Decimal("1e-15") * reach
        )

    def is_excluded(self, x: Exact, cost_weight: Exact) -> bool:
        """Whether no inputs in their bounds bring the penalised sum of rows of states to zero."""
        still = zeros(self.horizon, len(self.u_max))
        excess = (self.heights(self.states(x, still), still) - self.sides)[2 * self.width :]
        push = self.push(cost_weight)
        least = np.minimum(push * exact(self.u_max), push * exact(self.u_min)).sum()
        return bool(np.all(cost_weight >= 0) and cost_weight[2 * self.width :] @ excess + least > 0)


def solve(matrix: Exact, right: Exact) -> Exact:
    """Elimination with a symmetric positive definite matrix."""
    matrix, right = matrix.copy(), right.copy()
    count = len(matrix)
    for i in range(count):
        share = matrix[i + 1 :, i] / matrix[i, i]
        matrix[i + 1 :, i + 1 :] -= np.outer(share, matrix[i, i + 1 :])
        right[i + 1 :] -= np.multiply.outer(share, right[i])
    for i in range(count - 1, -1, -1):
        if i + 1 < count:
            right[i] = right[i] - matrix[i, i + 1 :] @ right[i + 1 :]
        right[i] = right[i] / matrix[i, i]
    return right


def _riccati(A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray) -> Exact:
    """P to forty digits: each step of Newton's doubles them, a Lyapunov sum by doubling each."""
    a, b, q, r = exact(A), exact(B), exact(Q), exact(R)
    P = exact(scipy.linalg.solve_discrete_are(A, B, Q, R))
    for _ in range(4):
        K = solve(r + b.T @ P @ b, b.T @ P @ a)
        power, P = a - b @ K, q + K.T @ r @ K
        while max(abs(power).ravel()) > Decimal("1e-45"):
            P = P + power.T @ P @ power
            power = power @ power
    return P


def first_input(
    program: ExactProgram, x: np.ndarray, guess: np.ndarray, kept: Decimal = ROUNDED
) -> np.ndarray | None:
    """The proved first input at a state (n,); None when it is proved that there is none."""
    start = exact(x)
    search = _Search(program, start, np.flatnonzero(guess).tolist())
    if search.run(kept):
        u = search.inputs.reshape(program.horizon, -1)
        if not program.is_optimal(start, u, search.cost_weight, kept):
            raise ArithmeticError("the plan is not proved")
        return np.array([float(value) for value in u[0]])
    if not program.is_excluded(start, search.cost_weight):
        raise ArithmeticError("the rows are not proved to exclude each other")
    return None


class _Search:
    """Multipliers stay positive while the rows become kept, one after the other."""

    def __init__(self, program: ExactProgram, x: Exact, guess: list[int]) -> None:
        self.program, (self.inverse, self.rows) = program, program.dense
        self.cost_weight = zeros(len(program.sides))
        still = zeros(program.horizon, len(program.u_max))
        plan = program.states(x, still)
        self.slope = program.pull(plan, still, self.cost_weight).ravel()
        self.sides = program.sides - program.heights(plan, still)
        self.active = [guess[place] for place in _independent(self._gram(guess))]
        while self.active:
            excess = self._excess()[self.active]
            values = solve(self._gram(self.active), excess)
            if np.all(values >= 0):
                self.cost_weight[self.active] = values
                break
            pairs = zip(self.active, values, strict=True)
            self.active = [row for row, value in pairs if value >= 0]

    @property
    def inputs(self) -> Exact:
        """The best inputs (N m,) with these multipliers."""
        return -(self.inverse @ (self.slope + self.cost_weight @ self.rows))

    def run(self, kept: Decimal) -> bool:
        """Whether there is a plan; if not, the multipliers are those of rows without one."""
        for _ in range(10 * len(self.sides)):
            broken = self._excess() / self.program.sides - kept
            broken[self.active] = ZERO
            row = int(np.argmax(broken))
            if broken[row] <= 0:
                return True
            if not self._enter(row):
                return False
        raise ArithmeticError("no end of the search")

    def _enter(self, row: int) -> bool:
        """Raise the multiplier of a broken row until it is tight; false where nothing stops it."""
        response = self.inverse @ self.rows[row]
        while True:
            across = self.rows[self.active] @ response
            fall = solve(self._gram(self.active), across)
            alone = self.rows[row] @ response
            gain = alone - across @ fall
            steps = [self.cost_weight[one] / down if down > NOTHING else None
                     for one, down in zip(self.active, fall, strict=True)]  # fmt: skip
            ends = [step for step in steps if step is not None]
            if gain > NOTHING * alone:
                ends.append(self._excess()[row] / gain)
            elif not ends:
                self.cost_weight[:] = ZERO
                self.cost_weight[self.active] = np.maximum(-fall, ZERO)
                self.cost_weight[row] = Decimal(1)
                return False
            step = min(ends)
            self.cost_weight[self.active] -= step * fall
            self.cost_weight[row] += step
            if step not in steps:
                self.active.append(row)
                return True
            left = self.active.pop(steps.index(step))
            self.cost_weight[left] = ZERO

    def _excess(self) -> Exact:
        return self.rows @ self.inputs - self.sides

    def _gram(self, rows: list[int]) -> Exact:
        return self.rows[rows] @ self.inverse @ self.rows[rows].T


def _independent(gram: Exact) -> list[int]:
    """Which rows of a positive semidefinite matrix do not depend on those before them."""
    left, found = gram.copy(), []
    for i in range(len(gram)):
        if left[i, i] > NOTHING * gram[i, i]:
            found.append(i)
            left[i + 1 :, i + 1 :] -= np.outer(left[i + 1 :, i] / left[i, i], left[i, i + 1 :])
    return found
