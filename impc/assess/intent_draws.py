"""Gains that the recordings allow beside the fitted one, and what of the intent holds for them too.

A statement over all weights with *the* fitted gain forgets that the gain is an estimate. Here gains
are drawn, each that of some weights X = L exp(D) L', LL' = blkdiag(Q, R) those of the fit:

    log p(D) = -1/2 sum_i (d_i' vec(G^-1 (K(X) - K) T) / s_i)^2 - 1/2 |D|^2 / ln(10)^2 + const

K the estimate (`gain_estimate`), d_i, s_i, G and T those of its `GainCovariance`; what the
recordings do not identify is limited to weights of the same order of magnitude by the second term.
Draws are made by elliptical slice sampling (Murray, Adams and MacKay 2010) about the linearised
posterior, so that the curvature of K(X) counts.

The range of 39 draws holds the next one in 38 of 40 cases: 95 %. A statement is made when it holds
for all weights with the fitted gain and, of those drawn, in all but one at most.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from impc.arrays import Array
from impc.assess.bounded_weights import linear_maxima, linear_ranges, weights_set
from impc.assess.intent_statements import weight_direction
from impc.checking import replace
from impc.errors import SolverError, WeightsError
from impc.inverse.proximal_step import block_basis
from impc.inverse.solution_set import gain_fibre
from impc.model.riccati import gain_gradients, solve_lqr
from impc.model.weights import Weights

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from impc.assess.covariance import GainCovariance
    from impc.assess.intent_statements import Statement
    from impc.model.plant import Plant
    from impc.model.riccati import LqrSolution

#: Draws whose range is an interval of 95 %.
DRAWS = 39
# Of the logarithm of weights that nothing identifies: a factor of ten.
_DECADE = np.log(10.0)
# Steps of the sampler between two draws that are used.
_STEPS = 6
# Share of P that the last doubling may add: the next would add its square.
_ENOUGH = 1e-9
_DOUBLINGS = 60
# Of a drawn gain's programs: the range of 39 draws is itself a rough one, and a program takes four
# fifths of the time of those for the fitted gain.
_ROUGH = 1e-6
# Natural units of the gain: an exact recording is no sharper than rounding and search leave it.
_SHARPEST = 1e-6


@dataclass(frozen=True)
class WeightRange:
    """Cost weight of a typical excursion of a state, d^2 Q_ii at trace R = m."""

    state: str  # Its name
    low: float  # Over all weights with the fitted gain, in the cost's unit
    high: float
    low_drawn: float  # Over all weights with any gain drawn: 95 %
    high_drawn: float


@dataclass(frozen=True)
class DrawnSet:
    """The weights of a drawn gain, and what holds for all of them."""

    # Those of least condition number; None where the programs fail: nothing is known of this gain's
    # weights
    least: Weights | None
    # Least and largest cost weight of a typical excursion of each state that was asked for
    cost_weights: tuple[tuple[float, float], ...]
    agrees: tuple[bool, ...]  # Whether each statement that was asked for says the same here


def drawn_gains(
    plant: Plant,
    weights: Weights,
    gain: Array,
    covariance: GainCovariance,
    count: int = DRAWS,
) -> tuple[LqrSolution, ...]:
    """Regulators whose gains the recordings allow; `gain` (m, n)."""
    rng = np.random.default_rng(0)
    n = plant.n
    factor: Array = np.asarray(np.linalg.cholesky(weights.block), dtype=np.float64)
    centre = solve_lqr(plant, weights)
    deviations = np.maximum(np.array(covariance.deviations), _SHARPEST)
    basis, left, values = _directions(centre, factor, covariance, deviations)
    spread = 1 / np.sqrt(values**2 + 1 / _DECADE**2)
    # The linearised posterior has its mean where weights come nearest to the estimate.
    wrong = covariance.along(centre.K - gain) / deviations
    mean = -spread * values * (left.T @ wrong)[: len(values)]

    def weights_at(a: Array) -> tuple[Array, Array]:
        step = np.tensordot((mean + a) * spread, basis, 1)
        X = factor @ scipy.linalg.expm(step) @ factor.T
        return X[:n, :n], X[n:, n:]

    def excess(a: Array) -> float:
        """Logarithm of the density over that of the linearised posterior, in which a ~ N(0, I)."""
        K = _gain(plant, *weights_at(a))
        if K is None:
            return -np.inf
        off, far = covariance.along(K - gain) / deviations, (mean + a) * spread / _DECADE
        return float(a @ a - off @ off - far @ far) / 2

    a: Array = np.zeros(len(spread))
    here = excess(a)
    drawn = []
    for _ in range(count):
        for _ in range(_STEPS):
            a, here = _slice(a, here, excess, rng)
        drawn.append(solve_lqr(plant, Weights(*weights_at(a))))
    return tuple(drawn)


def _directions(
    centre: LqrSolution, factor: Array, covariance: GainCovariance, deviations: Array
) -> tuple[Array, Array, Array]:
    """Steps D that move the gain (k, n + m, n + m), and the left singular vectors and values."""
    n, m = centre.plant.n, centre.plant.m
    basis = block_basis(n, m)
    moved = factor @ basis @ factor.T
    slopes = gain_gradients(centre)
    dK = np.einsum("abij,kij->kab", slopes.Q, moved[:, :n, :n])
    dK += np.einsum("abij,kij->kab", slopes.R, moved[:, n:, n:])
    derivative = np.array([covariance.along(one) for one in dK]).T
    # Along what leaves the gain as it is nothing need move: the set of weights has all of it.
    _, _, moving = np.linalg.svd(derivative, full_matrices=False)
    left, values, rows = np.linalg.svd(derivative @ moving.T / deviations[:, None])
    return np.tensordot(rows, np.tensordot(moving, basis, 1), 1), left, values


def with_confidence(
    statements: tuple[Statement, ...], sets: tuple[DrawnSet, ...]
) -> tuple[Statement, ...]:
    """Statements with the share of the drawn gains for which they hold as well."""
    shares = np.mean([one.agrees for one in sets], axis=0)
    return tuple(
        item if item.holds is None else replace(item, confidence=float(share))
        for item, share in zip(statements, shares, strict=True)
    )


def weights_over_gains(
    own: Mapping[str, tuple[float, float]], sets: tuple[DrawnSet, ...]
) -> tuple[WeightRange, ...]:
    """Cost weights of some states, over the weights of the fitted gain and of those drawn."""
    result = []
    for position, (name, (low, high)) in enumerate(own.items()):
        ends = [one.cost_weights[position] for one in sets]
        widest = min([low, *(end[0] for end in ends)]), max([high, *(end[1] for end in ends)])
        result.append(WeightRange(name, low, high, *widest))
    return tuple(result)


def set_of_gain(
    plant: Plant,
    solution: LqrSolution,
    metrics: Array,
    ratio: float,
    sizes: Array,
    states: tuple[str, ...],
    statements: tuple[Statement, ...],
) -> DrawnSet:
    """What holds for all weights of a drawn gain; `metrics` (k, m, m); `sizes` (n,)."""
    tried = [item for item in statements if item.holds is not None]
    try:
        own = np.concatenate([np.array(solution.S)[None], metrics[1:]])
        # Nothing is searched from these: only how far they reach is asked for.
        found = weights_set(gain_fibre(plant, solution.K, own), ratio, rough=True)
        penalised = np.array([weight_direction(plant, sizes, name) for name in states])
        ranges = linear_ranges(found, penalised, tolerance=_ROUGH)
        against = np.array([_against(item, plant, sizes) for item in tried])
        most = linear_maxima(found, against, tolerance=_ROUGH) if tried else ()
    except (WeightsError, SolverError):
        return DrawnSet(None, ((0.0, np.inf),) * len(states), (False,) * len(statements))
    holding = iter([end.value < 0 for end in most])
    agrees = tuple(item.holds is not None and next(holding) for item in statements)
    return DrawnSet(found.least.weights, tuple((one.low, one.high) for one in ranges), agrees)


def _against(item: Statement, plant: Plant, sizes: Array) -> Array:
    """The linear function that is below zero for every member of a set where a statement holds."""
    if item.kind == "order":
        direction = weight_direction(plant, sizes, item.first)
        direction -= weight_direction(plant, sizes, item.second)
    else:
        i, j = plant.states.index(item.first), plant.states.index(item.second)
        direction = np.zeros((plant.n + plant.m, plant.n + plant.m))
        direction[i, j] = direction[j, i] = sizes[i] * sizes[j] / 2
    return -direction if item.holds else direction


def _gain(plant: Plant, Q: Array, R: Array) -> Array | None:
    """K (m, n) to eight digits by doubling (Chu et al. 2004); None where it does not converge.

    The sampler asks for three thousand gains, in a third of the time of `solve_lqr`; those that it
    returns are solved for to the last digit.
    """
    A, B, P = plant.A, plant.B, Q
    G = B @ np.linalg.solve(R, B.T)
    n, unit = len(A), np.eye(len(A))
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_DOUBLINGS):
            right = np.linalg.solve(unit + G @ P, np.hstack([A, G]))
            ahead, beside = right[:, :n], right[:, n:]
            more = A.T @ P @ ahead
            A, G, P = A @ ahead, G + A @ beside @ A.T, P + more
            size = np.max(np.abs(P))
            if not np.isfinite(size):
                return None
            if np.max(np.abs(more)) <= _ENOUGH * size:
                return np.asarray(np.linalg.solve(R + B.T @ P @ B, B.T @ P @ plant.A))
    return None


def _slice(
    a: Array, here: float, excess: Callable[[Array], float], rng: np.random.Generator
) -> tuple[Array, float]:
    """One step of elliptical slice sampling from N(0, I) times exp(excess); `here` is excess(a)."""
    other = rng.standard_normal(len(a))
    level = here + np.log(rng.uniform())
    angle = rng.uniform(0, 2 * np.pi)
    low, high = angle - 2 * np.pi, angle
    while True:
        moved = a * np.cos(angle) + other * np.sin(angle)
        there = excess(moved)
        if high - low < 1e-9:
            return a, here
        if there > level:
            return moved, there
        low, high = (angle, high) if angle < 0 else (low, angle)
        angle = rng.uniform(low, high)
