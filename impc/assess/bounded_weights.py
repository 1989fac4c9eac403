"""Set of all weights with a given gain and a bounded condition number.

    { X = blkdiag(Q, R) : X in the space of the gain,  trace R = m,  kappa(X) <= limit }

is convex: kappa(X) <= limit means that t I <= X <= limit t I for some t. Recordings cannot identify
the weights beyond this set (docs/why/equivalent_weights.md). A linear function of the weights (an
entry, a difference of two costs) has a range over the set that two semidefinite programs compute,
so that a statement such as "x_1 costs more than x_2" holds for every member, none, or some. Each
end has a member that attains it and a proof that no member lies beyond.

The programs use the coordinates L^-1 X L^-T of the analytic centre LL', in which tr(L^-1 X L^-T) is
the same for every X of one scale. All members then lie within n + m of it, which bounds the
variables and makes the dual bounds proofs (`solve_semidefinite`). In the coordinates of the
least-condition member, members lie so far out that the programs are inaccurate.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
import scipy.optimize

from impc.arrays import Array, Frozen
from impc.checking import checked
from impc.errors import InputError, SolverError, WeightsError
from impc.inverse.equivalent_weights import (
    EquivalentWeights,
    analytic_centre,
    inverse_factor,
    least_condition_weights,
    nearest_weights,
)
from impc.inverse.semidefinite import Cone, SemidefiniteSolution, matrix_inequality, solve_each
from impc.inverse.solution_set import GainFibre, pair_blocks, split_blocks
from impc.model.weights import Weights

# Relative gap of the programs, and tolerance of the step back into the set.
_GAP, _CLOSE = 1e-10, 1e-11


@dataclass(frozen=True)
class WeightsSet(Frozen):
    """Set of weights, ready for programs over it."""

    fibre: GainFibre
    least: EquivalentWeights  # Member of least condition number
    limit: float  # Largest condition number in the set
    # Members are blkdiag(Q, R) = first + sum_i y_i level_i, (n + m, n + m) and (k, n + m, n + m),
    # levels orthonormal in the coordinates of the centre
    first: Array
    level: Array
    inverse: Array  # L^-1 of the centre, (n + m, n + m)
    reach: float  # Upper bound of |y| over all members

    @cached_property
    def cones(self) -> list[Cone]:
        """t l I <= X <= limit t l I in the variables (y, t), with scaling l."""
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
def weights_set(fibre: GainFibre, ratio: float = 10.0) -> WeightsSet:
    """Prepare the set of weights with condition number up to `ratio` times the least."""
    if not 1 < ratio < np.inf:
        raise InputError("ratio", f"expected a number above 1, got {ratio}", "pass e.g. ratio=10")
    least = least_condition_weights(fibre)
    try:
        centre = analytic_centre(fibre).weights
    except WeightsError:  # some combination of states has a free cost
        centre = None
    view = least.weights if centre is None else centre
    inverse = inverse_factor(fibre, view)
    limit = ratio * (least.least or least.condition)
    trace = None if centre is None else _largest_trace(fibre, inverse)
    return _set_from(fibre, least, limit, view, inverse, trace)


def set_near(found: WeightsSet, fibre: GainFibre) -> WeightsSet:
    """Set of the weights of another gain, about those nearest to the least-condition member.

    It needs no program: the limit is as many times the condition number of these weights.
    """
    least = nearest_weights(fibre, found.least.weights)
    limit = found.limit / found.least.condition * least.condition
    return _set_from(fibre, least, limit, least.weights, found.inverse)


def _set_from(
    fibre: GainFibre,
    least: EquivalentWeights,
    limit: float,
    view: Weights,
    inverse: Array,
    trace: float | None = None,
) -> WeightsSet:
    """Set in the coordinates of `inverse`; `trace` bounds tr(L^-1 X L^-T) over it."""
    n, m = fibre.plant.n, fibre.plant.m
    raw = _orthonormal(fibre, inverse)
    traces = np.trace(raw[:, n:, n:], axis1=1, axis2=2)
    first = view.block * (m / np.trace(view.R))
    level = np.tensordot(scipy.linalg.null_space(traces[None]).T, raw, 1)
    if trace is None:  # X <= limit I, since the least eigenvalue is at most that of R
        trace = limit * float(np.linalg.norm(inverse)) ** 2
    reach = trace + float(np.linalg.norm(inverse @ first @ inverse.T))
    return WeightsSet(fibre, least, limit, first, level, inverse, reach)


def _orthonormal(fibre: GainFibre, inverse: Array) -> Array:
    """Basis (k, n + m, n + m) of the space, orthonormal in the coordinates L^-1 X L^-T."""
    raw = pair_blocks(fibre.Q, fibre.R)
    triangle = np.linalg.qr((inverse @ raw @ inverse.T).reshape(len(raw), -1).T, mode="r")
    return np.asarray(np.tensordot(np.linalg.inv(triangle).T, raw, 1))


def _largest_trace(fibre: GainFibre, inverse: Array) -> float:
    """Largest tr(L^-1 X L^-T) of a semidefinite X with trace R = m.

    At the analytic centre it is alpha tr(G'RG) for all X = sum c_k raw_k, `raw` orthonormal, up to
    an error e'c of the centre; |c| is at most that trace again, and tr(G'RG) at most m times the
    largest value of GG'.
    """
    n, m, raw = fibre.plant.n, fibre.plant.m, _orthonormal(fibre, inverse)
    seen = np.trace(inverse @ raw @ inverse.T, axis1=1, axis2=2)
    scale = np.trace(fibre.G.T @ raw[:, n:, n:] @ fibre.G, axis1=1, axis2=2)
    alpha = float(seen @ scale) / float(scale @ scale)
    error = float(np.linalg.norm(seen - alpha * scale))
    if error >= 0.5:
        raise SolverError(
            "analytic centre",
            f"not accurate enough (relative error {error:.2g})",
            "rescale the states and inputs",
        )
    return alpha * m * float(np.linalg.norm(fibre.G, 2)) ** 2 / (1 - error)


@dataclass(frozen=True)
class End:
    """End of a range: member, value, and bound over all members."""

    value: float  # Value of the function at the member
    weights: Weights  # Member, at trace R = m
    prove: Callable[[], float]  # Computes `bound`

    @cached_property
    def bound(self) -> float:
        """Bound that no member exceeds, from the dual program."""
        return self.prove()


@dataclass(frozen=True)
class Range:
    """Least and largest value of a linear function over the set."""

    least: End
    most: End

    @property
    def low(self) -> float:
        """Least value."""
        return self.least.value

    @property
    def high(self) -> float:
        """Largest value."""
        return self.most.value


@checked(directions="* n+m n+m")
def linear_ranges(found: WeightsSet, directions: Array) -> tuple[Range, ...]:
    """Range over the set of trace(direction X) for `directions` (k, n + m, n + m)."""
    ends = _minima(found, np.concatenate([directions, -directions]))
    return tuple(map(Range, ends[: len(directions)], map(_negative, ends[len(directions) :])))


@checked(directions="* n+m n+m")
def linear_maxima(found: WeightsSet, directions: Array) -> tuple[End, ...]:
    """Largest value over the set of each trace(direction X)."""
    return tuple(map(_negative, _minima(found, -directions)))


@checked(directions="* n+m n+m")
def all_negative(found: WeightsSet, directions: Array) -> tuple[bool, ...]:
    """Whether each trace(direction X) is negative for every member."""
    return tuple(end.value > 0 for end in _minima(found, -directions, signs=True))


@checked
def entry_ranges(
    found: WeightsSet, states: Sequence[int] | None = None
) -> dict[tuple[int, int], Range]:
    """Range of every entry Q_ij, i >= j, of the given state indices (default: all)."""
    size = len(found.first)
    chosen = sorted(range(found.fibre.plant.n) if states is None else states)
    pairs = [(i, j) for position, i in enumerate(chosen) for j in chosen[: position + 1]]
    directions = np.zeros((len(pairs), size, size))
    for direction, (i, j) in zip(directions, pairs, strict=True):
        direction[i, j] = direction[j, i] = 1.0 if i == j else 0.5
    return dict(zip(pairs, linear_ranges(found, directions), strict=True))


def _minima(found: WeightsSet, directions: Array, *, signs: bool = False) -> list[End]:
    """Members of least trace(direction X), for directions (k, n + m, n + m).

    With `signs` only the sign of the value is right.
    """
    constants = np.tensordot(directions, found.first, 2)
    slopes = np.tensordot(directions, found.level, ([1, 2], [1, 2]))
    scales = np.linalg.norm(slopes, axis=1)
    # Where the slope is zero the function is constant, or the set has a single member.
    ends = [End(one, found.least.weights, functools.partial(float, one)) for one in constants]
    identified = np.flatnonzero(scales)
    if len(identified) == 0:
        return ends
    each = solve_each(
        np.pad(slopes[identified] / scales[identified, None], ((0, 0), (0, 1))),
        found.cones,
        reach=np.full(len(found.level) + 1, found.reach),
        tolerance=_GAP,
        above=-constants[identified] / scales[identified] if signs else None,
    )
    for index, solved in zip(identified, each, strict=True):
        X = _member(found, solved.y)
        ends[index] = End(
            float(np.sum(directions[index] * X)),
            split_blocks(X, found.fibre.plant.n),
            functools.partial(_bound, float(constants[index]), float(scales[index]), solved),
        )
    return ends


def _negative(end: End) -> End:
    return End(-end.value, end.weights, lambda: -end.bound)


def _bound(constant: float, scale: float, solved: SemidefiniteSolution) -> float:
    return constant + scale * solved.bound


def _member(found: WeightsSet, y: Array) -> Array:
    """Solution of a program, moved towards the centre until it is certainly a member."""
    X = found.first + np.tensordot(y[: len(found.level)], found.level, 1)
    X = (X + X.T) / 2
    n = found.fibre.plant.n
    centre = found.least.weights.block
    centre = centre * ((len(centre) - n) / np.trace(centre[n:, n:]))

    def at(share: float) -> Array:
        return np.asarray(centre + share * (X - centre))

    def room(share: float) -> float:
        """Slack of the condition number: concave along the segment."""
        values = np.linalg.eigvalsh(at(share))
        return found.limit * float(values[0]) - float(values[-1])

    if room(1.0) >= 0:
        return at(1.0)
    if room(0.0) <= 0:  # the centre is the only member
        return at(0.0)
    share, back = float(scipy.optimize.brentq(room, 0.0, 1.0, xtol=_CLOSE)), _CLOSE
    while room(share) < 0:
        share, back = max(0.0, share - back), 2 * back
    return at(share)
