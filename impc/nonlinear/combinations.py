"""Identifiable combinations of the parameters, by singular values.

To first order the residual changes by J dphi, where phi are the logarithms of positive parameters
and the values of signed ones. Directions of J with zero singular value are unidentified. Written
with as few parameters as possible, their exponents may be those of a scaling (l by a, m by a^-2),
which is verified by simulation at factors of 1.2 and 2; any other direction is the tangent of a
curve and holds only near the estimate. Identified are the products that no scaling changes
(docs/howto/nonlinear.md).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from impc.arrays import Array, BoolArray, Frozen, IntArray
from impc.nonlinear.problem import OptimalControlProblem

# Singular values below this share of the largest count as zero. On four systems the weakest
# identified direction has 3e-4 and the strongest unidentified one, of a bound that is never
# reached, 5e-11 (experiments/nonlinear.md).
_NOTHING = 1e-8
_ROUGH = 0.5  # standard error of a logarithm; twice that is a factor of e
_ROUND = 1e-3  # exponents this close to 0, or to a multiple of 1/6, are rounded
_LARGEST = 4.0  # largest exponent of a scaling; larger ones belong to tangents
# Factors at which a scaling has to hold.
_FACTORS = (1.2, 2.0)


def interval(value: float, deviation: float, additive: bool, level: float) -> tuple[float, float]:
    """Normal interval of a value or of its logarithm."""
    reach = float(scipy.stats.norm.ppf(0.5 + level / 2)) * deviation
    if additive:
        return value - reach, value + reach
    with np.errstate(over="ignore"):
        factor = float(np.exp(reach))
    return value / factor, value * factor


@dataclass(frozen=True)
class Combination:
    """A product of powers of parameters."""

    exponents: dict[str, float]  # by name; of a signed parameter the factor of its difference
    value: float  # of the product at the estimate; 1 if unidentified
    deviation: float  # standard error of its logarithm; infinite if unidentified
    # whether it is a single signed parameter, and `deviation` the standard error of its value
    difference: bool = False
    # if unidentified: whether any factor is possible, verified by simulation; otherwise only near
    # the estimate
    scaling: bool = True

    @property
    def identified(self) -> str:
        """Identified: "yes", "roughly" (95 % interval beyond a factor of e) or "no"."""
        if np.isinf(self.deviation):
            return "no"
        return "roughly" if self.deviation > _ROUGH and not self.difference else "yes"

    @property
    def name(self) -> str:
        """Name such as "m1 l1^2" or "l2 / l1"."""
        over = [_power(name, item) for name, item in self.exponents.items() if item > 0]
        under = [_power(name, -item) for name, item in self.exponents.items() if item < 0]
        return " / ".join([" ".join(over) or "1", *under])

    @property
    def sentence(self) -> str:
        """What an unidentified combination leaves open."""
        if len(self.exponents) == 1:
            (name,) = self.exponents
            return f"{name} is not identified: near its value it affects nothing that was measured."
        if not self.scaling:
            named = ", ".join(self.exponents)
            return f"Near these values the recordings cannot distinguish {named}."
        parts = ", ".join(f"{name} by {_power('a', item)}" for name, item in self.exponents.items())
        return f"Together any factor a is possible: {parts}."


@dataclass(frozen=True, eq=False)
class Combinations(Frozen):
    """Identified and unidentified combinations of the parameters."""

    identified: tuple[Combination, ...]  # with `unidentified` as many as there are parameters
    unidentified: tuple[Combination, ...]
    singular_values: Array  # (p,), decreasing
    # standard error of each logarithm or signed parameter (p,); infinite if it is part of an
    # unidentified combination
    deviations: Array

    @property
    def sentences(self) -> tuple[str, ...]:
        """One sentence per unidentified combination, one on identified, one on rough ones."""
        found = [one.sentence for one in self.unidentified]
        kinds = {"yes": "Identified", "roughly": "Identified roughly (see the intervals)"}
        for kind, words in kinds.items():
            values = [
                f"{one.name} = {one.value:.6g}"
                for one in self.identified
                # Products with larger exponents have no meaning for a reader.
                if one.identified == kind and np.max(np.abs([*one.exponents.values()])) <= _LARGEST
            ]
            found += [f"{words}: {', '.join(values)}."] if values else []
        return (*found, *(() if self.identified else ("Nothing is identified.",)))


def combinations(
    problem: OptimalControlProblem,
    theta: Array,
    jacobian: Array,
    residual: Array,
    signals: IntArray,
    holds: Callable[[Array], bool],
) -> Combinations:
    """Split parameters (p,) by `jacobian` (r, k); `holds` (p,) simulates a scaling."""
    p, positive = len(theta), problem.positive
    own, rest = jacobian[:, :p], jacobian[:, p:]
    if rest.shape[1]:
        own = own - rest @ np.linalg.lstsq(rest, own, rcond=None)[0]
    _, values, right = np.linalg.svd(own, full_matrices=True)
    values = np.append(values, np.zeros(p - len(values)))
    # The threshold is independent of the noise: what is known to a factor of ten is identified
    # roughly, and the set of identified products does not change between recordings.
    identified = values > _NOTHING * values[0]
    covariance = _covariance(jacobian, residual, signals, int(np.sum(~identified)))[:p, :p]
    basis, pivots = _sparse(right[~identified])

    def named(row: Array) -> dict[str, float]:
        pairs = zip(problem.parameter_names, row, strict=True)
        return {name: float(item) for name, item in pairs if item != 0}

    unidentified = []
    for row in basis:
        scaled = row / np.min(np.abs(row[row != 0]))
        scaling = _is_scaling(scaled, theta, positive, holds)
        unidentified.append(Combination(named(scaled), 1.0, np.inf, scaling=scaling))
    kept = []
    logarithms = np.where(positive, np.log(np.abs(theta)), theta)
    for index in sorted(set(range(p)) - set(pivots)):
        exponents = np.eye(p)[index]
        exponents[pivots] = -basis[:, index]
        deviation = float(np.sqrt(max(exponents @ covariance @ exponents, 0.0)))
        single = bool(np.count_nonzero(exponents) == 1 and not positive[index])
        value = float(theta[index] if single else np.exp(exponents @ logarithms))
        kept.append(Combination(named(exponents), value, deviation, single))
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    deviations[np.any(basis != 0, axis=0)] = np.inf
    return Combinations(tuple(kept), tuple(unidentified), values, deviations)


def _is_scaling(
    row: Array, theta: Array, positive: BoolArray, holds: Callable[[Array], bool]
) -> bool:
    if np.count_nonzero(row) == 1:
        return True
    if np.max(np.abs(row)) > _LARGEST or np.any(row[~positive]):
        return False
    return all(holds(theta * factor**row) for factor in _FACTORS)


def _covariance(jacobian: Array, residual: Array, signals: IntArray, unidentified: int) -> Array:
    """Covariance of the estimate in identified directions, by the residuals of each signal."""
    left, values, right = np.linalg.svd(jacobian, full_matrices=False)
    rank = len(values) - unidentified
    gains = right[:rank].T @ (left[:, :rank] / values[:rank]).T
    freedom = max(len(residual) - rank, 1)
    variance = np.zeros(len(residual))
    for signal in np.unique(signals):
        own = signals == signal
        variance[own] = np.mean(residual[own] ** 2) * len(residual) / freedom
    return np.asarray((gains * variance) @ gains.T)


def _sparse(basis: Array) -> tuple[Array, list[int]]:
    """Basis of the same space (k, p) whose rows are one in a column where the others are zero."""
    columns = scipy.linalg.qr(basis, mode="r", pivoting=True)[1][: len(basis)]
    rows, pivots = np.linalg.solve(basis[:, columns], basis), []
    rows[np.abs(rows) < _ROUND] = 0.0
    for index, row in enumerate(rows):  # divide by the smallest entry: exponents become integers
        alone = np.flatnonzero((row != 0) & (np.count_nonzero(rows, axis=0) == 1))
        sizes = np.abs(row[alone])
        pivots.append(int(alone[sizes < np.min(sizes) * (1 + _ROUND)][0]))
        rows[index] = row / row[pivots[-1]]
    whole = np.round(6 * rows) / 6
    return np.where(np.abs(rows - whole) < _ROUND, whole, rows), pivots


def _power(name: str, exponent: float) -> str:
    return name if exponent == 1 else f"{name}^{exponent:.3g}"
