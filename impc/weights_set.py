"""All weights with a given gain and a condition number up to a limit, and what holds for each.

    { X = blkdiag(Q, R) : X in the fibre of the gain,  trace R = m,  kappa(X) <= limit }

is convex: kappa(X) <= limit says that some t has  t I <= X <= limit t I.  A linear function of the
weights (an entry, a difference of two prices) therefore has a range over the set that two
semidefinite programs find, and a statement such as "the price of x_1 is above that of x_2" holds
for every member, or for none, or for some. Nothing that the recordings say of the weights can be
finer than this set.

The programs are written as seen from a member X0 = LL' of the set, so that their entries are of
order one although the condition numbers of plant units may be 1e8 (`least_condition_weights`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from impc.arrays import Array
from impc.equivalent_weights import inverse_factor, least_condition_weights
from impc.errors import InputError
from impc.gain_fibre import pair_blocks, split_blocks
from impc.semidefinite import Cone, matrix_inequality, solve_semidefinite

if TYPE_CHECKING:
    from impc.equivalent_weights import EquivalentWeights
    from impc.gain_fibre import GainFibre
    from impc.weights import Weights

__all__ = ["Range", "WeightsSet", "entry_ranges", "linear_range", "trace_range", "weights_set"]


@dataclass(frozen=True)
class WeightsSet:
    """The set of the module's text, ready for programs over it.

    Attributes
    ----------
    fibre : GainFibre
    least : EquivalentWeights
        The member of least condition number; the programs are written as seen from it.
    limit : float
        Largest condition number in the set.
    first, level : Array
        blkdiag(Q, R) = first + sum_i y_i level_i spans the members: (n + m, n + m) and
        (k, n + m, n + m), the levels orthonormal as seen from the member of least condition number.
    inverse : Array
        L^-1 of that member, (n + m, n + m).
    """

    fibre: GainFibre
    least: EquivalentWeights
    limit: float
    first: Array
    level: Array
    inverse: Array


@dataclass(frozen=True)
class Range:
    """Least and largest value of a linear function over the set, each with a member that has it.

    Attributes
    ----------
    low, high : float
        Values at the two members.
    low_bound, high_bound : float
        What no member goes beyond, by the programs' dual solutions.
    low_weights, high_weights : Weights
    """

    low: float
    high: float
    low_bound: float
    high_bound: float
    low_weights: Weights
    high_weights: Weights


def weights_set(fibre: GainFibre, ratio: float = 10.0) -> WeightsSet:
    """Prepare the set of weights with condition number up to `ratio` times the least.

    Raises
    ------
    InputError
        When the ratio is not above 1.
    WeightsError, SolverError
        As `least_condition_weights`.
    """
    if not 1 < ratio < np.inf:
        raise InputError("ratio", f"got {ratio}", "give a number above 1")
    least = least_condition_weights(fibre)
    n, m = fibre.plant.n, fibre.plant.m
    inverse = inverse_factor(fibre, least.weights)
    raw = pair_blocks(fibre.Q, fibre.R)
    triangle = np.linalg.qr((inverse @ raw @ inverse.T).reshape(len(raw), -1).T, mode="r")
    raw = np.tensordot(np.linalg.inv(triangle).T, raw, 1)
    traces = np.trace(raw[:, n:, n:], axis1=1, axis2=2)
    # y = first + null space: the members with trace R = m.
    first = np.tensordot(traces * m / (traces @ traces), raw, 1)
    level = np.tensordot(scipy.linalg.null_space(traces[None]).T, raw, 1)
    return WeightsSet(fibre, least, ratio * least.condition, first, level, inverse)


def linear_range(found: WeightsSet, direction: Array) -> Range:
    """Range of trace(direction blkdiag(Q, R)) over the set, direction symmetric (n + m, n + m).

    Raises
    ------
    SolverError
        When a program returns no finite point.
    """
    low, low_bound, low_weights = _minimum(found, direction)
    high, high_bound, high_weights = _minimum(found, -direction)
    return Range(low, -high, low_bound, -high_bound, low_weights, high_weights)


def entry_ranges(found: WeightsSet) -> dict[tuple[int, int], Range]:
    """Range of every entry Q_ij, i >= j."""
    n, size = found.fibre.plant.n, len(found.first)
    ranges = {}
    for i in range(n):
        for j in range(i + 1):
            direction = np.zeros((size, size))
            direction[i, j] = direction[j, i] = 1.0 if i == j else 0.5
            ranges[i, j] = linear_range(found, direction)
    return ranges


def trace_range(found: WeightsSet, scaling: Array) -> Range:
    """Range of trace(D Q D), D = diag(scaling) (n,): the low end is the member of least trace."""
    size = np.zeros(len(found.first))
    size[: len(scaling)] = np.asarray(scaling) ** 2
    return linear_range(found, np.diag(size))


def _minimum(found: WeightsSet, direction: Array) -> tuple[float, float, Weights]:
    """(value at the member found, dual bound, the member)."""
    constant = float(np.sum(direction * found.first))
    slopes = np.tensordot(found.level, direction, 2)
    scale = float(np.linalg.norm(slopes))
    if scale == 0:  # the same for every member, or there is but one
        return constant, constant, found.least.weights
    solved = solve_semidefinite(np.append(slopes / scale, 0.0), _cones(found))
    X = found.first + np.tensordot(solved.y[:-1], found.level, 1)
    bound = constant + scale * solved.bound
    return float(np.sum(direction * X)), bound, split_blocks(X, found.fibre.plant.n)


def _cones(found: WeightsSet) -> list[Cone]:
    """t l I <= X <= limit t l I in the variables (y, t), l the least eigenvalue of the centre."""
    n, size = found.fibre.plant.n, len(found.first)
    eigenvalues = np.linalg.eigvalsh(found.least.weights.block)
    unit = float(eigenvalues[0])
    inverse = found.inverse
    seen_first = inverse @ found.first @ inverse.T
    seen = inverse @ found.level @ inverse.T
    floor = inverse @ inverse.T * unit
    top = found.limit * unit
    cones = []
    for block in (slice(0, n), slice(n, size)):
        below = np.concatenate([seen[:, block, block], -floor[None, block, block]])
        cones.append(matrix_inequality(seen_first[block, block], below))
        eye = np.eye(size)[None, block, block]
        above = np.concatenate([-found.level[:, block, block] / top, eye])
        cones.append(matrix_inequality(-found.first[block, block] / top, above))
    return cones
