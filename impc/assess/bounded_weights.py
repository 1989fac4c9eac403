"""The set of all weights with a given gain and a condition number up to a limit.

    { X = blkdiag(Q, R) : X in the fibre of the gain,  trace R = m,  kappa(X) <= limit }

is convex: kappa(X) <= limit says that some t has  t I <= X <= limit t I.  Nothing that the
recordings say of the weights can be finer than this set (docs/equivalent-weights.md, section 2).
A linear function of the weights (an entry, a difference of two cost weights) has a range over the
set that two semidefinite programs find, so that a statement such as "the cost weight of x_1 is
above that of x_2" holds for every member, or for none, or for some. Each end has a member that is
there, and a proof that none is beyond.

They are written as seen from the analytic centre LL' of the fibre, L^-1 X L^-T, in which
tr(L^-1 X L^-T) is the same for every X of one scale: all members lie within n + m of it, which
bounds the variables and makes the dual bounds proofs (`solve_semidefinite`). As seen from the
member of least condition number, a corner of the cone, members of the seat's set lie at 2e4 and
farther: what the programs then returned was 1.4e-3 from the optimum and called solved.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg
import scipy.optimize

from impc.arrays import Array, Frozen
from impc.checking import checked
from impc.errors import InputError, SolverError, WeightsError
from impc.inverse.equivalent_weights import analytic_centre, inverse_factor, least_condition_weights
from impc.inverse.semidefinite import Cone, matrix_inequality, solve_each
from impc.inverse.solution_set import pair_blocks, split_blocks

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from impc.inverse.equivalent_weights import EquivalentWeights
    from impc.inverse.semidefinite import SemidefiniteSolution
    from impc.inverse.solution_set import GainFibre
    from impc.model.weights import Weights

# Relative gap of the programs, and share of the way by which their points may be drawn too far.
_GAP, _CLOSE = 1e-10, 1e-11


@dataclass(frozen=True)
class WeightsSet(Frozen):
    """The set of the module's text, ready for programs over it."""

    fibre: GainFibre
    least: EquivalentWeights  # The member of least condition number
    limit: float  # Largest condition number in the set
    # blkdiag(Q, R) = first + sum_i y_i level_i spans the members: (n + m, n + m) and (k, n + m, n +
    # m), the levels orthonormal as seen from the analytic centre
    first: Array
    level: Array
    inverse: Array  # L^-1 of that centre, (n + m, n + m)
    reach: float  # No member has a larger |y|

    @cached_property
    def cones(self) -> list[Cone]:
        """t l I <= X <= limit t l I in the variables (y, t), with l I at most I as seen."""
        n, size = self.fibre.plant.n, len(self.first)
        seen_first = self.inverse @ self.first @ self.inverse.T
        seen = self.inverse @ self.level @ self.inverse.T
        unit = float(1 / np.linalg.norm(self.inverse, 2) ** 2)
        floor = self.inverse @ self.inverse.T * unit
        top = self.limit * unit
        cones = []
        for block in (slice(0, n), slice(n, size)):
            below = np.concatenate([seen[:, block, block], -floor[None, block, block]])
            cones.append(matrix_inequality(seen_first[block, block], below))
            eye = np.eye(size)[None, block, block]
            above = np.concatenate([-self.level[:, block, block] / top, eye])
            cones.append(matrix_inequality(-self.first[block, block] / top, above))
        return cones


@checked
def weights_set(fibre: GainFibre, ratio: float = 10.0, *, rough: bool = False) -> WeightsSet:
    """Prepare the set of weights with condition number up to `ratio` times the least."""
    if not 1 < ratio < np.inf:
        raise InputError("ratio", f"got {ratio}", "give a number above 1")
    least = least_condition_weights(fibre, rough=rough)
    n, m = fibre.plant.n, fibre.plant.m
    try:
        centre = analytic_centre(fibre).weights
    except WeightsError:  # the cost on some combination of states is free but for the limit
        centre = None
    view = least.weights if centre is None else centre
    inverse = inverse_factor(fibre, view)
    raw = pair_blocks(fibre.Q, fibre.R)
    triangle = np.linalg.qr((inverse @ raw @ inverse.T).reshape(len(raw), -1).T, mode="r")
    raw = np.tensordot(np.linalg.inv(triangle).T, raw, 1)
    traces = np.trace(raw[:, n:, n:], axis1=1, axis2=2)
    first = view.block * (m / np.trace(view.R))
    level = np.tensordot(scipy.linalg.null_space(traces[None]).T, raw, 1)
    limit = ratio * (least.least or least.condition)
    if centre is None:  # X <= limit I, since the least eigenvalue is at most that of R
        trace = limit * float(np.linalg.norm(inverse)) ** 2
    else:
        trace = _largest_trace(fibre, inverse, raw)
    reach = trace + float(np.linalg.norm(inverse @ first @ inverse.T))
    return WeightsSet(fibre, least, limit, first, level, inverse, reach)


def _largest_trace(fibre: GainFibre, inverse: Array, raw: Array) -> float:
    """Largest tr(L^-1 X L^-T) of a semidefinite X with trace R = m; `raw` is orthonormal as seen.

    At the analytic centre it is alpha tr(G'RG) for all X = sum c_k raw_k, up to an error e'c of the
    centre; |c| is at most that trace again, and tr(G'RG) at most m times the largest value of GG'.
    """
    n, m = fibre.plant.n, fibre.plant.m
    seen = np.trace(inverse @ raw @ inverse.T, axis1=1, axis2=2)
    scale = np.trace(fibre.G.T @ raw[:, n:, n:] @ fibre.G, axis1=1, axis2=2)
    alpha = float(seen @ scale) / float(scale @ scale)
    error = float(np.linalg.norm(seen - alpha * scale))
    if error >= 0.5:
        raise SolverError(
            "analytic centre", f"is off by {error:.2g} of a trace", "scale the states and inputs"
        )
    return alpha * m * float(np.linalg.norm(fibre.G, 2)) ** 2 / (1 - error)


@dataclass(frozen=True)
class End:
    """The member at which a program ends, its value, and what no member goes beyond."""

    value: float  # Of the function at the member
    weights: Weights  # The member, at trace R = m
    prove: Callable[[], float]  # Computes `bound`

    @cached_property
    def bound(self) -> float:
        """What no member goes beyond, from the dual program."""
        return self.prove()


@dataclass(frozen=True)
class Range:
    """Least and largest value of a linear function over the set, each with a member that has it."""

    least: End
    most: End

    @property
    def low(self) -> float:
        """The least value."""
        return self.least.value

    @property
    def high(self) -> float:
        """The largest value."""
        return self.most.value


@checked(directions="* n+m n+m")
def linear_ranges(
    found: WeightsSet, directions: Array, *, tolerance: float = _GAP
) -> tuple[Range, ...]:
    """Range over the set of each trace(direction blkdiag(Q, R)); `directions` (k, n + m, n + m)."""
    ends = _minima(found, np.concatenate([directions, -directions]), tolerance)
    half = len(directions)
    return tuple(
        Range(low, _negative(high)) for low, high in zip(ends[:half], ends[half:], strict=True)
    )


@checked(directions="* n+m n+m")
def linear_maxima(
    found: WeightsSet, directions: Array, *, tolerance: float = _GAP
) -> tuple[End, ...]:
    """Largest value over the set of each trace(direction blkdiag(Q, R))."""
    return tuple(_negative(end) for end in _minima(found, -directions, tolerance))


@checked
def entry_ranges(
    found: WeightsSet, states: Sequence[int] | None = None
) -> dict[tuple[int, int], Range]:
    """Range of every entry Q_ij, i >= j, of the given states (indices), of all by default."""
    size = len(found.first)
    chosen = sorted(range(found.fibre.plant.n) if states is None else states)
    pairs = [(i, j) for position, i in enumerate(chosen) for j in chosen[: position + 1]]
    directions = np.zeros((len(pairs), size, size))
    for direction, (i, j) in zip(directions, pairs, strict=True):
        direction[i, j] = direction[j, i] = 1.0 if i == j else 0.5
    return dict(zip(pairs, linear_ranges(found, directions), strict=True))


def _minima(found: WeightsSet, directions: Array, tolerance: float) -> list[End]:
    """Ends of least trace(direction X), of directions (k, n + m, n + m)."""
    ends = [_same_for_all(found, direction) for direction in directions]
    slopes = np.tensordot(directions, found.level, ([1, 2], [1, 2]))
    scales = np.linalg.norm(slopes, axis=1)
    identified = np.flatnonzero(scales)
    if len(identified) == 0:  # or there is but one member
        return ends
    objectives = np.pad(slopes[identified] / scales[identified, None], ((0, 0), (0, 1)))
    each = solve_each(
        objectives,
        found.cones,
        reach=np.full(len(found.level) + 1, found.reach),
        tolerance=tolerance,
    )
    for index, solved in zip(identified, each, strict=True):
        X = _member(found, solved.y)
        ends[index] = End(
            float(np.sum(directions[index] * X)),
            split_blocks(X, found.fibre.plant.n),
            functools.partial(_bound, ends[index].value, float(scales[index]), solved),
        )
    return ends


def _negative(end: End) -> End:
    return End(-end.value, end.weights, lambda: -end.bound)


def _same_for_all(found: WeightsSet, direction: Array) -> End:
    constant = float(np.sum(direction * found.first))
    return End(constant, found.least.weights, lambda: constant)


def _bound(constant: float, scale: float, solved: SemidefiniteSolution) -> float:
    return constant + scale * solved.bound


def _member(found: WeightsSet, y: Array) -> Array:
    """The point of a program, drawn towards the centre until it is a member beyond doubt."""
    X = found.first + np.tensordot(y[: len(found.level)], found.level, 1)
    X = (X + X.T) / 2
    n = found.fibre.plant.n
    centre = found.least.weights.block
    centre = centre * ((len(centre) - n) / np.trace(centre[n:, n:]))

    def at(share: float) -> Array:
        return np.asarray(centre + share * (X - centre))

    def room(share: float) -> float:
        """What the limit leaves, as `condition_number` sees it: concave along the segment."""
        values = np.linalg.eigvalsh(at(share))
        return found.limit * float(values[0]) - float(values[-1])

    if room(1.0) >= 0:
        return at(1.0)
    if room(0.0) <= 0:  # no other is a member
        return at(0.0)
    share, back = float(scipy.optimize.brentq(room, 0.0, 1.0, xtol=_CLOSE)), _CLOSE
    while room(share) < 0:
        share, back = max(0.0, share - back), 2 * back
    return at(share)
