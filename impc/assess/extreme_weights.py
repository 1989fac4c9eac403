"""Ends of what holds for all weights of a set: of a linear function, an eigenvalue, a distance.

A linear function of the weights (an entry, a difference of two prices) has a range over the set
that two semidefinite programs find, and a statement such as "the price of x_1 is above that of x_2"
holds for every member, or for none, or for some. Each end has a member that is there, and a proof
that none is beyond (docs/equivalent-weights.md, section 2).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import scipy.optimize

from impc.arrays import Array
from impc.checking import checked
from impc.inverse.semidefinite import (
    Cone,
    matrix_inequality,
    norm_bound,
    solve_each,
    solve_semidefinite,
)
from impc.inverse.solution_set import split_blocks

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from impc.assess.bounded_weights import WeightsSet
    from impc.inverse.semidefinite import SemidefiniteSolution
    from impc.model.weights import Weights

# Relative gap of the programs, and share of the way by which their points may be drawn too far.
_GAP, _CLOSE = 1e-10, 1e-11


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
    """Range over the set of each trace(direction blkdiag(Q, R)).

    `directions` (k, n + m, n + m).
    """
    ends = _minima(found, np.concatenate([directions, -directions]), tolerance)
    half = len(directions)
    return tuple(
        Range(low, _negative(high)) for low, high in zip(ends[:half], ends[half:], strict=True)
    )


@checked(directions="* n+m n+m")
def linear_maxima(
    found: WeightsSet, directions: Array, *, tolerance: float = _GAP
) -> tuple[End, ...]:
    """Largest value over the set of each trace(direction blkdiag(Q, R)).

    `directions` (k, n + m, n + m) and `tolerance` as in `linear_ranges`.
    """
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


@checked(scaling="n")
def trace_range(found: WeightsSet, scaling: Array) -> Range:
    """Range of trace(D Q D), D = diag(scaling) (n,): the low end is the member of least trace."""
    size = np.zeros(len(found.first))
    size[: len(scaling)] = np.asarray(scaling) ** 2
    return linear_ranges(found, np.diag(size)[None])[0]


@checked(scaling="n")
def nearest_diagonal(found: WeightsSet, scaling: Array) -> End:
    """Member whose D Q D, D = diag(scaling) (n,), has the least off-diagonal part (Frobenius)."""
    n = found.fibre.plant.n
    rows, columns = np.tril_indices(n, -1)
    size = np.sqrt(2.0) * np.outer(scaling, scaling)[rows, columns]
    offset = found.first[rows, columns] * size
    m = found.fibre.plant.m
    least = found.least.weights.Q * (m / np.trace(found.least.weights.R))
    unit = float(np.linalg.norm(least[rows, columns] * size))
    if unit == 0 or len(found.level) == 0:  # diagonal as it is, or there is but one
        return End(unit, found.least.weights, lambda: unit)
    vectors = found.level[:, rows, columns] * size / unit
    # Variables (y, t, s): s bounds the norm; at the best it is at most 1, that of the least.
    count = len(found.level)
    spread = norm_bound(
        np.vstack([vectors, np.zeros((2, len(rows)))]),
        np.append(np.zeros(count + 1), 1.0),
        offset=offset / unit,
    )
    solved = solve_semidefinite(
        np.append(np.zeros(count + 1), 1.0),
        [*_with_one_more(found.cones), spread],
        reach=_reach(found, 1.0),
        tolerance=_GAP,
    )
    X = _member(found, solved.y)
    value = float(np.linalg.norm(X[rows, columns] * size))
    return End(value, split_blocks(X, n), lambda: unit * solved.bound)


@checked
def extreme_eigenvalue(found: WeightsSet, *, largest: bool) -> End:
    """Least largest eigenvalue of Q over the set, or its largest least one."""
    n, count, sign = found.fibre.plant.n, len(found.level), 1.0 if largest else -1.0
    least = found.least.weights.Q * (found.fibre.plant.m / np.trace(found.least.weights.R))
    unit = float(np.linalg.eigvalsh(least)[-1 if largest else 0])
    # Variables (y, t, s): sign (s unit I - Q) >= 0, as seen where small eigenvalues decide.
    view = np.eye(n) / np.sqrt(unit) if largest else found.inverse[:n, :n]
    levels = np.concatenate([-found.level[:, :n, :n], np.zeros((1, n, n)), unit * np.eye(n)[None]])
    levels = sign * view @ levels @ view.T
    bound = matrix_inequality(-sign * view @ found.first[:n, :n] @ view.T, levels)
    objective = np.append(np.zeros(count + 1), sign)
    # No member's least eigenvalue is above R's mean of 1.
    reach = _reach(found, 1.0 if largest else 1 / unit)
    cones = [*_with_one_more(found.cones), bound]
    solved = solve_semidefinite(objective, cones, reach=reach, tolerance=_GAP)
    X = _member(found, solved.y)
    value = float(np.linalg.eigvalsh(X[:n, :n])[-1 if largest else 0])
    return End(value, split_blocks(X, n), lambda: sign * unit * solved.bound)


def _minima(found: WeightsSet, directions: Array, tolerance: float) -> list[End]:
    """Ends of least trace(direction X), of directions (k, n + m, n + m)."""
    ends = [_same_for_all(found, direction) for direction in directions]
    slopes = np.tensordot(directions, found.level, ([1, 2], [1, 2]))
    scales = np.linalg.norm(slopes, axis=1)
    told = np.flatnonzero(scales)
    if len(told) == 0:  # or there is but one member
        return ends
    objectives = np.pad(slopes[told] / scales[told, None], ((0, 0), (0, 1)))
    each = solve_each(objectives, found.cones, reach=_reach(found), tolerance=tolerance)
    for index, solved in zip(told, each, strict=True):
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
    """The point of a program, drawn towards the centre until it is a member beyond doubt.

    A program's error, 1e-8 of the largest weight, can outweigh the least eigenvalue.
    """
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


def _with_one_more(cones: list[Cone]) -> list[Cone]:
    """The cones with a variable after theirs that does not occur in them."""
    return [Cone(np.pad(one.rows, ((0, 0), (0, 1))), one.right, one.kind) for one in cones]


def _reach(found: WeightsSet, *more: float) -> Array:
    """Largest |y|, t and further variables: t l I <= X gives t <= the trace of X as seen."""
    return np.append(np.full(len(found.level) + 1, found.reach), more)
