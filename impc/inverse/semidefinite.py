"""Linear programs over matrix inequalities (Boyd and Vandenberghe 2004, section 4.6).

They are handed to Clarabel as they are.

    minimise  c'y  subject to  every  b_i - A_i y  in its cone

cvxpy would read better, but needs 4 to 9 ms to write down what Clarabel solves in 0.2 ms for two
states, and 0.8 s to be imported.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import clarabel
import numpy as np
import scipy.sparse

from impc.arrays import Array
from impc.errors import SolverError

if TYPE_CHECKING:
    from collections.abc import Callable


@dataclass(frozen=True)
class Cone:
    """right - rows @ y lies in a cone of Clarabel's."""

    rows: Array  # (r, k)
    right: Array  # (r,)
    kind: Any  # Clarabel's object for the cone


@dataclass(frozen=True)
class SemidefiniteSolution:
    """What Clarabel returned."""

    y: Array  # The variables (k,), finite
    # Clarabel's word. It may say that a point good to 1e-12 is almost solved: judge by the
    # residuals of what is built from ``y``.
    status: str
    prove: Callable[[], float]  # Computes `bound`, which takes a fifth of the time of the program

    @cached_property
    def bound(self) -> float:
        """What no feasible point is below.

        With `reach`, proved: no feasible point within it is lower, the solver's residuals and
        rounding counted. Without, the dual objective as it is: wrong by as much as residuals times
        variables, which was 1e-3 of the value where variables were 2e4 and residuals 1e-8.
        """
        return self.prove()


def matrix_inequality(constant: Array, basis: Array) -> Cone:
    """constant + sum y_i basis_i >= 0, for symmetric `constant` (d, d) and `basis` (k, d, d)."""
    kind = clarabel.PSDTriangleConeT(len(constant))
    return Cone(-_triangle(basis).T, _triangle(constant[None])[0], kind)


def norm_bound(
    vectors: Array, bound: Array, *, offset: Array | None = None, constant: float = 0.0
) -> Cone:
    """||offset + sum y_i vectors_i|| <= constant + bound @ y."""
    rows = -np.vstack([bound, vectors.T])
    right = np.concatenate([[constant], np.zeros(len(rows) - 1) if offset is None else offset])
    return Cone(rows, right, clarabel.SecondOrderConeT(len(rows)))


def solve_semidefinite(
    objective: Array,
    cones: list[Cone],
    *,
    squares: Array | None = None,
    reach: Array | None = None,
    scaled: bool = False,
    tolerance: float = 1e-11,
) -> SemidefiniteSolution:
    """Minimise objective @ y + squares @ y^2 over the cones."""
    (found,) = solve_each(
        objective[None], cones, squares=squares, reach=reach, scaled=scaled, tolerance=tolerance
    )
    return found


def solve_each(
    objectives: Array,
    cones: list[Cone],
    *,
    squares: Array | None = None,
    reach: Array | None = None,
    scaled: bool = False,
    tolerance: float = 1e-11,
) -> list[SemidefiniteSolution]:
    """Minimise each of some objectives over the same cones, written down once."""
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    # Without Clarabel's own scaling and without refining each linear system a program takes half of
    # the time on the seat. Over 200 random plants ends at 1e-10 lay about as near to their proved
    # bounds as with both, at a tenth of what 1e-8 had left; of 14 ends on the seat the worst is
    # 2e-5 of itself from the best found.
    own_scaling = reach is None and not scaled
    settings.equilibrate_enable = settings.iterative_refinement_enable = own_scaling
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    count = objectives.shape[1]
    quadratic = (count, count) if squares is None else np.diag(2 * squares)
    program = (
        scipy.sparse.csc_matrix(np.vstack([cone.rows for cone in cones])),
        np.concatenate([cone.right for cone in cones]),
        [cone.kind for cone in cones],
        settings,
    )
    ended = _solved(scipy.sparse.csc_matrix(quadratic), objectives, *program)
    return [
        _solution(found, objective, cones, reach)
        for found, objective in zip(ended, objectives, strict=True)
    ]


def _solution(
    found: Any, objective: Array, cones: list[Cone], reach: Array | None
) -> SemidefiniteSolution:
    y = np.asarray(found.x, dtype=np.float64)
    if not np.all(np.isfinite(y)):
        raise SolverError("semidefinite program", f"Clarabel: {found.status}", "scale the states")

    def prove() -> float:
        if reach is None:
            return float(found.obj_val_dual)
        return _proved_bound(objective, cones, np.asarray(found.z, dtype=np.float64), reach)

    return SemidefiniteSolution(y, str(found.status), prove)


def _solved(quadratic: Any, objectives: Array, *program: Any) -> list[Any]:
    """Clarabel's solution for each objective."""
    try:
        solver, ended = clarabel.DefaultSolver(quadratic, objectives[0], *program), []
        for objective in objectives:
            solver.update(q=objective)
            ended.append(solver.solve())
        return ended
    except BaseException as error:
        # Of Rust: no Exception, and of a class that cannot be imported. Two fits of 1176 met it, at
        # eigenvalues that LAPACK did not find.
        if type(error).__name__ != "PanicException":
            raise
        reason = f"Clarabel: {error}"
        raise SolverError("semidefinite program", reason, "scale the states") from None


def _proved_bound(objective: Array, cones: list[Cone], dual: Array, reach: Array) -> float:
    """A lower bound of c'y over |y_i| <= reach_i in the cones, from any dual point.

    With z in the dual cones and r = c + A'z,  c'y = r'y - b'z + z'(b - Ay) >= -b'z - |r|'reach.
    z is projected into the cones; then r, which the solver leaves at 1e-8, is taken away by
    Z -> Z + ZWZ, which keeps Z >= 0 while it is small. Each such bound holds; the best is returned.
    """
    if not np.all(np.isfinite(dual)):
        return -np.inf
    rows = np.vstack([cone.rows for cone in cones])
    right = np.concatenate([cone.right for cone in cones])
    ends = np.cumsum([len(cone.right) for cone in cones])[:-1]
    size = float(np.linalg.norm(np.abs(right) + np.abs(rows) @ reach))
    bound = -np.inf
    for last in (False, False, True):
        parts = [
            _projected(part, cone) for part, cone in zip(np.split(dual, ends), cones, strict=True)
        ]
        dual = np.concatenate(parts)
        left = objective + rows.T @ dual
        # Sums of this many terms, and eigenvalues of the projection that rounding makes negative.
        rounding = 4 * len(dual) * np.finfo(float).eps * float(np.linalg.norm(dual)) * size
        bound = max(bound, float(-right @ dual - np.abs(left) @ reach) - rounding)
        if last:
            break
        images = np.vstack(
            [_sandwiched(part, cone) for part, cone in zip(parts, cones, strict=True)]
        )
        dual = dual - images @ np.linalg.lstsq(rows.T @ images, left)[0]
    return bound


def _projected(part: Array, cone: Cone) -> Array:
    """The nearest point of the cone, which is its own dual."""
    if not _is_matrix(cone):
        length = float(np.linalg.norm(part[1:]))
        head = max(float(part[0]), 0.0)
        return np.append(head, part[1:] * min(1.0, head / max(length, 1e-300)))
    values, vectors = np.linalg.eigh(_matrices(part[None])[0])
    return np.asarray(_triangle(((vectors * np.maximum(values, 0.0)) @ vectors.T)[None])[0])


def _sandwiched(part: Array, cone: Cone) -> Array:
    """Z A_i Z of each column of a matrix cone, as columns; zero in the others, which stay."""
    if not _is_matrix(cone):
        return np.zeros_like(cone.rows)
    Z = _matrices(part[None])[0]
    return np.asarray(_triangle(Z @ _matrices(cone.rows.T) @ Z).T)


def _is_matrix(cone: Cone) -> bool:
    return isinstance(cone.kind, clarabel.PSDTriangleConeT)


def _matrices(triangles: Array) -> Array:
    """Inverse of `_triangle`: symmetric matrices (k, d, d) of rows (k, d(d+1)/2)."""
    d = int(np.sqrt(2 * triangles.shape[1]))
    rows, columns = np.tril_indices(d)
    stack = np.zeros((len(triangles), d, d))
    stack[:, columns, rows] = np.where(rows == columns, 1.0, np.sqrt(0.5)) * triangles
    stack[:, rows, columns] = stack[:, columns, rows]
    return stack


def _triangle(stack: Array) -> Array:
    """Upper triangles by columns, off-diagonals times sqrt(2): Clarabel's order."""
    rows, columns = np.tril_indices(stack.shape[-1])
    return np.asarray(np.where(rows == columns, 1.0, np.sqrt(2.0)) * stack[:, columns, rows])
