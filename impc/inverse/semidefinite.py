"""Linear programs with matrix inequalities (Boyd and Vandenberghe 2004, section 4.6).

    minimise  c'y  subject to  every  b_i - A_i y  in its cone

Passed to Clarabel directly: cvxpy needs 4 to 9 ms to build what Clarabel solves in 0.2 ms.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import clarabel
import numpy as np
import scipy.sparse

from impc.arrays import Array
from impc.errors import SolverError

# Error of bounds, in units of the relative residuals of a program with an objective of norm 1.
_UNSURE = 10.0


@dataclass(frozen=True)
class Cone:
    """Constraint: right - rows @ y lies in a Clarabel cone."""

    rows: Array  # (r, k)
    right: Array  # (r,)
    kind: Any  # Clarabel cone object


@dataclass(frozen=True)
class SemidefiniteSolution:
    """Solution returned by Clarabel."""

    y: Array  # The variables (k,), finite
    # Status of Clarabel. It can be "almost solved" for a point good to 1e-12: rely on residuals of
    # what is built from ``y``.
    status: str
    prove: Callable[[], float]  # computes `bound` on request, at a fifth of the solution time

    @cached_property
    def bound(self) -> float:
        """Lower bound of the objective over all feasible points.

        With `reach` it is proved for feasible points within it, including solver residuals and
        rounding. Otherwise it is the dual objective of the solver, wrong by about residuals times
        variables.
        """
        return self.prove()


def matrix_inequality(constant: Array, basis: Array) -> Cone:
    """constant + sum y_i basis_i >= 0, for symmetric `constant` (d, d) and `basis` (k, d, d)."""
    kind = clarabel.PSDTriangleConeT(len(constant))
    return Cone(-_triangle(basis).T, _triangle(constant[None])[0], kind)


def norm_bound(
    vectors: Array, bound: Array, *, offset: Array | None = None, constant: float = 0.0
) -> Cone:
    """Constraint ||offset + sum y_i vectors_i|| <= constant + bound @ y."""
    rows = -np.vstack([bound, vectors.T])
    right = np.concatenate([[constant], np.zeros(len(rows) - 1) if offset is None else offset])
    return Cone(rows, right, clarabel.SecondOrderConeT(len(rows)))


def solve_semidefinite(
    objective: Array,
    cones: list[Cone],
    *,
    squares: Array | None = None,
    reach: Array | None = None,
    tolerance: float = 1e-11,
) -> SemidefiniteSolution:
    """Minimise objective @ y + squares @ y^2 over the cones."""
    (found,) = solve_each(objective[None], cones, squares=squares, reach=reach, tolerance=tolerance)
    return found


def solve_each(
    objectives: Array,
    cones: list[Cone],
    *,
    squares: Array | None = None,
    reach: Array | None = None,
    tolerance: float = 1e-11,
    above: Array | None = None,
) -> list[SemidefiniteSolution]:
    """Minimise several objectives over the same cones, built once.

    With `above`, one number for each, a program ends once it is clear whether its minimum is above.
    """
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    # Clarabel's own scaling and iterative refinement double the time on the seat and improve
    # little: without them solutions come as close to their proved bounds (200 random plants,
    # tolerance 1e-10).
    own_scaling = reach is None
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
    ended = _solved(scipy.sparse.csc_matrix(quadratic), objectives, above, *program)
    return [
        _solution(found, objective, cones, reach)
        for found, objective in zip(ended, objectives, strict=True)
    ]


def _solution(
    found: Any, objective: Array, cones: list[Cone], reach: Array | None
) -> SemidefiniteSolution:
    y = np.asarray(found.x, dtype=np.float64)
    if not np.all(np.isfinite(y)):
        raise SolverError(
            "semidefinite program",
            f"Clarabel stopped: {found.status}",
            "rescale the states (use other units)",
        )

    def prove() -> float:
        if reach is None:
            return float(found.obj_val_dual)
        return _proved_bound(objective, cones, np.asarray(found.z, dtype=np.float64), reach)

    return SemidefiniteSolution(y, str(found.status), prove)


def _solved(quadratic: Any, objectives: Array, above: Array | None, *program: Any) -> list[Any]:
    """Clarabel's solution for each objective."""
    try:
        solver, ended = clarabel.DefaultSolver(quadratic, objectives[0], *program), []
        for index, objective in enumerate(objectives):
            solver.update(q=objective)
            if above is not None:
                solver.set_termination_callback(functools.partial(_decided, float(above[index])))
            ended.append(solver.solve())
        return ended
    except BaseException as error:
        # A Rust panic is no Exception and its class cannot be imported (2 of 1176 fits).
        if type(error).__name__ != "PanicException":
            raise
        reason = f"Clarabel: {error}"
        raise SolverError(
            "semidefinite program", reason, "rescale the states (use other units)"
        ) from None


def _decided(level: float, progress: Any) -> bool:
    """Whether both bounds are on one side of a level, beyond the residuals of the program."""
    unsure = _UNSURE * max(progress.res_primal, progress.res_dual)
    return bool(progress.cost_dual - unsure > level or progress.cost_primal + unsure < level)


def _proved_bound(objective: Array, cones: list[Cone], dual: Array, reach: Array) -> float:
    """Lower bound of c'y over |y_i| <= reach_i in the cones, from any dual point.

    With z in the dual cones and r = c + A'z,  c'y = r'y - b'z + z'(b - Ay) >= -b'z - |r|'reach.
    z is projected into the cones; then r (1e-8 at the solver's solution) is reduced by
    Z -> Z + ZWZ, which keeps Z >= 0 while it is small. The best of these valid bounds is returned.
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
        # Rounding: sums of this many terms, and negative eigenvalues of the projection.
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
    """Nearest point of the (self-dual) cone."""
    if not _is_matrix(cone):
        length = float(np.linalg.norm(part[1:]))
        head = max(float(part[0]), 0.0)
        return np.append(head, part[1:] * min(1.0, head / max(length, 1e-300)))
    values, vectors = np.linalg.eigh(_matrices(part[None])[0])
    return np.asarray(_triangle(((vectors * np.maximum(values, 0.0)) @ vectors.T)[None])[0])


def _sandwiched(part: Array, cone: Cone) -> Array:
    """Z A_i Z for each column of a matrix cone, as columns; zero for other cones."""
    if not _is_matrix(cone):
        return np.zeros_like(cone.rows)
    Z = _matrices(part[None])[0]
    return np.asarray(_triangle(Z @ _matrices(cone.rows.T) @ Z).T)


def _is_matrix(cone: Cone) -> bool:
    return isinstance(cone.kind, clarabel.PSDTriangleConeT)


def _matrices(triangles: Array) -> Array:
    """Symmetric matrices (k, d, d) of rows (k, d(d+1)/2); inverse of `_triangle`."""
    d = int(np.sqrt(2 * triangles.shape[1]))
    rows, columns = np.tril_indices(d)
    stack = np.zeros((len(triangles), d, d))
    stack[:, columns, rows] = np.where(rows == columns, 1.0, np.sqrt(0.5)) * triangles
    stack[:, rows, columns] = stack[:, columns, rows]
    return stack


def _triangle(stack: Array) -> Array:
    """Upper triangles by columns, off-diagonals times sqrt(2), as Clarabel orders them."""
    rows, columns = np.tril_indices(stack.shape[-1])
    return np.asarray(np.where(rows == columns, 1.0, np.sqrt(2.0)) * stack[:, columns, rows])
