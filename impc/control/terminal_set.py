"""The terminal set: the largest set in which the gain alone satisfies all bounds for ever.

Under u = -Kx the closed loop is x+ = F x, F = A - BK, and the bounds E x + F_u u <= b of one stage
become G x <= b with G = E - F_u K. The maximal positively invariant set is

    O = {x : G_c F^k x <= b_c  for every bound c and every step k >= 0},    O_k: the steps up to k.

If every row of step k + 1 follows from O_k, then O = O_k (Gilbert and Tan 1991); the first such k,
k*, is finite for a stable F and an origin strictly inside the bounds. Each row that is kept carries
its pair (family c, step k), so that H[i] = G_c F^k can be differentiated with respect to K.

Whether a row follows from others is one linear program. Two facts save most of them: if G_c F^k
follows from O_{k-1}, then G_c F^(k+1) follows from O_k (substitute Fx for x), so a bound that drops
out stays out; and a point of the set beyond a row shows that the row is needed. Tolerances are
relative to the bound: rows are divided by b.

E. G. Gilbert, K. T. Tan, Linear systems with state and control constraints, IEEE TAC 36 (9), 1991.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from impc.arrays import Array, Frozen, IntArray, finite_array, frozen
from impc.checking import Value, checked
from impc.control.halfspaces import (
    corners,
    hull,
    needed_rows,
    redundant_rows,
    seen_directions,
    with_mirror,
)
from impc.errors import InputError, SolverError
from impc.extras import optional
from impc.model.bounds import BoundRows, Bounds, bound_rows
from impc.model.plant import Plant

# Largest number of states for which corners are listed; with more there are thousands.
_MOST_STATES = 6


@dataclass(frozen=True)
class TerminalSet(Value):
    """The set {x : H x <= h} without redundant rows, and the origin of each row.

    Attributes
    ----------
    H : ndarray of shape (r, n)
        Rows, in the units of the bounds; r = 0 if nothing is bounded.
    h : ndarray of shape (r,)
        Right sides.
    family : ndarray of shape (r,)
        Bound c of each row, an index into `rows`.
    step : ndarray of shape (r,)
        Step k of each row: H[i] = ((E - F_u K) F^k)[c] and h[i] = b[c].
    determinedness : int
        k*, the last step that adds a row; 0 without rows.
    tolerance : float
        Accepted excess of a removed row, relative to its bound.
    gain : ndarray of shape (m, n)
        K of u = -Kx.
    F : ndarray of shape (n, n)
        Closed loop A - BK.
    rows : BoundRows
        Bounds of one stage, E x + F_u u <= b.
    bases : mapping of int to ndarray
        Final bases (c, q) of the linear programs by step, for ``near=``; at 0 those of the last
        pruning.
    own : bool
        Whether the user supplied the set: `rows` are then its own, `gain` is zero, and invariance
        is not known.

    Examples
    --------
    >>> import impc
    >>> from plants import yalmip_example
    >>> plant = impc.Plant(yalmip_example())
    >>> bounds = impc.Bounds(plant, u_min=-1, u_max=1)
    >>> reached = impc.maximal_invariant_set(plant, [[1.5, -0.9]], bounds)
    >>> reached.contains([0.1, 0.1]), reached.contains([9, 9]), reached.vertices().shape
    (True, False, (4, 2))
    """

    _rules: ClassVar[Mapping[str, Any]] = {"H": "r n", "h": "r", "gain": "m n", "F": "n n"}

    H: Array
    h: Array
    family: IntArray
    step: IntArray
    determinedness: int
    tolerance: float
    gain: Array
    F: Array
    rows: BoundRows
    bases: Mapping[int, IntArray] = field(repr=False, compare=False)
    own: bool = False

    @checked(x="n")
    def contains(self, x: ArrayLike) -> bool:
        """Whether the state `x` (n,) is in the set, within its tolerance of each bound."""
        return bool(np.all(self.H @ np.asarray(x) <= self.h * (1 + self.tolerance)))

    def vertices(self) -> Array:
        """Return the corners (v, n) in the units of the states; for two counter-clockwise.

        Raises
        ------
        InputError
            If the set is unbounded or has more than 6 states.
        """
        n = self.H.shape[1]
        if n > _MOST_STATES:
            raise InputError("terminal set", f"has {n} states", f"corners: {_MOST_STATES} at most")
        return corners(self.H / self.h[:, None])

    @checked(first=0, second=0)
    def project(self, first: int, second: int) -> Array:
        """Return the corners (v, 2) of the projection on two states, counter-clockwise.

        Parameters
        ----------
        first, second : int
            Indices of the states, from 0.

        Raises
        ------
        InputError
            As in `vertices`.
        """
        n = self.H.shape[1]
        if first == second or max(first, second) >= n:
            raise InputError("first, second", f"got {first}, {second}", f"give two below {n}")
        return hull(self.vertices()[:, [first, second]])

    def to_pytope(self) -> Any:
        """Return the set as a `pytope.Polytope` in half-space form."""
        if not len(self.h):
            raise InputError("terminal set", "is the whole space", "give at least one bound")
        pytope = optional("pytope", "terminal set")
        # pytope 0.0.4 squeezes a single right side to a scalar: repeat the row.
        twice = slice(None) if len(self.h) > 1 else [0, 0]
        return pytope.Polytope(np.array(self.H[twice]), np.array(self.h[twice]))


@dataclass(frozen=True)
class _Loop(Frozen):
    """Normalised rows (c, n), closed loop, coordinates and limits of one construction."""

    normal: Array
    F: Array
    basis: Array
    mirrored: bool
    tolerance: float
    max_steps: int


@checked(gain="m n", tolerance=(0, 1e-2), max_steps=1)
def maximal_invariant_set(
    plant: Plant,
    gain: ArrayLike,
    bounds: Bounds,
    *,
    tolerance: float = 1e-9,
    max_steps: int = 500,
    near: TerminalSet | None = None,
) -> TerminalSet:
    """Compute the maximal positively invariant set of a plant under u = -Kx.

    Parameters
    ----------
    plant : Plant
        Discrete-time plant.
    gain : array_like
        Gain K (m, n) such that A - BK is stable.
    bounds : Bounds
        Bounds of states and inputs.
    tolerance : float
        A row is redundant if it exceeds its bound by at most this fraction of the bound, at most
        0.01.
    max_steps : int
        Largest k* to try.
    near : TerminalSet, optional
        Set of a similar gain: the bases of its linear programs are tried first. It changes the run
        time, not the result.

    Returns
    -------
    TerminalSet

    Raises
    ------
    PlantError
        If the plant is continuous.
    DataError, InputError
        If the gain has the wrong shape or does not stabilise, the bounds do not fit the plant, or a
        setting is out of range.
    SolverError
        If k* exceeds max_steps, or a linear program fails.

    Examples
    --------
    >>> import impc
    >>> from plants import yalmip_example
    >>> plant = impc.Plant(yalmip_example())
    >>> bounds = impc.Bounds(plant, u_min=-1, u_max=1)
    >>> impc.maximal_invariant_set(plant, [[1.5, -0.9]], bounds).h.shape
    (4,)
    """
    plant.require_discrete()
    K = finite_array("gain", gain, (plant.m, plant.n))
    F = plant.A - plant.B @ K
    radius = float(np.max(np.abs(np.linalg.eigvals(F))))
    if not radius < 1:
        problem = f"does not stabilise the plant: the spectral radius of A - BK is {radius:.6g}"
        raise InputError("gain", problem, "give a stabilising gain, such as solve_lqr(...).K")
    rows = bound_rows(bounds, plant)
    loop, families, mirror = _loop((rows.E - rows.F @ K) / rows.b[:, None], F, tolerance, max_steps)
    hints = near.bases if near is not None else {}
    family, step, Z, bases = _grow(loop, families, hints)
    last = int(np.max(step, initial=0))
    kept, bases[0] = needed_rows(Z, loop.mirrored, tolerance, hints.get(0))
    family, step = _in_order(family[kept], step[kept], mirror)
    return TerminalSet(
        H=frozen(_steps(loop.normal, F, last + 1)[step, family] * rows.b[family, None]),
        h=frozen(rows.b[family]),
        family=family,
        step=step,
        determinedness=last,
        tolerance=float(tolerance),
        gain=frozen(K),
        F=frozen(F),
        rows=rows,
        bases=bases,
    )


def own_terminal_set(plant: Plant, given: TerminalSet | tuple[ArrayLike, ArrayLike]) -> TerminalSet:
    """The set {x : H x <= h} that a user supplies as a pair (H, h), or as another set."""
    pair = (given.H, given.h) if isinstance(given, TerminalSet) else given
    H = finite_array("terminal_set: H", pair[0], (None, plant.n))
    h = finite_array("terminal_set: h", pair[1], (len(H),))
    if np.any(h <= 0):
        problem = f"excludes a neighbourhood of the origin: its smallest entry is {h.min():g}"
        raise InputError("terminal_set: h", problem, "give H x <= h with h > 0")
    names = tuple(f"H[{row}] x <= {bound:g}" for row, bound in enumerate(h))
    rows = BoundRows(H, np.zeros((len(h), plant.m)), h, np.ones(len(h), dtype=bool), names)
    every, gain = np.arange(len(h)), np.zeros((plant.m, plant.n))
    return TerminalSet(H, h, every, 0 * every, 0, 1e-9, gain, plant.A, rows, {}, own=True)


def _loop(
    normal: Array, F: Array, tolerance: float, max_steps: int
) -> tuple[_Loop, IntArray, IntArray | None]:
    """State of the construction, the bounds that it follows, and their mirror images."""
    basis = seen_directions(_steps(normal, F, len(F)))
    families, mirror = _half(normal, np.flatnonzero(np.any(normal @ basis, axis=1)))
    return _Loop(normal, F, basis, mirror is not None, tolerance, max_steps), families, mirror


def _in_order(family: IntArray, step: IntArray, mirror: IntArray | None) -> tuple[IntArray, ...]:
    """Rows and their mirror images, sorted by step and bound."""
    if mirror is not None:
        family, step = np.concatenate([family, mirror[family]]), np.tile(step, 2)
    order = np.lexsort((family, step))
    return _read_only(family[order]), _read_only(step[order])


def _steps(normal: Array, F: Array, count: int) -> Array:
    """Rows (count, c, n) of the steps 0 to count - 1."""
    steps = [normal]
    for _ in range(count - 1):
        steps.append(steps[-1] @ F)
    return np.array(steps)


def _half(normal: Array, families: IntArray) -> tuple[IntArray, IntArray | None]:
    """Half of the bounds with their mirror images, if all have one; else all, and None."""
    opposite = np.all(normal[families, None] == -normal[None, families], axis=2)
    partner = np.argmax(opposite, axis=1) if len(families) else families
    ahead = np.arange(len(families))
    # Duplicated bounds share a mirror image, so that pairing is not one to one.
    if not np.all(np.any(opposite, axis=1)) or np.any(partner[partner] != ahead):
        return families, None
    mirror = np.arange(len(normal))
    mirror[families] = families[partner]
    return families[ahead < partner], mirror


def _grow(
    loop: _Loop, families: IntArray, hints: Mapping[int, IntArray]
) -> tuple[IntArray, IntArray, Array, dict[int, IntArray]]:
    """Add steps until every bound has dropped out: family, step and rows Z (r, q) of O_k*."""
    family, step, k = [families[:0]], [families[:0]], 0
    blocks, bases = [np.empty((0, loop.basis.shape[1]))], {}
    rows = loop.normal[families]
    while len(families):
        if k > loop.max_steps + 1:
            raise SolverError(
                "terminal set",
                f"is not determined within max_steps = {loop.max_steps} steps",
                "raise max_steps, or use weights whose closed loop decays faster",
            )
        new = rows @ loop.basis
        if k > 0:
            Z = with_mirror(np.concatenate(blocks), loop.mirrored)
            redundant, bases[k] = redundant_rows(new, Z, loop.tolerance, hints.get(k))
            families, rows, new = families[~redundant], rows[~redundant], new[~redundant]
        family.append(families)
        step.append(np.full(len(families), k))
        blocks.append(new)
        rows, k = rows @ loop.F, k + 1
    return np.concatenate(family), np.concatenate(step), np.concatenate(blocks), bases


def _read_only(values: IntArray) -> IntArray:
    values.flags.writeable = False
    return values
