"""The controller (3.1) as a dense quadratic program in u, written without the package.

It condenses the cost and the bounds in the inputs themselves (not in v = u + Kx) with numpy, and
solves with Clarabel, so that it shares neither formulas nor solvers with what it checks.
"""

from __future__ import annotations

import clarabel
import numpy as np
import scipy.linalg
import scipy.sparse

Matrix = np.ndarray


def first_input(
    A: Matrix,
    B: Matrix,
    Q: Matrix,
    R: Matrix,
    horizon: int,
    x: Matrix,
    u_max: float,
    x_max: float = np.inf,
    terminal: tuple[Matrix, Matrix] | None = None,
    targets: tuple[Matrix, Matrix] | None = None,
    drift: Matrix | None = None,
    P: Matrix | None = None,
    softening: float | None = None,
) -> Matrix:
    """The first input of (3.1), P from scipy's Riccati solver or given; |u|, |x| <= u_max, x_max.

    The cost is that of the distance from targets of states (N + 1, n) and inputs (N, m), or from 0;
    `drift` (n,) is added to every next state. With `softening` a slack s of a state or terminal row
    g <= b costs softening u_max^2 s / b, beside half of the cost in which the first input, all
    later ones optimal, weighs m in trace.
    """
    n, m = B.shape
    P = scipy.linalg.solve_discrete_are(A, B, Q, R) if P is None else P
    powers = [np.linalg.matrix_power(A, k) for k in range(horizon + 1)]
    phi = np.vstack(powers)
    gamma = np.zeros(((horizon + 1) * n, horizon * m))
    for k in range(1, horizon + 1):
        for i in range(k):
            gamma[k * n : (k + 1) * n, i * m : (i + 1) * m] = powers[k - 1 - i] @ B
    weight = scipy.linalg.block_diag(*[Q] * horizon, P)
    free = phi @ x
    for k in range(1, horizon + 1 if drift is not None else 0):
        free[k * n :] += np.vstack(powers[: horizon + 1 - k]) @ drift
    H = gamma.T @ weight @ gamma + np.kron(np.eye(horizon), R)
    f = gamma.T @ weight @ free
    if targets is not None:
        f -= gamma.T @ weight @ targets[0].ravel() + (targets[1] @ R).ravel()
    rows = [np.eye(horizon * m), -np.eye(horizon * m)]
    limits = [np.full(2 * horizon * m, u_max)]
    if np.isfinite(x_max):
        inside = slice(n, horizon * n)
        rows += [gamma[inside], -gamma[inside]]
        limits += [x_max - free[inside], x_max + free[inside]]
    if terminal is not None:
        rows.append(terminal[0] @ gamma[-n:])
        limits.append(terminal[1] - terminal[0] @ free[-n:])
    G, h = np.vstack(rows), np.concatenate(limits)
    if softening is not None:
        own = terminal[1] if terminal else np.zeros(0)
        count, sides = len(h) - 2 * horizon * m, np.zeros(len(h) - 2 * horizon * m)
        sides[: count - len(own)], sides[count - len(own) :] = x_max, own
        later = np.linalg.solve(H[m:, m:], H[m:, :m]) if horizon > 1 else np.zeros((0, m))
        scale = m / np.trace(H[:m, :m] - H[:m, m:] @ later)
        H, f = scipy.linalg.block_diag(scale * H, np.zeros((count, count))), scale * f
        f = np.append(f, softening * u_max**2 / sides)
        slack = np.vstack([np.zeros((2 * horizon * m, count)), -np.eye(count)])
        G = np.block([[G, slack], [np.zeros((count, horizon * m)), -np.eye(count)]])
        h = np.append(h, np.zeros(count))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-12
    scale = np.max(np.abs(H))
    solution = clarabel.DefaultSolver(
        scipy.sparse.csc_matrix(np.triu((H + H.T) / 2 / scale)),
        f / scale,
        scipy.sparse.csc_matrix(G),
        h,
        [clarabel.NonnegativeConeT(len(h))],
        settings,
    ).solve()
    active = np.array(solution.z) > np.array(solution.s)
    return _polished(H / scale, f / scale, G[active], h[active])[:m]


def _polished(H: Matrix, f: Matrix, G: Matrix, h: Matrix) -> Matrix:
    """The minimiser on the active rows: an interior-point answer is good to its tolerance only."""
    count, rows = len(f), len(h)
    system = np.block([[(H + H.T) / 2, G.T], [G, np.zeros((rows, rows))]])
    solution = np.linalg.lstsq(system, np.concatenate([-f, h]), rcond=1e-13)[0]
    return np.asarray(solution[:count])
