"""The terminal set: the largest set in which the gain alone keeps every bound for ever.

Under u = -Kx the closed loop is x+ = F x, F = A - BK, and the bounds E x + F_u u <= b of one stage
become G x <= b with G = E - F_u K. The maximal positively invariant set is

    O = {x : G_c F^k x <= b_c  for every bound c and every step k >= 0},    O_k: the steps up to k.

Gilbert and Tan (1991): when every row of step k + 1 already follows from O_k, then O = O_k; the
first such k, k*, is finite for a stable F and an origin strictly inside the bounds. Each row that
is kept carries its pair (family c, step k), so that H[i] = G_c F^k can be differentiated through K.

Whether a row d z <= 1 follows from Z z <= 1 is one linear program. Two facts save most of them:
if G_c F^k follows from O_{k-1}, then G_c F^(k+1) follows from O_k (put Fx for x), so a bound that
has dropped out stays out; and a point of the set beyond the row shows that the row is needed.

All tolerances are relative to the bound: rows are divided by b, the right sides are then 1.

E. G. Gilbert, K. T. Tan, Linear systems with state and control constraints: the theory and
application of maximal output admissible sets, IEEE Trans. Automatic Control 36 (9), 1991.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import csc_array

from impc.arrays import Array, finite_array, frozen
from impc.bounds import BoundRows, bound_rows
from impc.errors import BoundsError, InputError, SolverError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

    from impc.bounds import Bounds
    from impc.plant import Plant

__all__ = [
    "TerminalSet",
    "contains",
    "invariance_violation",
    "maximal_invariant_set",
    "maximality_violation",
]

IntArray = np.ndarray[tuple[int, ...], np.dtype[np.intp]]
BoolArray = np.ndarray[tuple[int, ...], np.dtype[np.bool_]]

# A direction that the normalised rows see less than this, relative to the best seen one, counts
# as unbounded: rounding (2e-16) would move the set along it by more than 1e-6 of its size.
_UNSEEN = 1e-10
# A row whose support stays this far below its bound touches the set nowhere: all such rows can go
# at once. The others may be duplicates of one another and go one by one.
_TOUCHING = 1e-6
# The supports are capped here (twice the bound), which keeps every linear program bounded.
_CAP = 2.0
# Programs solved in one call of HiGHS: more save overhead, fewer save simplex work.
_BATCH = 12


@dataclass(frozen=True)
class TerminalSet:
    """The set {x : H x <= h}, without redundant rows, and where each row comes from.

    Attributes
    ----------
    H, h : Array
        Shapes (r, n) and (r,), in the units of the bounds; r = 0 when nothing is bounded.
    family : IntArray
        Bound c of each row (r,), an index into ``rows``.
    step : IntArray
        Step k of each row (r,): H[i] = ((E - F_u K) F^k)[c] and h[i] = b[c].
    determinedness : int
        k*, the last step that adds a row.
    tolerance : float
        Support of a removed row above its bound, relative to the bound, that was accepted.
    gain : Array
        K (m, n) of u = -Kx.
    F : Array
        Closed loop A - BK, (n, n).
    rows : BoundRows
        The bounds of one stage, E x + F_u u <= b.
    """

    H: Array
    h: Array
    family: IntArray
    step: IntArray
    determinedness: int
    tolerance: float
    gain: Array
    F: Array
    rows: BoundRows


def maximal_invariant_set(
    plant: Plant,
    gain: ArrayLike,
    bounds: Bounds,
    *,
    tolerance: float = 1e-9,
    max_steps: int = 500,
) -> TerminalSet:
    """Compute the maximal positively invariant set of a plant under u = -Kx.

    Parameters
    ----------
    plant : Plant
        Discrete.
    gain : array_like
        K, shape (m, n), such that A - BK is stable.
    bounds : Bounds
        Of the plant's size, the origin strictly inside.
    tolerance : float
        A row is redundant when it exceeds its bound by no more than this fraction of the bound.
    max_steps : int
        Largest k* to try.

    Raises
    ------
    PlantError
        When the plant is continuous.
    DataError, InputError, BoundsError
        When the gain has the wrong shape or does not stabilise, the tolerance or max_steps make
        no sense, or the bounds are not the plant's.
    SolverError
        When k* exceeds max_steps, or a linear program fails.
    """
    plant.require_discrete()
    K = finite_array("gain", gain, (plant.m, plant.n))
    F = plant.A - plant.B @ K
    _check(plant, F, bounds, tolerance, max_steps)
    rows = bound_rows(bounds, plant)
    normal = (rows.E - rows.F @ K) / rows.b[:, None]
    basis = _seen_directions(_steps(normal, F, plant.n))
    families, mirror = _half(normal, np.flatnonzero(np.any(normal @ basis, axis=1)))
    family, step, Z = _grow(normal, F, basis, families, mirror is not None, tolerance, max_steps)
    kept = _needed(Z, mirror is not None, tolerance)
    family, step = family[kept], step[kept]
    if mirror is not None:
        family, step = np.concatenate([family, mirror[family]]), np.tile(step, 2)
    order = np.lexsort((family, step))
    family, step = family[order], step[order]
    last = int(np.max(step, initial=0))
    H = _steps(normal, F, last + 1)[step, family] * rows.b[family, None]
    return TerminalSet(
        H=frozen(H),
        h=frozen(rows.b[family]),
        family=_frozen_integers(family),
        step=_frozen_integers(step),
        determinedness=last,
        tolerance=float(tolerance),
        gain=frozen(K),
        F=frozen(F),
        rows=rows,
    )


def contains(terminal: TerminalSet, x: ArrayLike, tolerance: float | None = None) -> bool:
    """Whether the state x (n,) is in the set, within a fraction of each bound.

    The tolerance is the set's own unless given. Raises DataError for another shape.
    """
    state = finite_array("x", x, (terminal.H.shape[1],))
    allowed = terminal.tolerance if tolerance is None else tolerance
    return bool(np.all(terminal.H @ state <= terminal.h * (1 + allowed)))


def invariance_violation(terminal: TerminalSet) -> float:
    """By how much F leaves the set: the largest support of H F x over the set, less h, over h.

    At most about the tolerance when the set is invariant; capped at 1; 0 for a set without rows.
    Together with `maximality_violation` it proves the set: invariant and inside the bounds, hence
    within O; bounded by rows of O only, hence not smaller than O.

    Raises
    ------
    SolverError
        When a linear program fails.
    """
    normal = terminal.H / terminal.h[:, None]
    return _excess(terminal, normal @ terminal.F)


def maximality_violation(terminal: TerminalSet) -> float:
    """By how much the set differs from O_k*, relative to the bounds; capped at 1.

    The larger of two numbers. First, the distance of the rows from the rows (c, k) computed
    afresh, by powers of F: every admissible trajectory obeys those, so no invariant set reaches
    beyond them and the set is not too small. Second, the largest violation, over the set, of any
    bound at any step up to k*, whether its row was kept or removed: the set is not too large.

    Raises
    ------
    SolverError
        When a linear program fails.
    """
    rows, count = terminal.rows, terminal.determinedness + 1
    normal = (rows.E - rows.F @ terminal.gain) / rows.b[:, None]
    powers = np.array([np.linalg.matrix_power(terminal.F, k) for k in range(count)])
    every = normal @ powers
    afresh = every[terminal.step, terminal.family]
    distance = (terminal.H / terminal.h[:, None] - afresh) @ _seen_directions(afresh)
    on_bounds = np.max(np.abs(terminal.h / rows.b[terminal.family] - 1), initial=0.0)
    wrong = max(float(np.max(np.abs(distance), initial=0.0)), float(on_bounds))
    removed = np.ones(every.shape[:2], dtype=bool)
    removed[terminal.step, terminal.family] = False
    return max(wrong, _excess(terminal, every[removed]))


def _check(plant: Plant, F: Array, bounds: Bounds, tolerance: float, max_steps: int) -> None:
    radius = float(np.max(np.abs(np.linalg.eigvals(F))))
    if not radius < 1:
        problem = f"does not stabilise the plant: the spectral radius of A - BK is {radius:.6g}"
        raise InputError("gain", problem, "give the gain of a regulator, such as solve_lqr(...).K")
    if bounds.x_min.shape != (plant.n,) or bounds.u_min.shape != (plant.m,):
        given = f"are for {bounds.x_min.size} states and {bounds.u_min.size} inputs"
        raise BoundsError("bounds", given, f"the plant has {plant.n} and {plant.m}: box_bounds")
    if not 0 <= tolerance <= 1e-2 or max_steps < 1:
        given = f"are {tolerance!r} and {max_steps!r}"
        raise InputError("tolerance, max_steps", given, "give 0 to 0.01, and at least 1")


def _steps(normal: Array, F: Array, count: int) -> Array:
    """Rows (count, c, n) of the steps 0 .. count - 1."""
    steps = np.empty((count, *normal.shape))
    steps[0] = normal
    for k in range(1, count):
        steps[k] = steps[k - 1] @ F
    return steps


def _seen_directions(rows: Array) -> Array:
    """Coordinates x = T z, T (n, q), in which the rows (..., n) are orthonormal columns.

    The set is then round to within a factor of the square root of the number of rows, as HiGHS
    wants it: it drops matrix entries below 1e-9. Directions that no row sees are left out.
    """
    stack = rows.reshape(-1, rows.shape[-1])
    scale = np.max(np.abs(stack), axis=0, initial=0.0)
    scale[scale == 0] = 1.0
    _, singular, right = np.linalg.svd(stack / scale, full_matrices=False)
    seen = singular > _UNSEEN * np.max(singular, initial=0.0)
    return np.asarray((right[seen] / scale).T / singular[seen])


def _half(normal: Array, families: IntArray) -> tuple[IntArray, IntArray | None]:
    """Half of the bounds and the mirror image of each, when all have one; else all, and None."""
    opposite = np.all(normal[families, None] == -normal[None, families], axis=2)
    partner = np.argmax(opposite, axis=1) if len(families) else families
    ahead = np.arange(len(families))
    # Duplicated bounds share a mirror image: pairing is then not one to one.
    if not np.all(np.any(opposite, axis=1)) or np.any(partner[partner] != ahead):
        return families, None
    mirror = np.arange(len(normal))
    mirror[families] = families[partner]
    return families[ahead < partner], mirror


def _grow(
    normal: Array,
    F: Array,
    basis: Array,
    families: IntArray,
    mirrored: bool,
    tolerance: float,
    max_steps: int,
) -> tuple[IntArray, IntArray, Array]:
    """Add steps until every bound has dropped out: families, steps and rows Z (r, q) of O_k*."""
    family, step, blocks = [families[:0]], [families[:0]], [np.empty((0, basis.shape[1]))]
    rows, k = normal[families], 0
    while len(families):
        if k > max_steps + 1:
            raise SolverError(
                "terminal set",
                f"is not determined within max_steps = {max_steps} steps",
                "raise max_steps, or use weights whose closed loop decays faster",
            )
        new = rows @ basis
        if k > 0:
            stays = ~_redundant(new, _both(np.concatenate(blocks), mirrored), tolerance)
            families, rows, new = families[stays], rows[stays], new[stays]
        family.append(families)
        step.append(np.full(len(families), k))
        blocks.append(new)
        rows, k = rows @ F, k + 1
    return np.concatenate(family), np.concatenate(step), np.concatenate(blocks)


def _needed(Z: Array, mirrored: bool, tolerance: float) -> IntArray:
    """Indices of the rows of Z z <= 1 that do not follow from the others, earliest preferred."""
    kept = np.arange(len(Z))
    doubtful = kept[~_first_hit(Z, mirrored)]
    others = [_both(np.delete(Z, i, axis=0), mirrored) for i in doubtful]
    support = _supports(Z[doubtful], others)
    kept = np.setdiff1d(kept, doubtful[support <= 1 - _TOUCHING])
    touching = doubtful[(support > 1 - _TOUCHING) & (support <= 1 + tolerance)]
    for i in touching[::-1]:
        rest = kept[kept != i]
        if _supports(Z[[i]], [_both(Z[rest], mirrored)])[0] <= 1 + tolerance:
            kept = rest
    return kept


def _redundant(new: Array, Z: Array, tolerance: float) -> BoolArray:
    """Whether each row of new (c, q) exceeds 1 by no more than the tolerance where Z z <= 1."""
    reach = np.max(Z @ new.T, axis=0, initial=0.0)  # the ray t * new leaves the set at t = 1/reach
    undecided = np.sum(new**2, axis=1) <= (1 + 10 * tolerance) * reach
    undecided |= ~np.any(new, axis=1)
    redundant = np.zeros(len(new), dtype=bool)
    support = _supports(new[undecided], [Z] * int(np.sum(undecided)))
    redundant[undecided] = support <= 1 + tolerance
    return redundant


def _first_hit(Z: Array, mirrored: bool) -> BoolArray:
    """Rows that a ray from the origin, along one of the rows, meets clearly before all others."""
    reach = Z @ Z.T
    reach = np.abs(reach) if mirrored else reach
    hit = np.zeros(len(Z), dtype=bool)
    if len(Z) > 1:
        order = np.argsort(reach, axis=0)
        columns = np.arange(len(Z))
        clear = reach[order[-1], columns] > (1 + _TOUCHING) * reach[order[-2], columns]
        hit[order[-1, clear]] = True
    return hit


def _excess(terminal: TerminalSet, targets: Array) -> float:
    """Largest support of the normalised target rows (t, n) over the set, less 1."""
    if not len(targets) or not np.any(targets):
        return 0.0
    normal = terminal.H / terminal.h[:, None]
    basis = _seen_directions(np.concatenate([normal, targets]))
    return float(np.max(_supports(targets @ basis, [normal @ basis] * len(targets)))) - 1.0


def _both(Z: Array, mirrored: bool) -> Array:
    return np.concatenate([Z, -Z]) if mirrored else Z


def _supports(targets: Array, sets: Sequence[Array]) -> Array:
    """Support of each target row d (q,) over its set {z : Z z <= 1, d z <= _CAP}.

    The dual program  min 1'mu + _CAP mu_0,  Z'mu + d mu_0 = d,  mu >= 0  is always feasible and
    bounded and has only q equations, so its simplex bases are small.
    """
    values = np.empty(len(targets))
    for start in range(0, len(targets), _BATCH):
        part = slice(start, start + _BATCH)
        values[part] = _batch_supports(targets[part], sets[part])
    return values


def _batch_supports(targets: Array, sets: Sequence[Array]) -> Array:
    """Solve the programs of `_supports` in one call, as the blocks of one program."""
    count, q = targets.shape
    sizes = np.array([len(Z) + 1 for Z in sets])
    ends = np.cumsum(sizes)
    data = np.concatenate([block for d, Z in zip(targets, sets, strict=True) for block in (Z, [d])])
    cost = np.ones(ends[-1])
    cost[ends - 1] = _CAP
    indices = (np.repeat(np.arange(count) * q, sizes)[:, None] + np.arange(q)).ravel()
    pointers = np.arange(0, q * (ends[-1] + 1), q)
    result = linprog(
        cost,
        A_eq=csc_array((data.ravel(), indices, pointers), shape=(count * q, ends[-1])),
        b_eq=targets.ravel(),
        method="highs-ds",  # the dual simplex ends on a vertex: exact to rounding
        options={
            "presolve": False,  # costs more than it saves on rows without structure
            "primal_feasibility_tolerance": 1e-10,  # the smallest that HiGHS takes
            "dual_feasibility_tolerance": 1e-10,
        },
    )
    if result.status != 0:
        raise SolverError(
            "terminal set",
            f"HiGHS ended a redundancy test with status {result.status}: {result.message:.80}",
            "check the scaling of the plant and its gain",
        )
    return np.add.reduceat(cost * result.x, ends - sizes)


def _frozen_integers(values: IntArray) -> IntArray:
    array = np.array(values, dtype=np.intp)
    array.flags.writeable = False
    return array
