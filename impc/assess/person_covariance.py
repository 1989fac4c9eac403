"""How sure a person at the largest likelihood is: gain, levels of noise, and which are confused.

With I the information of all recordings about all that was searched, initial states too,

    expected   I^-1                    Fisher's information, which the search has
    observed   (-d^2 log L)^-1         by differences of exact gradients
    sandwich   I^-1 cov(sum s_t) I^-1  s_t the score of a sample; its sum by Newey and West

agree where the model is true. Where it is not, the last still tells how estimates scatter. The
prior of the search is left out but for a trace: what is not told has a deviation of hundreds.

To first order an unknown that is hardly told leaves alone what is told; to second order it bends
it, on the seat by many deviations. `with_curvature` adds that (docs/noisy-people.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.assess.covariance import TWO_SIDED
from impc.errors import InputError

if TYPE_CHECKING:
    from impc.inverse.likelihood_fit import PersonFit

__all__ = [
    "HARDLY",
    "KINDS",
    "Confusion",
    "PersonCovariance",
    "confusion",
    "person_covariance",
    "with_curvature",
]

#: Ways to a covariance.
KINDS = ("expected", "observed", "sandwich")
#: A level whose logarithm has a larger deviation, or a direction of the gain in natural coordinates
#: (`Coordinates`), is hardly told: there the curvature of the likelihood counts beside its slope.
HARDLY = 0.25
# Of a coordinate, which none leaves by much more than one: the prior that is left.
_FARTHEST = 1e3
# Step of the differences, of a coordinate: their error is the square of it, and rounding over it.
_STEP = 1e-4
# What is hardly told is moved by its deviation, by no more than this, and by these shares of it
# where there is no likelihood so far away, or more nats are promised than a parabola is believed.
_REACH, _SHARES, _BELIEVED = 1.0, (1.0, 0.5, 0.25, 0.125, 0.0625), 2.0


@dataclass(frozen=True)
class PersonCovariance(Frozen):
    """Covariance of what was searched.

    Attributes
    ----------
    kind : str
        One of `KINDS`.
    covariance : Array
        Of the unknowns of the fit (q, q).
    names : tuple of str
        Of the levels (l,).
    levels : Array
        Standard deviations of the logarithms of the levels (l,).
    entries : Array
        Standard deviations of the entries of the gain (m, n), in their units.
    directions : Array
        Of the coordinates of gain or prices, one a row (g, g), the best told first.
    deviations : Array
        Standard deviation along each (g,).
    """

    kind: str
    covariance: Array
    names: tuple[str, ...]
    levels: Array
    entries: Array
    directions: Array
    deviations: Array

    def level_interval(self, index: int, value: float) -> tuple[float, float]:
        """Interval of 95 % of a level by its `index`, about its `value`."""
        factor = float(np.exp(min(TWO_SIDED * self.levels[index], 700.0)))  # still a number
        return value / factor, value * factor

    def entry_intervals(self, K: Array) -> Array:
        """Intervals of 95 % of the entries of a gain (entries, 2), in their units.

        Parameters
        ----------
        K : Array
            The gain they are about (m, n).
        """
        about = TWO_SIDED * np.ravel(self.entries)[:, None] * [-1, 1]
        return frozen(np.ravel(K)[:, None] + about)


@dataclass(frozen=True)
class Confusion(Frozen):
    """The step of gain and levels together that the recordings tell least apart.

    Attributes
    ----------
    correlation : float
        Largest correlation of a combination of gain coordinates with one of levels.
    gain : Array
        The step of the gain (m, n), one deviation long, in its units.
    levels : Array
        The logarithms of the levels that go with it (l,).
    """

    correlation: float
    gain: Array
    levels: Array


def person_covariance(fit: PersonFit, kind: str = "sandwich") -> PersonCovariance:
    """Covariance of a fit of `fit_person`.

    Parameters
    ----------
    fit : PersonFit
    kind : str
        One of `KINDS`.

    Raises
    ------
    InputError
        When the kind is none of them.
    """
    if kind not in KINDS:
        raise InputError("kind", f"got {kind!r}", f"give one of {', '.join(KINDS)}")
    information = _observed(fit) if kind == "observed" else np.array(fit.told.information)
    values, vectors = np.linalg.eigh(information)
    bread = (vectors / np.maximum(values, _FARTHEST**-2)) @ vectors.T
    return _described(fit, kind, bread @ _meat(fit) @ bread if kind == "sandwich" else bread)


def with_curvature(fit: PersonFit, found: PersonCovariance) -> PersonCovariance:
    """The same covariance, with what unknowns that are hardly told do to all but the levels.

    Each of them, a direction of the gain or a level, is moved forth and back by its deviation, or
    by one where that is less, and all else with it along the ridge of the parabola at the fit.
    From the slope and the information there follows where all else belongs instead. Half of the sum
    of the products of these shifts is added. Logarithms of levels are left out: where a level is
    all but none its logarithm has no second order to speak of.

    Parameters
    ----------
    fit : PersonFit
    found : PersonCovariance
        Of the fit, to first order.
    """
    hardly = _hardly_told(fit, found)
    if not hardly:
        return found
    here = fit.prior.placed(np.array(fit.theta), fit.told)
    bend = fit.prior.parabola(here, np.array(fit.losing))[1]
    ridges = np.linalg.solve(bend, np.array([way for way, _ in hardly]).T).T
    moved = np.array(
        [
            _shift(fit, way, sign * min(deviation, _REACH) * ridge / float(way @ ridge))
            for (way, deviation), ridge in zip(hardly, ridges, strict=True)
            for sign in (1.0, -1.0)
        ]
    )
    moved[:, fit.space.own :] = 0.0
    return _described(fit, found.kind, found.covariance + moved.T @ moved / 2)


def _hardly_told(fit: PersonFit, found: PersonCovariance) -> list[tuple[Array, float]]:
    """What is hardly told: a direction of the unknowns (q,) of length one, and its deviation."""
    ways = np.eye(len(fit.theta))
    gains = found.directions @ ways[: fit.space.gain]
    every = zip([*gains, *ways[fit.space.own :]], [*found.deviations, *found.levels], strict=True)
    return [(way, float(deviation)) for way, deviation in every if deviation > HARDLY]


def _shift(fit: PersonFit, way: Array, off: Array) -> Array:
    """Where all else belongs (q,) with `way` held after a step (q,) along the ridge, beside it.

    Where no likelihood is so far away, or a step onto the ridge promises more than a parabola is
    believed to, of a share of the step, and over its square: to first order there is no shift.
    """
    shift = np.zeros(len(off))
    for share in _SHARES:
        there = fit.prior.tried(fit.theta + share * off)
        if there is None:
            continue
        slope, bend = fit.prior.parabola(there, np.array(fit.losing))
        step, across = np.linalg.solve(bend, np.column_stack([slope, way])).T
        shift = step - across * (way @ step) / (way @ across)
        shift /= share**2
        if share**2 * float(slope @ shift) / 2 < _BELIEVED:
            break
    return shift


def _described(fit: PersonFit, kind: str, covariance: Array) -> PersonCovariance:
    """What follows from a covariance (q, q) of all unknowns."""
    space, shared = fit.space, fit.space.gain
    dK, _ = space.changes(fit.theta)
    entries = np.einsum("iab,ij,jab->ab", dK, covariance[: len(dK), : len(dK)], dK)
    own, rows = np.linalg.eigh(covariance[:shared, :shared])
    return PersonCovariance(
        kind,
        frozen(covariance),
        tuple(space.names),
        frozen(np.sqrt(np.diag(covariance)[space.own :])),
        frozen(np.sqrt(np.maximum(entries, 0.0))),
        frozen(rows.T),
        frozen(np.sqrt(np.maximum(own, 0.0))),
    )


def confusion(fit: PersonFit) -> Confusion:
    """What of gain and levels the recordings tell least apart, by the first canonical pair.

    Coordinates that are hardly told keep the deviation of one that the search gives them.
    """
    space = fit.space
    about = np.diag(np.where(np.arange(len(fit.theta)) < space.own, 1.0, _FARTHEST**-2))
    covariance = np.linalg.inv(np.array(fit.told.information) + about)
    gain, levels = slice(0, space.gain), slice(space.own, None)
    left = np.linalg.cholesky(covariance[gain, gain])
    right = np.linalg.cholesky(covariance[levels, levels])
    product = np.linalg.solve(left, covariance[gain, levels])
    u, values, v = np.linalg.svd(np.linalg.solve(right, product.T).T)
    dK, _ = space.changes(fit.theta)
    step = np.tensordot(left @ u[:, 0], dK[gain], 1)
    return Confusion(float(values[0]), frozen(step), frozen(right @ v[0]))


def _observed(fit: PersonFit) -> Array:
    columns = []
    for index in range(len(fit.theta)):
        step = _STEP * np.eye(len(fit.theta))[index]
        up, down = (fit.space.told(fit.theta + sign * step).gradient for sign in (1, -1))
        columns.append((down - up) / (2 * _STEP))
    found = np.array(columns)
    return np.asarray((found + found.T) / 2)


def _meat(fit: PersonFit) -> Array:
    """Covariance of the sum of all scores (Newey and West 1987, up to the root of the length)."""
    total = np.zeros((len(fit.theta),) * 2)
    for scores in fit.told.scores:
        lags = int(np.sqrt(len(scores)))
        total += scores.T @ scores
        for lag in range(1, lags + 1):
            both = scores[lag:].T @ scores[:-lag] * (1 - lag / (lags + 1))
            total += both + both.T
    return total
