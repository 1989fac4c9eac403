"""Profile likelihood of one entry of the gain or one physical parameter.

The number is fixed at v and everything else (rest of the gain, initial states, other parameters) is
refitted. With the misfit m(v), the residual variance s^2 and the factor f >= 1 by which
autocorrelation widens the variance of the number,

    D(v) = (m(v)^2 - m(v*)^2) / (s^2 f)

is chi-squared with one degree of freedom at the true value, and {v : D(v) <= q} is an interval that
need not be symmetric. Without an end the recordings do not identify the number. For the input limit
see `input_limits`.

A log-parameter is affine in the coordinates z of the search (`Coordinates`), an entry of K in those
of the gain at a fixed metric. With a' the derivative of the number at the start, the search runs in
the null space of a', and each point is moved back to the fixed number along one direction.
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
from impc.inverse.coordinates import Coordinates

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from impc.assess.printed_gain import GainEstimate

# Prior width, far beyond any possible gain, that keeps free directions from drifting.
_WIDTH = 100.0
# Steps, in standard errors, towards an end; if D stays low there is no end.
_STEPS = (1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0)
_END = 1e-3
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
    quantile = float(scipy.special.chdtri(1, 1 - LEVEL))
    ends = search.ends(quantile)
    tried = sorted(search.tried)
    low, high = (search.number(offset) for offset in ends)
    best = search.number(search.best_offset())
    return Profile(
        Interval(name, "profile", LEVEL, best, low, high),
        frozen([search.number(offset) for offset in tried]),
        frozen([search.distance(offset) for offset in tried]),
    )


def require_numbers(estimate: GainEstimate, names: Sequence[str]) -> None:
    """Raise InputError unless each name is an entry of K or a fitted parameter."""
    family = estimate.problem.family
    known = [*entry_names(estimate.problem.plant), *(() if family is None else family.names)]
    for name in names:
        if name not in known:
            said = f"choose from: {', '.join(known)}"
            raise InputError(f"profile of {name}", "no such entry or parameter", said)


class _Search:
    """Cached fits with the number fixed; offsets from the fit are in units of z."""

    def __init__(self, estimate: GainEstimate, name: str) -> None:
        problem = estimate.problem
        self.space = Coordinates(problem, np.array(estimate.K), np.array(estimate.S))
        self.held, self.number = _functional(estimate, self.space, name)
        _, direction = self.held(self.space.start)
        self.null = scipy.linalg.null_space(direction[None])
        # Only along gain or parameter, where the number is affine.
        own = (
            slice(0, self.space.ends[0]) if np.any(direction[: self.space.ends[0]]) else slice(None)
        )
        self.unit = np.zeros_like(direction)
        self.unit[own] = direction[own] / float(direction[own] @ direction[own])
        self.samples = problem.recorded_numbers
        misfit = float(np.linalg.norm(self.space.at(self.space.start).residual))
        self.noise = max(misfit, 1e-12) / np.sqrt(self.samples)
        self.centre = self.space.centre
        self.pull = np.full(len(self.centre), self.noise / _WIDTH)
        self.stated = int(self.space.ends[2]) + np.flatnonzero(self.space.stated)
        self.pull[self.stated] = self.noise
        self.tried: dict[float, tuple[float, Array]] = {}
        self.squared(0.0)
        self.deviation, self.factor = _spread(estimate, name)

    def squared(self, offset: float) -> float:
        """m^2 with the number at this offset, started from the nearest previous fit."""
        if offset not in self.tried:
            if self.tried:
                near = min(self.tried, key=lambda known: abs(known - offset))
                start = self.null.T @ (self.tried[near][1] - self.space.start)
            else:
                start = np.zeros(self.null.shape[1])

            def residual(w: Array) -> Array:
                z, _ = self._at(offset, w)
                away = self.pull * (z - self.centre)
                return np.concatenate([self.space.at(z).residual, away])

            def derivative(w: Array) -> Array:
                z, along = self._at(offset, w)
                return np.vstack([self.space.at(z).jacobian @ along, self.pull[:, None] * along])

            found = scipy.optimize.least_squares(
                residual, start, jac=derivative, ftol=1e-8, max_nfev=40
            )
            z, _ = self._at(offset, found.x)
            held = self.noise * (z - self.centre)[self.stated]
            self.tried[offset] = (float(np.sum(self.space.at(z).residual ** 2) + held @ held), z)
        return self.tried[offset][0]

    def _at(self, offset: float, w: Array) -> tuple[Array, Array]:
        """Point with the number at the offset, and its derivative by w."""
        z = self.space.start + offset * self.unit + self.null @ w
        value, slope = self.held(z)
        here = float(slope @ self.unit)
        z = z + (offset - value) / here * self.unit
        _, slope = self.held(z)
        return z, self.null - np.outer(self.unit, slope @ self.null) / float(slope @ self.unit)

    def best_offset(self) -> float:
        return min(self.tried, key=lambda offset: self.tried[offset][0])

    def distance(self, offset: float) -> float:
        """D at an offset."""
        least = self.tried[self.best_offset()][0]
        return float((self.squared(offset) - least) / (self.noise**2 * self.factor))

    def ends(self, quantile: float) -> list[float]:
        """Offsets at which D crosses the quantile on either side of its minimum.

        The search had a prior that the profile ignores, so its minimum may lie elsewhere; if a step
        finds a better one, the bracketing restarts there.
        """
        ends: list[float] = []
        for _ in range(_ROUNDS):
            self._refine()
            origin = self.best_offset()
            ends = [self._end(origin, sign, quantile) for sign in (-1.0, 1.0)]
            if self.best_offset() == origin:
                break
        return ends

    def _refine(self) -> None:
        """Refine the minimum between the neighbours of the best offset."""
        if not np.isfinite(self.deviation):
            return
        tried, best = sorted(self.tried), self.best_offset()
        below = max([item for item in tried if item < best], default=best - self.deviation)
        above = min([item for item in tried if item > best], default=best + self.deviation)
        scipy.optimize.minimize_scalar(
            self.squared,
            bounds=(below, above),
            method="bounded",
            options={"xatol": 0.02 * self.deviation},
        )

    def _end(self, origin: float, sign: float, quantile: float) -> float:
        """Offset at which D crosses the quantile, infinite if it does not."""
        if not np.isfinite(self.deviation):
            return sign * np.inf
        inside = origin
        for step in _STEPS:
            outside = origin + sign * step * self.deviation
            if self.distance(outside) > quantile:
                return _crossing(self.distance, inside, outside, quantile)
            inside = outside
        return sign * np.inf


def _functional(
    estimate: GainEstimate, space: Coordinates, name: str
) -> tuple[Callable[[Array], tuple[float, Array]], Callable[[float], float]]:
    """Functions: offset of the number at z with its derivative; number at an offset."""
    entries = entry_names(estimate.problem.plant)
    if name in entries:
        control, state = divmod(entries.index(name), space.n)
        value = float(estimate.K[control, state])

        def entry(z: Array) -> tuple[float, Array]:
            here = space.unpack(z)
            return float(here.K[control, state]) - value, space.changes(here, z)[0][
                :, control, state
            ]

        return entry, lambda offset: value + offset
    family = estimate.problem.family
    assert family is not None  # see `require_numbers`
    index = family.names.index(name)
    row = np.zeros(int(space.ends[-1]))
    row[int(space.ends[2]) + index] = space.units[index]
    value = float(estimate.parameters[index])

    def parameter(z: Array) -> tuple[float, Array]:
        return float(row @ (z - space.start)), row

    return parameter, lambda offset: float(value * np.exp(offset)) if offset < 700 else np.inf


def _spread(estimate: GainEstimate, name: str) -> tuple[float, float]:
    """Standard error in units of the offset, and the autocorrelation factor f."""
    coloured = estimate.covariance
    at = estimate.problem, np.array(estimate.K), np.array(estimate.S)
    white = gain_covariance(*at, white_noise, curvature=True)
    entries = entry_names(estimate.problem.plant)
    if name in entries:
        index = entries.index(name)
        pair = np.ravel(coloured.entries)[index], np.ravel(white.entries)[index]
    else:
        family = estimate.problem.family
        assert family is not None
        index = family.names.index(name)
        pair = coloured.parameters[index], white.parameters[index]
    deviation, plain = float(pair[0]), float(pair[1])
    if not (np.isfinite(deviation) and plain > 0):
        return np.inf, 1.0
    return deviation, max((deviation / plain) ** 2, 1.0)


def _crossing(
    distance: Callable[[float], float], inside: float, outside: float, quantile: float
) -> float:
    found = scipy.optimize.brentq(
        lambda offset: distance(offset) - quantile,
        inside,
        outside,
        xtol=_END * abs(outside - inside),
    )
    return float(found)
