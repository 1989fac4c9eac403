"""Precision of an output-feedback fit: covariance of gain and noise SDs, and confounding.

    expected   I^-1                    I: Fisher information of all unknowns
    sandwich   I^-1 cov(sum s_t) I^-1  s_t: score of a sample; its sum by Newey and West

agree if the model is true; if not, the sandwich covariance still describes the sampling error.
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

#: Kinds of covariance.
KINDS = ("expected", "sandwich")
# Largest standard deviation of a coordinate, from the remaining prior.
_FARTHEST = 1e3


@dataclass(frozen=True)
class PersonCovariance(Frozen):
    """Covariance of the estimated unknowns."""

    kind: str  # one of `KINDS`
    covariance: Array  # (q, q), of the unknowns of the fit
    names: tuple[str, ...]  # of the noise SDs, length l
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


@dataclass(frozen=True)
class Confusion(Frozen):
    """The joint change of gain and noise SDs that the recordings distinguish least."""

    correlation: float  # largest one between combinations of gain coordinates and of noise SDs
    gain: Array  # (m, n), change of the gain, one standard error long, in its units
    levels: Array  # (l,), accompanying change of the logarithms of the noise SDs


def person_covariance(fit: OutputFeedbackFit, kind: str = "sandwich") -> PersonCovariance:
    """Covariance of the estimates of `fit_output_feedback`."""
    if kind not in KINDS:
        raise InputError("kind", f"got {kind!r}", f"choose from {', '.join(KINDS)}")
    information = np.array(fit.identified.information)
    values, vectors = np.linalg.eigh(information)
    kept = np.maximum(values, _FARTHEST**-2)
    unit = vectors / np.sqrt(kept)
    if kind != "sandwich":
        return _described(fit, kind, unit @ unit.T)
    # In coordinates in which the information is the identity, completed by the prior: along
    # unidentified directions scores are rounding, which the bread would multiply by 1e12.
    middle = _meat(fit, unit) + np.diag(1 - values / kept)
    return _described(fit, kind, unit @ middle @ unit.T)


def _described(fit: OutputFeedbackFit, kind: str, covariance: Array) -> PersonCovariance:
    """Derived quantities of a covariance (q, q) of all unknowns."""
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
    """Canonical pair of gain and noise SDs with the largest correlation.

    Hardly identified coordinates keep the standard deviation of their prior.
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
