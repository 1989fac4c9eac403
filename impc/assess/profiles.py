"""Profile likelihood of one number behind a fit: an entry of the gain, or a physical parameter.

The number is held at a value v and everything else - the rest of the gain, initial states, other
parameters - is fitted again. With m(v) the misfit that is left, s^2 the variance of a residual and
f >= 1 the factor by which the colour of the residuals widens the variance of the number,

    D(v) = (m(v)^2 - m(v*)^2) / (s^2 f)

is chi-squared with one degree of freedom at the true value, and {v : D(v) <= q} is an interval that
need not be symmetric and is not fooled by curvature. It ends nowhere if the misfit stays: then the
recordings do not determine the number. The input limit has a module of its own, `unknown_limit`.
docs/fitting.md says how often the interval covers the truth.

A parameter's logarithm is affine in the coordinates z of the search (`Coordinates`), an entry of K
in those of the gain while the metric stands. With a' the number's derivative at the start, the
search goes on in the null space of a', and each point is brought back to the number along one
direction.
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

# A prior this much wider than any gain that can be keeps free directions from drifting off.
_WIDTH = 100.0
# Steps, in deviations, of the walk that looks for the ends; where D is still low at the last one
# the recordings set no end.
_STEPS = (1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0)
_END = 1e-3
_ROUNDS = 6


@dataclass(frozen=True)
class Profile(Frozen):
    """Profile of one number."""

    interval: Interval  # Method "profile"
    # Values tried (t,), ascending, in the number's unit, and D at each (t,), for a picture
    values: Array
    distances: Array


def profile_likelihood(estimate: GainEstimate, name: str) -> Profile:
    """Profile an entry of K (name K.<control>.<state>) or a parameter fitted with it."""
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
    """Require that every name is of an entry of K or a parameter that was fitted."""
    family = estimate.problem.family
    known = [*entry_names(estimate.problem.plant), *(() if family is None else family.names)]
    for name in names:
        if name not in known:
            said = f"known: {', '.join(known)}"
            raise InputError(f"profile of {name}", "there is no such number", said)


class _Search:
    """Fits with the number held, remembered; offsets are from the fit's, in z units."""

    def __init__(self, estimate: GainEstimate, name: str) -> None:
        problem = estimate.problem
        self.space = Coordinates(problem, np.array(estimate.K), np.array(estimate.S))
        self.held, self.number = _functional(estimate, self.space, name)
        _, direction = self.held(self.space.start)
        self.null = scipy.linalg.null_space(direction[None])
        # Along the gain, or the parameter, alone: there the number is affine.
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
        """m^2 with the number at this offset, from the nearest fit before."""
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
        """The point with the number at the offset, and its derivative with respect to w."""
        z = self.space.start + offset * self.unit + self.null @ w
        value, slope = self.held(z)
        here = float(slope @ self.unit)
        z = z + (offset - value) / here * self.unit
        _, slope = self.held(z)
        return z, self.null - np.outer(self.unit, slope @ self.null) / float(slope @ self.unit)

    def best_offset(self) -> float:
        return min(self.tried, key=lambda offset: self.tried[offset][0])

    def distance(self, offset: float) -> float:
        """D."""
        least = self.tried[self.best_offset()][0]
        return float((self.squared(offset) - least) / (self.noise**2 * self.factor))

    def ends(self, quantile: float) -> list[float]:
        """Offsets at which D passes the quantile on either side of its minimum.

        The search itself had a prior, which the profile does not feel: its minimum may be
        elsewhere, and a walk may find it. Then the walks begin again from there.
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
        """Look for the minimum between the neighbours of the best offset so far."""
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
        """Offset at which D passes the quantile, infinite when it does not."""
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
    """The offset of the number at z with its derivative, and the number at an offset."""
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
    """Deviation in units of the offset, and the factor f of the residuals' colour."""
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
