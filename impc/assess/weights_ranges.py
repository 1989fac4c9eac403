"""Statements on cost that hold for all equivalent weights, and the ranges of their entries.

All weights with the fitted gain and a condition number up to a multiple of the least, in the units
of the plant, explain the recordings equally well (`weights_set`; docs/why/equivalent_weights.md). A
statement is useful if it holds for every one of them.

    cost       d_i^2 Q_ii: cost of a typical excursion d_i of state i
    order      cost of i above cost of j: the sign of a linear function, decided exactly
    sense      Q_ij above or below zero: equal or opposite signs of two states cost more

A statement over all weights with *the* fitted gain ignores the uncertainty of that gain, so it is
checked with drawn gains too (`drawn_gains`). The range of 39 draws covers the next one in 38 of 40
cases (95 %): a statement is supported if it holds for all weights with the fitted gain and with at
least 38 of the 39 drawn gains.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from impc.arrays import Array, BoolArray
from impc.assess.bounded_weights import (
    WeightsSet,
    all_negative,
    entry_ranges,
    linear_ranges,
    set_near,
    weights_set,
)
from impc.assess.covariance import GainCovariance
from impc.assess.intent import angle_between, dominant_direction
from impc.assess.printed_gain import GainEstimate
from impc.checking import replace
from impc.errors import SolverError, WeightsError
from impc.inverse.proximal_step import block_basis
from impc.inverse.solution_set import gain_fibre, split_blocks
from impc.model.plant import Plant
from impc.model.riccati import LqrSolution, gain_gradients, solve_lqr
from impc.model.weights import Weights

# Largest condition number in the set, as a multiple of the least.
_RATIO = 10.0
# Number of states shown: recorded ones, then those that cost most at their typical size.
_NAMED = 4
# A range that ends this close to zero, relative to its width, leaves the sign undecided.
_TOUCHES = 1e-6
# 38 of 39 draws.
_AGREE = 38 / 39 - 1e-9


@dataclass(frozen=True)
class Statement:
    """A statement about two states."""

    kind: str  # "order" or "sense"
    first: str  # Names of the states
    second: str
    holds: bool | None  # True or False if all members agree; otherwise None
    # Range of the linear function whose sign decides, over the cost of `first` in the member of
    # least condition number
    low: float
    high: float
    confidence: float | None = None  # Share of the drawn gains that agree; None if not checked

    @property
    def made(self) -> bool:
        """Whether the statement is supported at 95 %: at least 38 of 39 drawn gains agree."""
        return self.confidence is not None and self.confidence >= _AGREE


def statement_function(plant: Plant, sizes: Array, kind: str, first: str, second: str) -> Array:
    """Linear function of blkdiag(Q, R) that is positive if a statement holds (n + m, n + m)."""
    i, j = plant.states.index(first), plant.states.index(second)
    function = np.zeros((plant.n + plant.m, plant.n + plant.m))
    if kind == "order":
        function[i, i], function[j, j] = sizes[i] ** 2, -(sizes[j] ** 2)
    else:
        function[i, j] = function[j, i] = sizes[i] * sizes[j] / 2
    return function


def pair_statements(
    found: WeightsSet, sizes: Array, states: tuple[str, ...]
) -> tuple[Statement, ...]:
    """Order and sense of every pair of the given states; no member goes beyond their ranges."""
    plant, pairs = found.fibre.plant, list(itertools.combinations(states, 2))
    asked = [(kind, *pair) for kind in ("order", "sense") for pair in pairs]
    functions = [statement_function(plant, sizes, *one) for one in asked]
    statements = []
    for one, ends in zip(asked, linear_ranges(found, np.array(functions)), strict=True):
        low, high = ends.least.bound, ends.most.bound
        touches = _TOUCHES * max(abs(low), abs(high))
        holds = True if low > touches else False if high < -touches else None
        index = plant.states.index(one[1])
        unit = float(found.least.weights.Q[index, index] * sizes[index] ** 2)
        statements.append(Statement(*one, holds, low / unit, high / unit))
    return tuple(statements)


@dataclass(frozen=True)
class EntryRange:
    """Range of Q_ij over the set."""

    first: str  # Names of the states i and j
    second: str
    low: float  # At trace R = m
    high: float


@dataclass(frozen=True)
class WeightsSummary:
    """Set of equivalent weights of a gain."""

    entries: tuple[EntryRange, ...]  # Entries of the states that are recorded or cost most
    statements: tuple[Statement, ...]  # Order and sense of these states
    # Widest angle between the dominant directions of D Q D of the least-condition member and of the
    # members at the ends of the ranges, degrees; D = typical sizes of the states. Others may turn
    # further.
    widest_angle: float
    drawn: int  # Number of drawn gains; 0 if no statement holds for the gain itself


def summarise_weights(
    plant: Plant,
    gain: Array,
    metrics: Array,
    sizes: Array,
    draw: Callable[[], tuple[LqrSolution, ...]] = tuple,
    each: Callable[..., Iterable[BoolArray]] = map,
) -> WeightsSummary:
    """Summarise the set of weights of a gain.

    If a statement holds for it, other gains are drawn, over which `each` maps the check.
    """
    found = weights_set(gain_fibre(plant, gain, metrics), _RATIO)
    named = _shown(plant, found.least.weights, sizes)
    names = tuple(plant.states[index] for index in named)
    ranges = entry_ranges(found, named)
    ends = [end.weights for item in ranges.values() for end in (item.least, item.most)]
    first, *others = [
        dominant_direction(sizes[:, None] * one.Q * sizes) for one in (found.least.weights, *ends)
    ]
    angle = max(angle_between(first, other) for other in others)
    statements = pair_statements(found, sizes, names) if len(names) > 1 else ()
    decided = [item for item in statements if item.holds is not None]
    # Functions that are negative for every member if the statement holds.
    against = [
        (-1 if item.holds else 1)
        * statement_function(plant, sizes, item.kind, item.first, item.second)
        for item in decided
    ]
    agreed = functools.partial(_agreed, found, metrics, against)
    draws = draw() if decided else ()
    if draws:
        shares = dict(zip(decided, np.mean(list(each(agreed, draws)), axis=0), strict=True))
        statements = tuple(
            replace(item, confidence=float(shares[item])) if item in shares else item
            for item in statements
        )
    entries = tuple(
        EntryRange(plant.states[i], plant.states[j], item.low, item.high)
        for (i, j), item in ranges.items()
    )
    return WeightsSummary(entries, statements, angle, len(draws))


def weights_summary_or_reason(
    plant: Plant,
    gain: Array,
    metrics: Array,
    sizes: Array,
    draw: Callable[[], tuple[LqrSolution, ...]] = tuple,
    each: Callable[..., Iterable[BoolArray]] = map,
) -> tuple[WeightsSummary | None, str]:
    """Summary and "", or None and the reason."""
    try:
        return summarise_weights(plant, gain, metrics, sizes, draw, each), ""
    except (WeightsError, SolverError) as error:
        return None, str(error)


def _agreed(
    fitted: WeightsSet, metrics: Array, against: Sequence[Array], solution: LqrSolution
) -> BoolArray:
    """Which functions are negative for all weights of a drawn gain; `metrics` (k, m, m)."""
    try:
        own = np.concatenate([np.array(solution.S)[None], metrics[1:]])
        found = set_near(fitted, gain_fibre(solution.plant, solution.K, own))
        functions, member = np.array(against), found.least.weights.block
        holds = np.tensordot(functions, member, ([1, 2], [0, 1])) < 0
        # A member that breaks a statement decides it without a program.
        if np.any(holds):
            holds[holds] = all_negative(found, functions[holds])
    except (WeightsError, SolverError):
        return np.zeros(len(against), dtype=bool)
    return holds


def _shown(plant: Plant, weights: Weights, sizes: Array) -> list[int]:
    """Recorded states and their rates, then those with the largest costs."""
    cost_weights = np.diag(weights.Q) * np.asarray(sizes) ** 2
    known = {*plant.outputs, *(f"{name}_rate" for name in plant.outputs)}
    recorded = [index for index, name in enumerate(plant.states) if name in known]
    others = [int(index) for index in np.argsort(-cost_weights, kind="stable")]
    return sorted(list(dict.fromkeys([*recorded, *others]))[:_NAMED])


#: Number of draws whose range is a 95 % interval.
DRAWS = 39
# Prior SD of log weights: a factor of ten.
_DECADE = np.log(10.0)
# Sampler steps between two draws.
_STEPS = 6
# Convergence of P: the next doubling would add the square of this share.
_ENOUGH = 1e-9
_DOUBLINGS = 60
# Least standard error in whitened units: exact data are limited by rounding and search.
_SHARPEST = 1e-6


def estimate_draws(
    plant: Plant, weights: Weights, estimate: GainEstimate
) -> tuple[LqrSolution, ...]:
    """Regulators with gains within the uncertainty of an estimate, in equal parts of its ends.

    All are regulators of the fitted `plant`: the sets of their weights are those of that plant.
    """
    ends = (estimate, *estimate.rivals)[:DRAWS]
    count = -(-DRAWS // len(ends))
    drawn = [drawn_gains(plant, weights, end.K, end.covariance, count) for end in ends]
    return tuple(one for each in zip(*drawn, strict=True) for one in each)[:DRAWS]


def drawn_gains(
    plant: Plant,
    weights: Weights,
    gain: Array,
    covariance: GainCovariance,
    count: int = DRAWS,
) -> tuple[LqrSolution, ...]:
    """Regulators with gains within the uncertainty of `gain` (m, n), those of X = L exp(D) L'.

        log p(D) = -1/2 sum_i (d_i' vec(G^-1 (K(X) - K) T) / s_i)^2 - 1/2 |D|^2 / ln(10)^2 + const

    LL' = blkdiag(Q, R) is the fit, K the estimate (`gain_estimate`), d_i, s_i, G and T those of its
    `GainCovariance`; the second term limits unidentified directions to weights of the same order of
    magnitude. Sampling is elliptical slice sampling (Murray, Adams and MacKay 2010) about the
    linearised posterior, so that the curvature of K(X) counts.
    """
    rng = np.random.default_rng(0)
    n = plant.n
    factor: Array = np.asarray(np.linalg.cholesky(weights.block), dtype=np.float64)
    centre = solve_lqr(plant, weights)
    deviations = np.maximum(np.array(covariance.deviations), _SHARPEST)
    basis, left, values = _directions(centre, factor, covariance, deviations)
    spread = 1 / np.sqrt(values**2 + 1 / _DECADE**2)
    # The linearised posterior has its mean at the weights nearest to the estimate.
    wrong = covariance.along(centre.K - gain) / deviations
    mean = -spread * values * (left.T @ wrong)[: len(values)]

    def block_at(a: Array) -> Array:
        values, vectors = np.linalg.eigh(np.tensordot((mean + a) * spread, basis, 1))
        root = factor @ vectors * np.exp(values / 2)
        return np.asarray(root @ root.T)

    def excess(a: Array) -> float:
        """Log density relative to the linearised posterior, in which a ~ N(0, I)."""
        X = block_at(a)
        K = _gain(plant, X[:n, :n], X[n:, n:])
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
        drawn.append(solve_lqr(plant, split_blocks(block_at(a), n)))
    return tuple(drawn)


def _directions(
    centre: LqrSolution, factor: Array, covariance: GainCovariance, deviations: Array
) -> tuple[Array, Array, Array]:
    """Steps D that move the gain (k, n + m, n + m), left singular vectors, singular values."""
    n, m = centre.plant.n, centre.plant.m
    basis = block_basis(n, m)
    moved = factor @ basis @ factor.T
    slopes = gain_gradients(centre)
    dK = np.einsum("abij,kij->kab", slopes.Q, moved[:, :n, :n])
    dK += np.einsum("abij,kij->kab", slopes.R, moved[:, n:, n:])
    derivative = np.array([covariance.along(one) for one in dK]).T
    # Steps that keep the gain are covered by the set of weights.
    _, _, moving = np.linalg.svd(derivative, full_matrices=False)
    left, values, rows = np.linalg.svd(derivative @ moving.T / deviations[:, None])
    return np.tensordot(rows, np.tensordot(moving, basis, 1), 1), left, values


def _gain(plant: Plant, Q: Array, R: Array) -> Array | None:
    """K (m, n) to eight digits by doubling (Chu et al. 2004), or None: a third of the time."""
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
    """One step of elliptical slice sampling from N(0, I) exp(excess); `here` is excess(a)."""
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
