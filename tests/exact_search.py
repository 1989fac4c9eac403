"""How the answer of an `ExactProgram` is found: Goldfarb and Idnani's method from a guess.

Multipliers stay positive while the rows become kept, one after the other (Math. Programming 27,
1983). The programs on the way, with the active rows as equalities, are solved by a Riccati
recursion over the inputs that are free; the rows of states enter by their multipliers, for which
the responses of the plan to each of them are tightened together. All in a hundred digits.
"""

from __future__ import annotations

from decimal import Decimal
from functools import cached_property
from typing import NamedTuple

import numpy as np

from tests.exact_mpc import NOTHING, ROUNDED, ZERO, Exact, ExactProgram, exact, solve, zeros


def first_input(
    program: ExactProgram, x: np.ndarray, guess: np.ndarray, kept: Decimal = ROUNDED
) -> np.ndarray | None:
    """The proved first input at a state (n,); None when it is proved that there is none."""
    start = exact(x)
    u, cost_weight = _Search(program, start, np.array(guess, dtype=bool)).run(kept)
    if u is None:
        if not program.is_excluded(start, cost_weight):
            raise ArithmeticError("the rows are not proved to exclude each other")
        return None
    if not program.is_optimal(start, u, cost_weight, kept):
        raise ArithmeticError("the plan is not proved")
    return np.array([float(value) for value in u[0]])


class _Plan(NamedTuple):
    """Inputs (N, m), states (N + 1, n) and multipliers (2 N m + r,), or how they change."""

    u: Exact
    x: Exact
    cost_weight: Exact

    def moved(self, length: Decimal, by: _Plan) -> _Plan:
        return _Plan(*(one + length * other for one, other in zip(self, by, strict=True)))


class _Search:
    def __init__(self, program: ExactProgram, x: Exact, guess: np.ndarray) -> None:
        self.program, self.active = program, guess
        self.system = _Equalities(program, guess)
        self.active[self.system.dependent] = False
        while True:
            self.plan = self.system.answer(x)
            wrong = self.active & (self.plan.cost_weight < 0)
            if not np.any(wrong):
                break
            self._set(wrong, False)

    def run(self, kept: Decimal) -> tuple[Exact | None, Exact]:
        """The inputs (N, m) and the multipliers; None and those of rows that exclude each other."""
        sides = self.program.sides
        for _ in range(10 * len(sides)):
            excess = self.program.heights(self.plan.x, self.plan.u) - sides
            broken = np.where(self.active, ZERO, excess / sides - kept)
            row = int(np.argmax(broken))
            if broken[row] <= 0:
                return self.plan.u, self.plan.cost_weight
            excluded = self._enter(row)
            if excluded is not None:
                return None, excluded
        raise ArithmeticError("no end of the search")

    @cached_property
    def loose(self) -> _Equalities:
        """The program without its rows."""
        return _Equalities(self.program, np.zeros_like(self.active))

    def _enter(self, row: int) -> Exact | None:
        """Raise the multiplier of a broken row until it is tight; None, or what excludes it."""
        least = NOTHING * self._gain(row, self.loose.answer_to(row))
        while True:
            change = self.system.answer_to(row)
            gain = self._gain(row, change)
            height = self.program.heights(self.plan.x, self.plan.u)[row]
            full = (height - self.program.sides[row]) / gain if gain > least else None
            falls = self.active & (change.cost_weight < -NOTHING * np.max(change.cost_weight))
            ends = np.flatnonzero(falls)
            if full is None and not len(ends):
                return np.where(change.cost_weight > 0, change.cost_weight, ZERO)
            lasts = self.plan.cost_weight[ends] / -change.cost_weight[ends]
            if full is not None and not np.any(lasts < full):
                self.plan = self.plan.moved(full, change)
                self._set(row, True)
                return None
            first = int(np.argmin(lasts))
            self.plan = self.plan.moved(lasts[first], change)
            self.plan.cost_weight[ends[first]] = ZERO
            self._set(ends[first], False)

    def _gain(self, row: int, change: _Plan) -> Decimal:
        """What a unit of a row's multiplier takes from its height."""
        found: Decimal = -self.program.heights(change.x, change.u)[row]
        return found

    def _set(self, rows: int | np.ndarray, active: bool) -> None:
        self.active[rows] = active
        self.system = _Equalities(self.program, self.active, self.system)


class _Equalities:
    """The program with its active rows as equalities; V_k(x) = x'P_k x / 2 + s_k'x + const."""

    def __init__(
        self, program: ExactProgram, active: np.ndarray, last: _Equalities | None = None
    ) -> None:
        N, m, width = program.horizon, len(program.u_max), program.width
        self.program = program
        upper, lower = active[: 2 * width].reshape(2, N, m).copy()
        self.upper, self.lower, self.free = upper, lower, ~(upper | lower)
        self.P: list[Exact] = [program.P]
        self.gain: list[Exact] = []
        self.inverse: list[Exact] = []
        self.responses: dict[int, tuple[Exact, Exact]] = {}
        if last is not None and np.array_equal(self.free, last.free):
            self.P, self.gain, self.inverse = last.P, last.gain, last.inverse
            self.responses = last.responses
        else:
            self._recur()
        self.factor: list[Exact] = []
        self.tight: list[int] = []
        self.dependent: list[int] = []
        self._factor(np.flatnonzero(active[2 * width :]))

    def answer(self, x: Exact) -> _Plan:
        """The plan from a state."""
        u_max, u_min = exact(self.program.u_max), exact(self.program.u_min)
        fixed = np.where(self.upper, u_max, np.where(self.lower, u_min, ZERO))
        cost_weight = zeros(len(self.program.sides))
        return self._tightened(self._plan(x, fixed), cost_weight, self.program.rows[2])

    def answer_to(self, row: int) -> _Plan:
        """Change of the plan with the multiplier of a row that is not active."""
        cost_weight = zeros(len(self.program.sides))
        cost_weight[row] = Decimal(1)
        return self._tightened(self._response(row), cost_weight, zeros(len(self.program.rows[2])))

    def _recur(self) -> None:
        A, B, Q, R = self.program.matrices
        P = self.program.P
        for k in range(self.program.horizon - 1, -1, -1):
            free = self.free[k]
            moved = P @ A
            b = B[:, free]
            inverse = solve(R[np.ix_(free, free)] + b.T @ P @ b, exact(np.eye(b.shape[1])))
            gain = inverse @ (b.T @ moved)
            P = Q + A.T @ moved - (moved.T @ b) @ gain
            P = (P + P.T) / 2
            self.P.insert(0, P)
            self.gain.insert(0, gain)
            self.inverse.insert(0, inverse)

    def _plan(
        self, x: Exact, fixed: Exact, on_x: Exact | None = None, on_u: Exact | None = None
    ) -> tuple[Exact, Exact]:
        """Inputs and states with linear weights on states (N + 1, n) and inputs (N, m) added."""
        A, B, _, R = self.program.matrices
        N = self.program.horizon
        on_x = zeros(N + 1, len(A)) if on_x is None else on_x
        on_u = zeros(*fixed.shape) if on_u is None else on_u
        s, offsets = on_x[N], [ZERO] * N
        for k in range(N - 1, -1, -1):
            free = self.free[k]
            ahead = s + self.P[k + 1] @ (B @ fixed[k])
            push = B[:, free].T @ ahead + R[free] @ fixed[k] + on_u[k, free]
            offsets[k] = self.inverse[k] @ push
            s = A.T @ ahead - self.gain[k].T @ push + on_x[k]
        u, states = fixed.copy(), [x]
        for k in range(N):
            u[k, self.free[k]] = -(self.gain[k] @ states[k]) - offsets[k]
            states.append(A @ states[k] + B @ u[k])
        return u, np.array(states)

    def _response(self, row: int) -> tuple[Exact, Exact]:
        """Change of inputs and states with the multiplier of a row, tight rows of states loose."""
        if row not in self.responses:
            program, width = self.program, self.program.width
            stage, normal, _ = program.rows
            N, m, n = program.horizon, len(program.u_max), len(program.A)
            on_u, on_x = zeros(N, m), zeros(N + 1, n)
            if row < 2 * width:
                on_u.ravel()[row % width] = Decimal(1 if row < width else -1)
            else:
                on_x[stage[row - 2 * width]] = normal[row - 2 * width]
            self.responses[row] = self._plan(zeros(n), zeros(N, m), on_x, on_u)
        found: tuple[Exact, Exact] = self.responses[row]
        return found

    def _factor(self, rows: np.ndarray) -> None:
        """Cholesky's factor of what tight rows of states gain from each other; none depends."""
        stage, normal, _ = self.program.rows
        for row in rows:
            at = [*self.tight, int(row)]
            _, x = self._response(2 * self.program.width + row)
            line = -(normal[at] * x[stage[at]]).sum(axis=1)
            for i, earlier in enumerate(self.factor):
                line[i] = (line[i] - line[:i] @ earlier[:i]) / earlier[i]
            whole = line[-1]
            line[-1] = whole - line[:-1] @ line[:-1]
            if line[-1] > NOTHING * whole:
                line[-1] = line[-1].sqrt()
                self.factor.append(line)
                self.tight.append(int(row))
            else:
                self.dependent.append(int(2 * self.program.width + row))

    def _tightened(self, plan: tuple[Exact, Exact], cost_weight: Exact, sides: Exact) -> _Plan:
        """The plan brought onto the tight rows of states, with the multipliers of all rows."""
        (u, x), width = plan, self.program.width
        stage, normal, _ = self.program.rows
        tight = self.tight
        p = (normal[tight] * x[stage[tight]]).sum(axis=1) - sides[tight]
        for i, line in enumerate(self.factor):
            p[i] = (p[i] - line[:i] @ p[:i]) / line[i]
        for i in range(len(p) - 1, -1, -1):
            p[i] = p[i] / self.factor[i][i]
            p[:i] = p[:i] - self.factor[i][:i] * p[i]
        for value, row in zip(p, tight, strict=True):
            moved, reached = self._response(2 * width + row)
            u, x = u + value * moved, x + value * reached
            cost_weight[2 * width + row] += value
        pull = self.program.pull(x, u, cost_weight).ravel()
        cost_weight[:width] += np.where(self.upper.ravel(), -pull, ZERO)
        cost_weight[width : 2 * width] += np.where(self.lower.ravel(), pull, ZERO)
        return _Plan(u, x, cost_weight)
