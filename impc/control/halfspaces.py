"""Geometry of sets {z : Z z <= 1}: supports by linear programming, redundant rows, corners.

The support of a row d is max d z over the set (Gilbert and Tan 1991), with d z capped at twice the
bound so that the program is bounded. Its dual,

    min r'mu   subject to   Z'mu = d,  mu >= 0      (r = 1, and 2 for the capped row d itself),

always has a solution and only as many equations as z has entries, so that its simplex bases are
small. A basis that was optimal for a nearby set is tried first: it determines z and mu, and if both
are feasible they are optimal by duality.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import csc_array
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from impc.arrays import Array, BoolArray, IntArray
from impc.errors import InputError, SolverError

# A direction that the normalised rows see less than this, relative to the best seen one, counts as
# unbounded: rounding (2e-16) would move the set along it by more than 1e-6 of its size.
_UNSEEN = 1e-10
# Rows whose support is this far below their bound do not touch the set and can be removed
# together; others may duplicate each other and are removed one by one. Also the margin by which a
# ray must show that a row is needed.
_TOUCHING = 1e-6
# Programs per call of HiGHS: the seat's set takes 55 ms with 12, 129 with 1, 58 with 64.
_BATCH = 12
#: Largest number of steps of the simplex method, in rows and columns of the program: HiGHS can
#: cycle for ever. At most 0.6 were needed for 100 random plants.
PIVOTS = 5
# Feasibility tolerance of the programs (the smallest of HiGHS) and of a basis that is tried first.
_FEASIBLE = 1e-10


def seen_directions(rows: Array) -> Array:
    """Coordinates x = T z, T (n, q), in which the rows (..., n) are orthonormal columns.

    The set is then round up to the square root of the number of rows, as HiGHS requires: it drops
    entries below 1e-9. Directions that no row sees are left out.
    """
    stack = rows.reshape(-1, rows.shape[-1])
    scale = np.max(np.abs(stack), axis=0, initial=0.0)
    scale[scale == 0] = 1.0
    _, singular, right = np.linalg.svd(stack / scale, full_matrices=False)
    seen = singular > _UNSEEN * np.max(singular, initial=0.0)
    return np.asarray((right[seen] / scale).T / singular[seen])


def supports(
    Z: Array, targets: Array, own: IntArray | None = None, hints: IntArray | None = None
) -> tuple[Array, IntArray]:
    """Support of each target row d over {z : Z z <= 1, d z <= 2}, with its optimal basis."""
    count, q = targets.shape
    values, bases = np.zeros(count), np.full((count, q), -1)
    for start in range(0, count, _BATCH):
        part = np.arange(start, min(start + _BATCH, count))
        system, limits = _systems(Z, targets[part], None if own is None else own[part])
        if hints is not None:
            known, values[part] = _verified(system, limits, targets[part], hints[part])
            bases[part[known]] = hints[part[known]]
            part, system, limits = part[~known], system[~known], limits[~known]
        if len(part):
            values[part], corners = _solve(system, limits, targets[part])
            bases[part] = _bases(system, limits, corners)
    return values, bases


def redundant_rows(
    new: Array, Z: Array, tolerance: float, hints: IntArray | None
) -> tuple[BoolArray, IntArray]:
    """Whether each row of new (c, q) exceeds 1 by at most the tolerance where Z z <= 1.

    A row that the ray along itself meets inside the set is needed; no program is solved for it.
    `Z` (s, q); `hints` (c, q); returns (c,), (c, q).
    """
    reach = np.max(Z @ new.T, axis=0, initial=0.0)  # t * new leaves the set at t = 1 / reach
    inside = np.sum(new**2, axis=1) > (1 + tolerance + _TOUCHING) * reach
    redundant, bases = np.zeros(len(new), dtype=bool), np.full(new.shape, -1)
    start = hints[~inside] if hints is not None and hints.shape == new.shape else None
    support, bases[~inside] = supports(Z, new[~inside], hints=start)
    redundant[~inside] = support <= 1 + tolerance
    return redundant, bases


def needed_rows(
    Z: Array, mirrored: bool, tolerance: float, hints: IntArray | None = None
) -> tuple[IntArray, IntArray]:
    """Rows of Z z <= 1 (with -Z z <= 1 when mirrored) that do not follow from the others.

    Of rows that follow from one another the earlier is kept. A row is also needed if a ray from the
    origin clearly meets it before all others, which saves its program.
    `Z` (s, q); `hints` (s, q); returns (k,), (s, q).
    """
    kept, bases = np.arange(len(Z)), np.full(Z.shape, -1)
    doubtful = kept[~_first_hit(Z, mirrored, 1 + tolerance + _TOUCHING)]
    start = hints[doubtful] if hints is not None and hints.shape == Z.shape else None
    support, bases[doubtful] = supports(with_mirror(Z, mirrored), Z[doubtful], doubtful, start)
    kept = np.setdiff1d(kept, doubtful[support <= 1 - _TOUCHING])
    touching = doubtful[(support > 1 - _TOUCHING) & (support <= 1 + tolerance)]
    for i in touching[::-1]:
        rest = kept[kept != i]
        if supports(with_mirror(Z[rest], mirrored), Z[[i]])[0][0] <= 1 + tolerance:
            kept = rest
    return kept, bases


def with_mirror(Z: Array, mirrored: bool) -> Array:
    """Rows Z (s, q), when mirrored followed by their negatives, (2 * s, q)."""
    return np.concatenate([Z, -Z]) if mirrored else Z


def _systems(Z: Array, targets: Array, own: IntArray | None) -> tuple[Array, Array]:
    """Rows (t, s + 1, q) and right sides (t, s + 1) of each program.

    The last row is the capped target; if the target is a row of Z, that row is capped and the last
    one is empty.
    """
    count, size = len(targets), len(Z)
    system = np.empty((count, size + 1, Z.shape[1]))
    system[:, :size] = Z
    system[:, size] = targets if own is None else 0.0
    limits = np.ones((count, size + 1))
    limits[:, size] = 2.0
    if own is not None:
        limits[np.arange(count), own] = 2.0
    return system, limits


def _solve(system: Array, limits: Array, targets: Array) -> tuple[Array, Array]:
    """Solve the dual programs as the blocks of one: supports (t,) and corners z (t, q)."""
    count, size, q = system.shape
    indices = np.repeat(np.arange(count * q).reshape(count, 1, q), size, axis=1)
    pointers = np.arange(0, q * (count * size + 1), q)
    matrix = csc_array((system.ravel(), indices.ravel(), pointers), (count * q, count * size))
    result = linprog(
        limits.ravel(),
        A_eq=matrix,  # type: ignore[call-overload]  # the stubs know dense matrices only
        b_eq=targets.ravel(),
        method="highs-ds",  # the dual simplex method ends at a vertex, exact to rounding
        options={
            "maxiter": PIVOTS * count * (q + size),
            "presolve": False,  # costs more than it saves: 0.7 instead of 0.5 ms per program
            "primal_feasibility_tolerance": _FEASIBLE,
            "dual_feasibility_tolerance": _FEASIBLE,
        },
    )
    if result.status != 0:
        raise SolverError(
            "terminal set",
            f"HiGHS failed in a redundancy program (status {result.status}: {result.message:.80})",
            "check the scaling of the plant and of the gain",
        )
    values = np.sum(limits * result.x.reshape(count, size), axis=1)
    return values, np.asarray(result.eqlin.marginals).reshape(count, q)


def _bases(system: Array, limits: Array, corners: Array) -> IntArray:
    """Rows active at each corner (t, q), if there are exactly q; else -1."""
    q = system.shape[2]
    slack = limits - np.einsum("tsq,tq->ts", system, corners)
    simple = np.sum(slack <= 100 * _FEASIBLE, axis=1) == q
    nearest = np.argsort(slack, axis=1)[:, :q]  # fewer than q if the set has fewer rows
    bases = np.full(corners.shape, -1)
    bases[:, : nearest.shape[1]] = np.where(simple[:, None], nearest, -1)
    return bases


def _verified(
    system: Array, limits: Array, targets: Array, hints: IntArray
) -> tuple[BoolArray, Array]:
    """Whether each hinted basis is optimal here, and the support that it gives."""
    known = np.all((hints >= 0) & (hints < system.shape[1]), axis=1)
    index = np.where(known[:, None], hints, 0)
    matrix = np.take_along_axis(system, index[:, :, None], axis=1)
    # Rows have sizes near 1; nearly singular bases are left to HiGHS, and would make `solve` fail.
    known &= np.linalg.slogdet(matrix).logabsdet > -25.0
    matrix[~known] = np.eye(matrix.shape[1])
    right = np.take_along_axis(limits, index, axis=1)
    corners = np.linalg.solve(matrix, right[:, :, None])[:, :, 0]
    mu = np.linalg.solve(matrix.transpose(0, 2, 1), targets[:, :, None])[:, :, 0]
    excess = np.einsum("tsq,tq->ts", system, corners) - limits
    known &= np.all(mu >= -_FEASIBLE, axis=1) & np.all(excess <= _FEASIBLE, axis=1)
    return known, np.sum(right * mu, axis=1)


def _first_hit(Z: Array, mirrored: bool, factor: float) -> BoolArray:
    """Rows that a ray from the origin, along one of them, meets before all others by a factor."""
    reach = Z @ Z.T
    reach = np.abs(reach) if mirrored else reach
    hit = np.zeros(len(Z), dtype=bool)
    if len(Z) > 1:
        order = np.argsort(reach, axis=0)
        columns = np.arange(len(Z))
        clear = reach[order[-1], columns] > factor * reach[order[-2], columns]
        hit[order[-1, clear]] = True
    return hit


def corners(rows: Array) -> Array:
    """Corners (v, n) of the bounded set rows x <= 1; counter-clockwise for two states."""
    scale = np.max(np.abs(rows), axis=0, initial=0.0)
    rows = rows / np.where(scale > 0, scale, 1.0)
    n = rows.shape[1]
    if n == 1:
        ends = [1 / np.max(rows, initial=0.0), 1 / np.min(rows, initial=0.0)] if len(rows) else []
        found: Array = np.array(ends).reshape(-1, 1)
    elif n > 2 or _surround(rows):
        halves = np.column_stack([rows, -np.ones(len(rows))])
        found = _intersections(halves)
    else:
        found = np.zeros((0, n))
    if not len(found) or not np.all(np.isfinite(found)):
        remedy = "bound states or inputs on both sides in every direction"
        raise InputError("terminal set", "is unbounded and has no corners", remedy)
    if n == 2:
        found = found[np.argsort(np.arctan2(found[:, 1], found[:, 0]))]
    return np.asarray(found / scale)


def _surround(rows: Array) -> bool:
    """Whether normals in a plane surround the origin: no gap between neighbours reaches pi."""
    angles = np.sort(np.arctan2(rows[:, 1], rows[:, 0]))
    gaps = np.diff(angles, append=angles[:1] + 2 * np.pi)
    return bool(np.max(gaps, initial=0.0 if len(gaps) else np.inf) < np.pi - 1e-9)


def _intersections(halves: Array) -> Array:
    n = halves.shape[1] - 1
    try:
        return np.asarray(HalfspaceIntersection(halves, np.zeros(n)).intersections)
    except QhullError:  # fewer rows than corners need, or none along a direction
        return np.zeros((0, n))


def hull(points: Array) -> Array:
    """Corners (v, 2) of the convex hull of points (p, 2), counter-clockwise."""
    return np.asarray(points[ConvexHull(points).vertices])
