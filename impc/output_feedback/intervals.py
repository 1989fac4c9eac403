"""Intervals of a fit with noise SDs: profile likelihood, and covariance by the curvature.

The 95 % profile likelihood interval of v'theta is where, with v'theta fixed, 2 (max F - max_fixed
F) <= 1.96^2. F is the objective, without the prior of a noise SD that is fixed: its interval is
open to zero if F never falls by enough. A profile is the search with a direction fixed.

The covariance of the estimates is the inverse curvature:

    expected   I^-1                    I: Fisher information of all unknowns
    sandwich   I^-1 cov(sum s_t) I^-1  s_t: score of a sample; its sum by Newey and West

agree if the model is true; if not, the sandwich covariance still describes the sampling error
(docs/why/output_feedback.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from impc.arrays import Array, Frozen, frozen
from impc.assess.covariance import TWO_SIDED
from impc.errors import InputError
from impc.output_feedback.fit import OutputFeedbackFit, maximise
from impc.output_feedback.unknowns import Iterate, NoisyUnknowns

#: A gain entry is individually identified if its standard error is below this, in whitened units.
IDENTIFIED = 0.25
# Standard error of a log noise SD above which it counts as weakly identified.
_HARDLY = 0.25
# Root of half of 1.96^2 nats, and the tolerance at an end of an interval.
_FALLEN, _CLOSE = 1.385903, 0.04
#: Largest distance of an end, in coordinates or log noise SDs; beyond it nothing is identified.
FARTHEST = 9.0
# Largest step of a profile, largest number of points tried for an end, evaluations at each.
_LONGEST, _TRIES, _BUDGET = 2.0, 12, 25
# Largest standard deviation of a coordinate, from the remaining prior.
_WIDEST = 1e3


def level_intervals(fit: OutputFeedbackFit, covariance: PersonCovariance) -> Array:
    """95 % intervals of all noise SDs (l, 2), in their units: profile if weakly identified."""
    found = np.array(covariance.level_intervals(fit.levels))
    for k in np.flatnonzero(covariance.levels > _HARDLY):
        found[k] = level_interval(fit, int(k))
    return frozen(found)


def level_interval(fit: OutputFeedbackFit, index: int) -> tuple[float, float]:
    """95 % profile interval of a noise SD."""
    low, high = profile(fit, np.eye(len(fit.theta))[fit.space.own + index])
    return float(np.exp(low)), float(np.exp(high))


def entry_intervals(fit: OutputFeedbackFit, covariance: PersonCovariance) -> Array:
    """95 % profile intervals of the gain entries (entries, 2), in their units."""
    dK, _ = fit.space.changes(fit.theta)
    found = np.full((fit.K.size, 2), np.nan)
    slopes, deviations = dK.reshape(len(dK), -1).T, np.ravel(covariance.entries)
    for k, length in enumerate(np.linalg.norm(slopes, axis=1)):
        if deviations[k] < IDENTIFIED * length:
            along = np.zeros(len(fit.theta))
            along[: len(dK)] = slopes[k] / length
            ends = np.array(profile(fit, along)) - float(along @ fit.theta)
            found[k] = np.ravel(fit.K)[k] + length * ends
    return frozen(found)


def profile(fit: OutputFeedbackFit, along: Array) -> tuple[float, float]:
    """95 % profile interval of along'theta; `along` (q,)."""
    return _end(fit, along, -1), _end(fit, along, 1)


def fallen(fit: OutputFeedbackFit, along: Array, value: float) -> float:
    """Drop of the objective with along'theta fixed at `value`, maximised over all else.

    `along` (q,).
    """
    space, unseen = fit.space.freed(along), np.array(fit.unseen)
    top = space.placed(np.array(fit.theta), fit.identified)
    found = profile_point(space, top, along, value - float(along @ top.theta), unseen)
    return np.inf if found is None else top.value - found[0].value


def _end(fit: OutputFeedbackFit, along: Array, side: int) -> float:
    """Point at which the profile has fallen by enough on one side, by local quadratics."""
    space, begin = fit.space.freed(along), float(along @ fit.theta)
    here, unseen = space.placed(np.array(fit.theta), fit.identified), np.array(fit.unseen)
    top, inside, outside, value = here.value, begin, side * np.inf, begin
    for _ in range(_TRIES):
        gradient, curvature = space.parabola(here, unseen)
        ridge = np.asarray(np.linalg.solve(curvature, along), dtype=np.float64)
        spread, peak = float(along @ ridge), value + float(ridge @ gradient)
        # There the profile is (value - peak)^2 / (2 spread) below its maximum.
        room = 2 * spread * (_FALLEN**2 - top + here.value) + (value - peak) ** 2
        goal = peak + side * np.sqrt(room) if room > 0 else inside
        goal = side * min(side * goal, side * value + _LONGEST, side * begin + FARTHEST)
        if not side * inside < side * goal < side * outside:
            goal = (inside + outside) / 2 if np.isfinite(outside) else inside + side * _LONGEST
        found = profile_point(space, here, along, goal - value, unseen)
        if found is None:  # undefined: treat as beyond the end
            outside = goal
            continue
        (here, unseen), value = found, goal
        root = float(np.sqrt(max(top - here.value, 0.0)))
        if abs(root - _FALLEN) < _CLOSE:
            return value
        if root > _FALLEN:
            outside = value
        elif side * (value - begin) >= FARTHEST:
            break
        else:
            inside = value
    return outside


def profile_point(
    space: NoisyUnknowns,
    here: Iterate,
    along: Array,
    off: float,
    unseen: Array,
    budget: int = _BUDGET,
) -> tuple[Iterate, Array] | None:
    """Maximise the objective with along'theta shifted by `off` and fixed."""
    # Start on the ridge of the local quadratic, or along the direction itself if that is higher: a
    # straight ridge may leave the stabilising gains, and moves a very small noise SD too far.
    _, curvature = space.parabola(here, unseen)
    ridge = np.asarray(np.linalg.solve(curvature, along), dtype=np.float64)
    ways = ridge / float(along @ ridge), along
    starts = [place for way in ways if (place := space.tried(here.theta + off * way))]
    if not starts:
        return None
    begin = max(starts, key=lambda place: place.value)
    # Basis of the complement of the direction, with unit vectors if possible.
    mine = np.flatnonzero(along)
    turned = np.zeros((len(along), len(mine) - 1))
    turned[mine] = scipy.linalg.null_space(along[None, mine])
    across = np.hstack([np.delete(np.eye(len(along)), mine, axis=1), turned])
    found, unseen, _, _ = maximise(space, begin, budget, across, unseen)
    return found, unseen


@dataclass(frozen=True)
class PersonCovariance(Frozen):
    """Covariance of the estimated unknowns."""

    covariance: Array  # (q, q), of the unknowns of the fit
    levels: Array  # (l,), standard errors of the logarithms of the noise SDs
    entries: Array  # (m, n), standard errors of the gain entries, in their units
    # principal directions of the coordinates of gain or cost weights, one per row (g, g), the most
    # precise first
    directions: Array
    deviations: Array  # (g,), standard error along each

    def level_intervals(self, values: Array) -> Array:
        """95 % intervals of the noise SDs (l, 2), in their units; `values` (l,)."""
        factors = np.exp(np.minimum(TWO_SIDED * self.levels, 700.0))  # no overflow
        return frozen(np.stack([values / factors, values * factors], axis=-1))

    def entry_intervals(self, K: Array) -> Array:
        """95 % intervals of the entries of a gain (entries, 2), in their units; `K` (m, n)."""
        about = TWO_SIDED * np.ravel(self.entries)[:, None] * [-1, 1]
        return frozen(np.ravel(K)[:, None] + about)


def person_covariance(fit: OutputFeedbackFit, kind: str = "sandwich") -> PersonCovariance:
    """Covariance of the estimates of `fit_output_feedback`, "expected" or "sandwich"."""
    if kind not in ("expected", "sandwich"):
        raise InputError("kind", f"got {kind!r}", "choose from expected, sandwich")
    values, vectors = np.linalg.eigh(np.array(fit.identified.information))
    kept = np.maximum(values, _WIDEST**-2)
    unit, middle = vectors / np.sqrt(kept), np.eye(len(kept))
    if kind == "sandwich":
        # In coordinates in which the information is the identity, completed by the prior: along
        # unidentified directions scores are rounding, which the bread would multiply by 1e12.
        middle = _meat(fit, unit) + np.diag(1 - values / kept)
    covariance, space = unit @ middle @ unit.T, fit.space
    dK, _ = space.changes(fit.theta)
    entries = np.einsum("iab,ij,jab->ab", dK, covariance[: len(dK), : len(dK)], dK)
    own, rows = np.linalg.eigh(covariance[: space.gain, : space.gain])
    return PersonCovariance(
        frozen(covariance),
        frozen(np.sqrt(np.diag(covariance)[space.own :])),
        frozen(np.sqrt(np.maximum(entries, 0.0))),
        frozen(rows.T),
        frozen(np.sqrt(np.maximum(own, 0.0))),
    )


def _meat(fit: OutputFeedbackFit, unit: Array) -> Array:
    """Newey-West covariance of the sum of all scores along the columns of `unit` (q, q).

    The lag window extends to the square root of the length (Newey and West 1987).
    """
    total = np.zeros((len(fit.theta),) * 2)
    for own in fit.identified.scores:
        scores, lags = own @ unit, int(np.sqrt(len(own)))
        total += scores.T @ scores
        for lag in range(1, lags + 1):
            both = scores[lag:].T @ scores[:-lag] * (1 - lag / (lags + 1))
            total += both + both.T
    return total


def confusion(fit: OutputFeedbackFit) -> float:
    """Largest correlation of combinations of gain coordinates and of noise SDs.

    Hardly identified coordinates keep the standard deviation of their prior.
    """
    space = fit.space
    about = np.diag(np.where(np.arange(len(fit.theta)) < space.own, 1.0, _WIDEST**-2))
    covariance = np.linalg.inv(np.array(fit.identified.information) + about)
    gain, levels = slice(0, space.gain), slice(space.own, None)
    left = np.linalg.cholesky(covariance[gain, gain])
    right = np.linalg.cholesky(covariance[levels, levels])
    product = np.linalg.solve(left, covariance[gain, levels])
    return float(np.linalg.norm(np.linalg.solve(right, product.T), 2))
