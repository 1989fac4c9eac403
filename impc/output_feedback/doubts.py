"""Doubts of a fit with sensory noise: convergence, prediction errors, standard errors, limits.

The prediction errors of a true model are white and do not depend on earlier perturbations, and the
sandwich covariance of its estimates is the inverse Fisher information (White 1982).
"""

from __future__ import annotations

import numpy as np
import scipy.stats

from impc.arrays import Array
from impc.control.simulation import Status
from impc.output_feedback.fit import OutputFeedbackFit
from impc.output_feedback.intervals import confusion, person_covariance

# p-value below which prediction errors are not white, or follow the perturbation.
_UNLIKELY = 0.01
# Ratio of sandwich to expected standard errors from which the model is in doubt: 0.8 to 1.15 for
# simulated subjects of the model, 3 to 7 for a machine with other noise
# (experiments/rotary_pendulum.md).
_ROBUST = 2.0
# Correlation of gain and noise from which they can hardly be separated.
_CONFUSED = 0.9
# Columns of past perturbations below this singular value, relative to the largest, are rounding.
_RANK = 1e-8


def fit_doubts(fit: OutputFeedbackFit) -> tuple[str, ...]:
    """Sentences that qualify the result of `fit_output_feedback`, as those of `Estimate.doubts`."""
    outputs, found = np.array(fit.problem.plant.outputs), []
    if not fit.converged:
        found.append("The search did not converge: do not report these gains.")
    for p, word in (
        (fit.whiteness, "are autocorrelated"),
        (driven(fit), "follow the perturbation"),
    ):
        if len(left := outputs[p < _UNLIKELY]):
            found.append(
                f"Prediction errors of {' and '.join(left)} {word}: the model is incomplete, and "
                "gains may be wrong by more than their intervals show."
            )
    robust, trusting = (person_covariance(fit, kind) for kind in ("sandwich", "expected"))
    ratio = np.max(robust.entries / trusting.entries)
    if ratio > _ROBUST:
        found.append(
            f"Standard errors that allow for a wrong model are up to {ratio:.1f} times those of "
            "this model: the recordings are not of it, and gains may be biased."
        )
    if at_limit(fit):
        # From simulated subjects (experiments/output_feedback.md).
        found.append(
            "A limit was reached, so these intervals are approximate: in simulations they "
            "contained 80 to 95 % of the true values."
        )
    if (together := confusion(fit)) >= _CONFUSED:
        how = f"correlation {together:.2f}"
        found.append(f"Gain and noise can hardly be separated here ({how}).")
    return tuple(found)


def driven(fit: OutputFeedbackFit) -> Array:
    """p-values (p,) that prediction errors do not depend on the perturbation of the last second.

    With unit variance their squared projection on the past perturbations is chi-squared. One if
    no trial is longer or has a changing perturbation.
    """
    lags, trials, errors, past = fit.lags, fit.problem.recordings, [], []
    ends = np.cumsum([trial.samples for trial in trials])[:-1]
    for trial, own in zip(trials, np.split(fit.standardised, ends), strict=True):
        d = trial.disturbance
        if len(d) > lags and np.any(d != d[0]):
            errors.append(own[lags:])
            past.append(np.hstack([d[lags - k : len(d) - k] for k in range(1, lags + 1)]))
    if not past:
        return np.ones(len(fit.problem.plant.outputs))
    every = np.concatenate(past)
    basis, sizes, _ = np.linalg.svd(every - every.mean(axis=0), full_matrices=False)
    basis = basis[:, sizes > _RANK * np.linalg.norm(every)]
    explained = np.sum((basis.T @ np.concatenate(errors)) ** 2, axis=0)
    return np.asarray(scipy.stats.chi2.sf(explained, basis.shape[1]))


def at_limit(fit: OutputFeedbackFit) -> bool:
    """Whether a bound was reached, so that the likelihood is approximate."""
    return any(np.any(trial.status != Status.FREE) for trial in fit.identified.trials)
