"""The controller (3.1) as a dense quadratic program in u with eighty digits, without the package.

Condensed with the open plant from (Q, R, P), P from Newton's iteration on the Riccati equation. An
active set is guessed, the program on it solved by elimination, and the answer accepted when all of
the Karush-Kuhn-Tucker conditions hold: then it is *the* answer, wherever the guess came from.
"""

from __future__ import annotations

from decimal import Decimal, getcontext
from typing import Any

import numpy as np
import scipy.linalg

Exact = Any  # an array of Decimal: numpy has no type for it
getcontext().prec = 80  # numbers grow by 2^60, their squares by 1e36
_ZERO: Any = Decimal(0)
_KEPT = Decimal("1e-12")  # a state on its bound was rounded there: share of the bound


def exact(values: Any) -> Exact:
    """The same numbers as decimals."""
    return np.vectorize(Decimal, otypes=[object])(np.asarray(values, dtype=float))


class ExactProgram:
    """The condensed program of a horizon; rows are the inputs' upper and lower bounds, then others.

    `E x_k <= b` holds for k = 0 .. N-1, `H x_N <= h` at the end.
    """

    def __init__(
        self,
        A: np.ndarray,
        B: np.ndarray,
        Q: np.ndarray,
        R: np.ndarray,
        horizon: int,
        u_min: np.ndarray,
        u_max: np.ndarray,
        stage: tuple[np.ndarray, np.ndarray] | None = None,
        terminal: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> None:
        a, b, q, r = exact(A), exact(B), exact(Q), exact(R)
        n, m = b.shape
        self.m, width = m, horizon * m
        P = _riccati(A, B, Q, R)
        phi, gamma = [exact(np.eye(n))], [exact(np.zeros((n, width)))]
        for k in range(horizon):
            moved = a @ gamma[k]
            moved[:, k * m : (k + 1) * m] += b
            phi.append(a @ phi[k])
            gamma.append(moved)
        self.H = np.kron(exact(np.eye(horizon)), r)
        self.f = exact(np.zeros((width, n)))
        for k in range(horizon + 1):
            reached = slice(0, k * m)  # later inputs do not act on x_k
            weighted = gamma[k][:, reached].T @ (q if k < horizon else P)
            self.H[reached, reached] += weighted @ gamma[k][:, reached]
            self.f[reached] += weighted @ phi[k]
        rows, free, right = [], [], []
        eye = exact(np.eye(width))
        for sign, side in ((1, u_max), (-1, u_min)):
            rows.append(sign * eye)
            free.append(exact(np.zeros((width, n))))
            right.append(np.tile(exact(sign * np.asarray(side)), horizon))
        general = [(k, *stage) for k in range(horizon)] if stage is not None else []
        if terminal is not None:
            general.append((horizon, *terminal))
        for k, E, bound in general:
            rows.append(exact(E) @ gamma[k])
            free.append(exact(E) @ phi[k])
            right.append(exact(bound))
        self.G, self.F, self.b = (np.concatenate(parts) for parts in (rows, free, right))

    def first_input(self, x: np.ndarray, guess: np.ndarray, tries: int = 30) -> np.ndarray | None:
        """The proved first input at a state (n,), or None when no guess is proved.

        `guess` are the rows that are thought to be active, (r,) of bool.
        """
        f, room = self.f @ exact(x), self.b - self.F @ exact(x)
        active = np.array(guess, dtype=bool)
        for attempt in range(tries):
            u, price = self._on(active, f, room)
            if u is None:
                return None
            excess = self.G @ u - room
            broken = excess > _KEPT * self.b
            wrong = active & (price < 0)
            if not np.any(broken) and not np.any(wrong):
                return np.array([float(value) for value in u[: self.m]])
            if attempt >= 5:  # all at once may go in circles
                worst = np.argmax(np.where(broken, excess / self.b, _ZERO))
                if np.any(broken):
                    broken = np.arange(len(active)) == worst
                    wrong = wrong & False
                else:
                    wrong = np.arange(len(active)) == np.argmin(np.where(wrong, price, _ZERO))
            active = (active & ~wrong) | broken
        return None

    def _on(self, active: np.ndarray, f: Exact, room: Exact) -> tuple[Exact | None, Exact]:
        """Minimiser with the given rows tight, and their multipliers."""
        width = len(f)
        upper, lower, other = active[:width], active[width : 2 * width], active[2 * width :]
        fixed = upper | lower
        u = np.where(upper, room[:width], np.where(lower, -room[width : 2 * width], _ZERO))
        loose, rows = np.flatnonzero(~fixed), 2 * width + np.flatnonzero(other)
        G = self.G[rows]
        price = np.full(len(self.b), _ZERO)
        held = np.flatnonzero(fixed)
        tight = room[rows] - G[:, held] @ u[held] if len(rows) else room[rows]
        push = f[loose] + self.H[np.ix_(loose, held)] @ u[held]
        if len(loose):
            # H_ll u + G_l' p = -push,  G_l u = tight
            right = np.concatenate([push[:, None], G[:, loose].T], axis=1)
            solved = _solve(self.H[np.ix_(loose, loose)], right)
            if len(rows):
                schur = G[:, loose] @ solved[:, 1:]
                try:
                    p = _solve(schur, -(tight + G[:, loose] @ solved[:, 0])[:, None])[:, 0]
                except ZeroDivisionError:
                    return None, price
                price[rows] = p
                u[loose] = -solved[:, 0] - solved[:, 1:] @ p
            else:
                u[loose] = -solved[:, 0]
        elif len(rows):
            return None, price
        pull = self.H @ u + f
        if len(rows):
            pull = pull + G.T @ price[rows]
        price[:width] = np.where(upper, -pull, _ZERO)
        price[width : 2 * width] = np.where(lower, pull, _ZERO)
        return u, price


def _solve(matrix: Exact, right: Exact) -> Exact:
    """Elimination with a symmetric positive definite matrix."""
    matrix, right = matrix.copy(), right.copy()
    count = len(matrix)
    for i in range(count):
        pivot = matrix[i, i]
        if pivot <= 0:
            raise ZeroDivisionError
        share = matrix[i + 1 :, i] / pivot
        matrix[i + 1 :, i + 1 :] -= np.outer(share, matrix[i, i + 1 :])
        right[i + 1 :] -= np.outer(share, right[i])
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
        K = _solve(r + b.T @ P @ b, b.T @ P @ a)
        power, P = a - b @ K, q + K.T @ r @ K
        while max(abs(power).ravel()) > Decimal("1e-45"):
            P = P + power.T @ P @ power
            power = power @ power
    return P
