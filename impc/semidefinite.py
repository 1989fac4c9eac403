"""Linear programs over matrix inequalities (Boyd and Vandenberghe 2004, section 4.6).

They are handed to Clarabel as they are.

    minimise  c'y  subject to  every  b_i - A_i y  in its cone

cvxpy would read better, but needs 4 to 9 ms to write down what Clarabel solves in 0.2 ms for two
states, and 0.8 s to be imported.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import clarabel
import numpy as np
import scipy.sparse

from impc.arrays import Array
from impc.errors import SolverError

__all__ = [
    "Cone",
    "SemidefiniteSolution",
    "matrix_inequality",
    "norm_bound",
    "solve_semidefinite",
]


@dataclass(frozen=True)
class Cone:
    """right - rows @ y lies in a cone of Clarabel's.

    Attributes
    ----------
    rows : Array
        (r, k).
    right : Array
        (r,).
    kind : Any
        Clarabel's object for the cone.
    """

    rows: Array
    right: Array
    kind: Any


@dataclass(frozen=True)
class SemidefiniteSolution:
    """What Clarabel returned.

    Attributes
    ----------
    y : Array
        The variables (k,), finite.
    bound : float
        Dual objective: no feasible point is lower, up to the solver's own residual.
    status : str
        Clarabel's word. It may say that a point good to 1e-12 is almost solved: judge by the
        residuals of what is built from ``y``.
    """

    y: Array
    bound: float
    status: str


def matrix_inequality(constant: Array, basis: Array) -> Cone:
    """constant + sum y_i basis_i >= 0, for symmetric `constant` (d, d) and `basis` (k, d, d)."""
    kind = clarabel.PSDTriangleConeT(len(constant))
    return Cone(-_triangle(basis).T, _triangle(constant[None])[0], kind)


def norm_bound(
    vectors: Array, bound: Array, *, offset: Array | None = None, constant: float = 0.0
) -> Cone:
    """||offset + sum y_i vectors_i|| <= constant + bound @ y.

    Parameters
    ----------
    vectors : Array
        (k, r), one a row.
    bound : Array
        (k,).
    offset : Array, optional
        (r,); zero by default.
    constant : float
        Zero by default.
    """
    rows = -np.vstack([bound, vectors.T])
    right = np.concatenate([[constant], np.zeros(len(rows) - 1) if offset is None else offset])
    return Cone(rows, right, clarabel.SecondOrderConeT(len(rows)))


def solve_semidefinite(
    objective: Array,
    cones: list[Cone],
    *,
    squares: Array | None = None,
    tolerance: float = 1e-11,
) -> SemidefiniteSolution:
    """Minimise objective @ y + squares @ y^2 over the cones.

    Parameters
    ----------
    objective : Array
        (k,).
    cones : list of Cone
        All of them hold.
    squares : Array, optional
        (k,), not negative; zero by default.
    tolerance : float
        Clarabel's, on gap and feasibility. Its own default of 1e-8 would be the error of the
        weights.

    Raises
    ------
    SolverError
        When no finite point comes back.
    """
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    count = len(objective)
    quadratic = np.zeros((count, count)) if squares is None else np.diag(2 * squares)
    found = clarabel.DefaultSolver(
        scipy.sparse.csc_matrix(quadratic),
        objective,
        scipy.sparse.csc_matrix(np.vstack([cone.rows for cone in cones])),
        np.concatenate([cone.right for cone in cones]),
        [cone.kind for cone in cones],
        settings,
    ).solve()
    y = np.asarray(found.x, dtype=np.float64)
    if not np.all(np.isfinite(y)):
        raise SolverError("semidefinite program", f"Clarabel: {found.status}", "scale the states")
    return SemidefiniteSolution(y, float(found.obj_val_dual), str(found.status))


def _triangle(stack: Array) -> Array:
    """Upper triangles by columns, off-diagonals times sqrt(2): Clarabel's order."""
    rows, columns = np.tril_indices(stack.shape[-1])
    return np.asarray(np.where(rows == columns, 1.0, np.sqrt(2.0)) * stack[:, columns, rows])
