"""Profile likelihood of one entry of the gain or one physical parameter.

The number is held at v and everything else (rest of the gain, initial states, other parameters) is
refitted. With F(v) the least -2 log posterior and the factor f >= 1 by which autocorrelation widens
the variance of the number,

    D(v) = (F(v) - F(v*)) / f

is chi-squared with one degree of freedom at the true value, and {v : D(v) <= q} is an interval that
need not be symmetric. Without an end the recordings do not identify the number. For the input limit
see `input_limits`.

An entry of K and a log-parameter are linear in the unknowns z (`GainLaw`), so that the search runs
in the null space of their row.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg
import scipy.optimize
import scipy.special

from impc.arrays import Array, Frozen, frozen
from impc.assess.covariance import gain_covariance
from impc.assess.long_run_covariance import white_noise
from impc.assess.printed_gain import LEVEL, Interval, entry_names
from impc.errors import InputError
from impc.inverse.laws import GainLaw
from impc.inverse.minimiser import PROMISE, Stop
from impc.inverse.unknowns import Unknowns

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.assess.printed_gain import GainEstimate
    from impc.inverse.unknowns import Fitted

# 1 / SD of a prior, far beyond any possible gain, that keeps free directions from drifting.
_WEAK = 1e-2
# Steps, in standard errors, towards an end; if D stays low there is no end.
_STEPS = (1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0)
# Accuracy of an end, and of the minimum in standard errors; evaluations of a point.
_END, _MINIMUM, _EVALUATIONS = 1e-3, 0.02, 40
_ROUNDS = 6


@dataclass(frozen=True)
class Profile(Frozen):
    """Profile of one number."""

    interval: Interval  # Interval with method "profile"
    # Values tried (t,), ascending, and D at each (t,), for figures
    values: Array
    distances: Array


def profile_likelihood(estimate: GainEstimate, name: str) -> Profile:
    """Profile an entry of K (K.<control>.<state>) or a fitted parameter."""
    require_numbers(estimate, [name])
    search = _Search(estimate, name)
    low, high = search.ends(float(scipy.special.chdtri(1, 1 - LEVEL)))
    tried = sorted(search.tried)
    best = search.number(search.best)
    return Profile(
        Interval(name, "profile", LEVEL, best, search.number(low), search.number(high)),
        frozen([search.number(offset) for offset in tried]),
        frozen([search.distance(offset) for offset in tried]),
    )


def require_numbers(estimate: GainEstimate, names: Sequence[str]) -> None:
    """Raise InputError unless each name is an entry of K or a fitted parameter."""
    known = [*entry_names(estimate.problem.plant), *estimate.problem.parameter_names]
    for name in names:
        if name not in known:
            said = f"choose from: {', '.join(known)}"
            raise InputError(f"profile of {name}", "no such entry or parameter", said)


class _Search:
    """Cached fits with the number held at offsets from the estimate."""

    def __init__(self, estimate: GainEstimate, name: str) -> None:
        problem, K = estimate.problem, np.array(estimate.K)
        law = GainLaw(problem, K, np.array(estimate.S))
        self.space, entries = Unknowns(problem, law), entry_names(problem.plant)
        self.is_entry = name in entries
        index = entries.index(name) if self.is_entry else problem.parameter_names.index(name)
        q = len(self.space.start)
        row = np.zeros(q)
        if self.is_entry:
            row[: K.size] = law.gains.reshape(len(law.gains), -1)[:, index]
            self.value = float(K.ravel()[index])
        else:
            row[self.space.parameters.start + index] = self.space.units[index]
            self.value = float(estimate.parameters[index])
        self.step = row / float(row @ row)
        shared = np.delete(row, self.space.trial)
        held = np.flatnonzero(shared)
        # Parameters stay columns of their own: the stated ones have a prior.
        first, last = held[0], held[-1] + 1
        null = scipy.linalg.null_space(shared[None, first:last])
        others = np.eye(first), null, np.eye(len(shared) - last)
        self.along = scipy.linalg.block_diag(*others)
        self.deviation, self.factor = _spread(estimate, self.is_entry, index)
        self.tried: dict[float, Fitted] = {}
        self.objective(0.0)

    def number(self, offset: float) -> float:
        """Number at an offset: of the entry, or of the logarithm of the parameter."""
        if self.is_entry:
            return self.value + offset
        return float(self.value * np.exp(offset)) if offset < 700 else np.inf

    def objective(self, offset: float) -> float:
        """F with the number at this offset, started from the nearest previous fit."""
        if offset not in self.tried:
            z = self.space.start + offset * self.step
            if self.tried:
                near = min(self.tried, key=lambda known: abs(known - offset))
                z = np.array(self.tried[near].z) + (offset - near) * self.step
            stop = Stop(PROMISE, 0.0, _EVALUATIONS)
            self.tried[offset] = self.space.search(
                z, stop, shared=_WEAK, own=_WEAK, along=self.along
            )
        return self.tried[offset].objective

    @property
    def best(self) -> float:
        """Offset of the least F."""
        return min(self.tried, key=lambda offset: self.tried[offset].objective)

    def distance(self, offset: float) -> float:
        """D at an offset."""
        return (self.objective(offset) - self.tried[self.best].objective) / self.factor

    def ends(self, quantile: float) -> tuple[float, float]:
        """Offsets at which D crosses the quantile on either side of its minimum.

        The minimum of the search may lie elsewhere; if a step finds a better one, the bracketing
        restarts there.
        """
        if not np.isfinite(self.deviation):
            return -np.inf, np.inf
        for _ in range(_ROUNDS):
            self._refine()
            origin = self.best
            ends = self._end(origin, -1.0, quantile), self._end(origin, 1.0, quantile)
            if self.best == origin:
                break
        return ends

    def _refine(self) -> None:
        """Refine the minimum between the neighbours of the best offset."""
        tried, best = sorted(self.tried), self.best
        below = max([item for item in tried if item < best], default=best - self.deviation)
        above = min([item for item in tried if item > best], default=best + self.deviation)
        scipy.optimize.minimize_scalar(
            self.objective,
            bounds=(below, above),
            method="bounded",
            options={"xatol": _MINIMUM * self.deviation},
        )

    def _end(self, origin: float, sign: float, quantile: float) -> float:
        """Offset at which D crosses the quantile, infinite if it does not."""

        def excess(offset: float) -> float:
            return self.distance(offset) - quantile

        inside = origin
        for step in _STEPS:
            outside = origin + sign * step * self.deviation
            if excess(outside) > 0:
                accuracy = _END * abs(outside - inside)
                return float(scipy.optimize.brentq(excess, inside, outside, xtol=accuracy))
            inside = outside
        return sign * np.inf


def _spread(estimate: GainEstimate, is_entry: bool, index: int) -> tuple[float, float]:
    """Standard error in units of the offset, and the autocorrelation factor f."""
    at = estimate.problem, np.array(estimate.K), np.array(estimate.S)
    both = estimate.covariance, gain_covariance(*at, white_noise, curvature=True)
    coloured, white = (
        float((np.ravel(one.entries) if is_entry else one.parameters)[index]) for one in both
    )
    if not (np.isfinite(coloured) and white > 0):
        return np.inf, 1.0
    return coloured, max((coloured / white) ** 2, 1.0)
