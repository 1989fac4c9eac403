"""Checks for experiments and tests: Cholesky parameters of Eq. (3.6), terminal sets."""

from __future__ import annotations

import numpy as np

from impc.arrays import Array
from impc.control.halfspaces import seen_directions, supports
from impc.control.terminal_set import TerminalSet
from impc.model.weights import Weights, normalised


def cholesky_parameters(weights: Weights) -> Array:
    """Lower-triangular entries (k,) of the Cholesky factors of Q and R, row by row: Eq. (3.6).

    R is scaled to R[0, 0] = 1 and its first entry is omitted: k = n(n+1)/2 + m(m+1)/2 - 1.
    """
    scaled = normalised(weights)
    q_factor, r_factor = np.linalg.cholesky(scaled.Q), np.linalg.cholesky(scaled.R)
    q_entries = q_factor[np.tril_indices(len(q_factor))]
    r_entries = r_factor[np.tril_indices(len(r_factor))]
    return np.concatenate([q_entries, r_entries[1:]])


def weights_from_parameters(parameters: Array, n: int, m: int) -> Weights:
    """Inverse of `cholesky_parameters`: Q = LL' (n, n), R = GG' (m, m) with G[0, 0] = 1."""
    count = n * (n + 1) // 2
    q_factor, r_factor = np.zeros((n, n)), np.zeros((m, m))
    q_factor[np.tril_indices(n)] = parameters[:count]
    r_factor[np.tril_indices(m)] = np.concatenate([[1.0], parameters[count:]])
    return Weights(q_factor @ q_factor.T, r_factor @ r_factor.T)


def invariance_violation(terminal: TerminalSet) -> float:
    """Largest support of H F x over the set, minus h, over h.

    At most about the tolerance if the set is invariant; capped at 1; 0 for a set without rows.
    Together with `maximality_violation` it certifies the set: it is invariant and inside the
    bounds, hence within O, and bounded by rows of O only, hence not smaller.
    """
    normal = terminal.H / terminal.h[:, None]
    return _excess(terminal, normal @ terminal.F)


def maximality_violation(terminal: TerminalSet) -> float:
    """Difference of the set from O_k*, relative to the bounds; capped at 1.

    The larger of two numbers. First, the relative distance of the rows from rows (c, k) recomputed
    by powers of F: every trajectory that keeps the bounds satisfies these, so the set is not too
    small. Second, the largest violation over the set of any removed row (c, k <= k*): the set is
    not too large.
    """
    rows, count = terminal.rows, terminal.determinedness + 1
    normal = (rows.E - rows.F @ terminal.gain) / rows.b[:, None]
    powers = np.array([np.linalg.matrix_power(terminal.F, k) for k in range(count)])
    every = normal @ powers
    afresh = every[terminal.step, terminal.family]
    given = terminal.H / terminal.h[:, None]
    basis = seen_directions(np.concatenate([given, afresh]))
    error = np.linalg.norm((given - afresh) @ basis, axis=1)
    wrong = float(np.max(error / np.linalg.norm(afresh @ basis, axis=1), initial=0.0))
    removed = np.ones(every.shape[:2], dtype=bool)
    removed[terminal.step, terminal.family] = False
    return max(wrong, _excess(terminal, every[removed]))


def _excess(terminal: TerminalSet, targets: Array) -> float:
    """Largest support of the normalised target rows (t, n) over the set, minus 1."""
    if not np.any(targets):
        return 0.0
    normal = terminal.H / terminal.h[:, None]
    basis = seen_directions(np.concatenate([normal, targets]))
    return float(np.max(supports(normal @ basis, targets @ basis)[0])) - 1.0
