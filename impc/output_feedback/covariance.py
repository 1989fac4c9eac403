"""How sure a person at the largest likelihood is: gain, levels of noise, and which are confused.

    expected   I^-1                    I: Fisher's information about all unknowns
    sandwich   I^-1 cov(sum s_t) I^-1  s_t: the score of a sample; its sum by Newey and West

agree where the model is true; where it is not, the last still says how estimates scatter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.assess.covariance import TWO_SIDED
from impc.errors import InputError

if TYPE_CHECKING:
    from impc.output_feedback.fit import OutputFeedbackFit

#: Ways to a covariance.
KINDS = ("expected", "sandwich")
# Of a coordinate, which none leaves by much more than one: the prior that is left.
_FARTHEST = 1e3


@dataclass(frozen=True)
class PersonCovariance(Frozen):
    """Covariance of what was searched."""

    kind: str  # One of `KINDS`
    covariance: Array  # Of the unknowns of the fit (q, q)
    names: tuple[str, ...]  # Of the levels (l,)
    levels: Array  # Standard deviations of the logarithms of the levels (l,)
    entries: Array  # Standard deviations of the entries of the gain (m, n), in their units
    # Of the coordinates of gain or cost weights, one a row (g, g), the best identified first
    directions: Array
    deviations: Array  # Standard deviation along each (g,)

    def level_intervals(self, values: Array) -> Array:
        """Intervals of 95 % of the levels (l, 2), in their units; `values` (l,)."""
        factors = np.exp(np.minimum(TWO_SIDED * self.levels, 700.0))  # still numbers
        return frozen(np.stack([values / factors, values * factors], axis=-1))

    def entry_intervals(self, K: Array) -> Array:
        """Intervals of 95 % of the entries of a gain (entries, 2), in their units; `K` (m, n)."""
        about = TWO_SIDED * np.ravel(self.entries)[:, None] * [-1, 1]
        return frozen(np.ravel(K)[:, None] + about)


@dataclass(frozen=True)
class Confusion(Frozen):
    """The step of gain and levels together that the recordings distinguish least."""

    # Largest correlation of a combination of gain coordinates with one of levels
    correlation: float
    gain: Array  # The step of the gain (m, n), one deviation long, in its units
    levels: Array  # The logarithms of the levels that go with it (l,)


def person_covariance(fit: OutputFeedbackFit, kind: str = "sandwich") -> PersonCovariance:
    """Covariance of a fit of `fit_output_feedback`."""
    if kind not in KINDS:
        raise InputError("kind", f"got {kind!r}", f"give one of {', '.join(KINDS)}")
    information = np.array(fit.identified.information)
    values, vectors = np.linalg.eigh(information)
    kept = np.maximum(values, _FARTHEST**-2)
    unit = vectors / np.sqrt(kept)
    if kind != "sandwich":
        return _described(fit, kind, unit @ unit.T)
    # As seen where the information is one, and with as much of the prior as it needs for that: of a
    # direction that is not identified scores are rounding, and the bread is the square of 1e6.
    middle = _meat(fit, unit) + np.diag(1 - values / kept)
    return _described(fit, kind, unit @ middle @ unit.T)


def _described(fit: OutputFeedbackFit, kind: str, covariance: Array) -> PersonCovariance:
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


def confusion(fit: OutputFeedbackFit) -> Confusion:
    """What of gain and levels the recordings distinguish least, by the first canonical pair.

    Coordinates that are hardly identified keep the deviation of one that the search gives them.
    """
    space = fit.space
    about = np.diag(np.where(np.arange(len(fit.theta)) < space.own, 1.0, _FARTHEST**-2))
    covariance = np.linalg.inv(np.array(fit.identified.information) + about)
    gain, levels = slice(0, space.gain), slice(space.own, None)
    left = np.linalg.cholesky(covariance[gain, gain])
    right = np.linalg.cholesky(covariance[levels, levels])
    product = np.linalg.solve(left, covariance[gain, levels])
    u, values, v = np.linalg.svd(np.linalg.solve(right, product.T).T)
    dK, _ = space.changes(fit.theta)
    step = np.tensordot(left @ u[:, 0], dK[gain], 1)
    return Confusion(float(values[0]), frozen(step), frozen(right @ v[0]))


def _meat(fit: OutputFeedbackFit, unit: Array) -> Array:
    """Covariance of the sum of all scores along the columns of `unit` (q, q).

    By Newey and West (1987), up to the root of the length.
    """
    total = np.zeros((len(fit.theta),) * 2)
    for own in fit.identified.scores:
        scores, lags = own @ unit, int(np.sqrt(len(own)))
        total += scores.T @ scores
        for lag in range(1, lags + 1):
            both = scores[lag:].T @ scores[:-lag] * (1 - lag / (lags + 1))
            total += both + both.T
    return total
