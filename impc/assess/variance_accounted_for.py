"""Agreement of simulation and recording (VAF, whiteness), and comparison of models (AIC).

VAF (3.24), also of held-out trials. Models are compared by Akaike's criterion. Residuals are
autocorrelated, so the likelihood is that of their innovations under one first-order autoregression
per output, estimated from the fit; over T rows of innovations with covariance V

    AIC = T log det V + 2 k,

with k fitted numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.special

from impc.arrays import Array, BoolArray, Frozen, frozen
from impc.assess.covariance import by_trial
from impc.assess.long_run_covariance import residual_noise
from impc.assess.printed_gain import GainEstimate
from impc.checking import checked, replace
from impc.control.closed_loop import simulate
from impc.control.simulation import Simulation
from impc.errors import InputError
from impc.inverse.estimates import Estimate
from impc.inverse.problem import EXPLAINED, Problem, controller_for, scenarios
from impc.inverse.refit import refit
from impc.inverse.residuals import residual_only
from impc.inverse.search import with_fitted_starts
from impc.model.plant import Plant
from impc.model.recordings import Recording

# One second of lags reveals a missed rhythm; at least ten lags.
_LEAST_LAGS = 10
# Decrease that a refit without a trial may leave out: the fit to all trials is near its end.
_PROMISE = 1.0


@dataclass(frozen=True)
class TrialAgreement(Frozen):
    """Agreement of one trial with its simulation."""

    vaf: Array  # (3.24) of each output, % (p,)
    centred_vaf: Array  # With means removed: 1 - var(y - y_sim)/var(y), % (p,)
    # p-value of the Ljung-Box test of white residuals over one second of lags (p,)
    whiteness: Array
    rms: Array  # RMS residual in output units (p,)
    saturated: float  # Share of samples with an active input bound


@checked(recorded="~i j", simulated="i j")
def vaf(recorded: Array, simulated: Array) -> Array:
    """Variance accounted for (3.24), 100 % (1 - sum (y - y_sim)^2 / sum y^2), by column.

    Parameters
    ----------
    recorded, simulated : array_like of shape (samples, p)
        Outputs y and y_sim in the same units. Missing samples (NaN) do not count.

    Returns
    -------
    ndarray of shape (p,)
        VAF in %; NaN if the recorded output is zero throughout.

    Examples
    --------
    A simulation that is 10 % too small leaves 1 % of the sum of squares.

    >>> import impc
    >>> recorded = [[1.0], [-2.0], [0.5]]
    >>> impc.vaf(recorded, [[0.9], [-1.8], [0.45]]).round(6)
    array([99.])
    """
    return _explained(
        np.nansum((recorded - simulated) ** 2, axis=0), np.nansum(recorded**2, axis=0)
    )


@checked(recorded="~i j", simulated="i j")
def centred_vaf(recorded: Array, simulated: Array) -> Array:
    """VAF with the means of the recording and of the residual removed, % (p,)."""
    return _explained(np.nanvar(recorded - simulated, axis=0), np.nanvar(recorded, axis=0))


def explained_share(
    outputs: Sequence[Array], corrected: Sequence[Array], simulated: Sequence[Array]
) -> Array:
    """VAF (3.24) of corrected outputs over trials (p,).

    A fitted offset or scale enlarges the sum of squares of an output. Where there is one, each
    trial has the smaller of VAF and centred VAF, and counts by its recorded variance.
    """
    found = vaf(np.concatenate(corrected), np.concatenate(simulated))
    pairs = list(zip(corrected, simulated, strict=True))
    each = [np.fmin(vaf(*pair), centred_vaf(*pair)) for pair in pairs]
    sizes = [len(one) * np.nanvar(one, axis=0) for one in outputs]
    total = np.sum(sizes, axis=0)
    pooled = np.divide(
        np.nansum(np.multiply(each, sizes), axis=0), total, out=found.copy(), where=total > 0
    )
    recorded = np.concatenate(outputs)
    fitted = np.any((np.concatenate(corrected) != recorded) & np.isfinite(recorded), axis=0)
    return np.where(fitted, pooled, found)


def _explained(left: Array, total: Array) -> Array:
    share = np.divide(left, total, out=np.full_like(left, np.nan), where=total > 0)
    return np.asarray(100 * (1 - share))


@checked(residual="i j", lags=1)
def whiteness(residual: Array, lags: int) -> Array:
    """p-values (p,) of the Ljung-Box test (1978) over the first `lags` autocorrelations.

    NaN for a constant column.
    """
    if lags >= len(residual):
        raise InputError(
            "lags", f"expected fewer than {len(residual)} lags, got {lags}", "reduce lags"
        )
    values = []
    for column in residual.T:
        if np.ptp(column) == 0:
            values.append(np.nan)
            continue
        values.append(_ljung_box(column - np.mean(column), lags))
    return np.array(values)


def _ljung_box(noise: Array, lags: int) -> float:
    """p-value of Q = N (N + 2) sum_k rho_k^2 / (N - k); avoids the slow import of statsmodels."""
    count, places = len(noise), np.arange(1, lags + 1)
    rho = np.array([noise[k:] @ noise[: count - k] for k in places]) / (noise @ noise)
    statistic = count * (count + 2) * np.sum(rho**2 / (count - places))
    return float(scipy.special.chdtrc(lags, statistic))


def agreement(
    plant: Plant, trial: Recording, run: Simulation, u_min: Array, u_max: Array
) -> TrialAgreement:
    """Compare a trial with its simulation over all samples."""
    simulated = run.x @ plant.C.T
    residual = np.nan_to_num(trial.corrected - simulated)
    lags = min(max(round(1 / plant.dt), _LEAST_LAGS), trial.samples // 5)
    return TrialAgreement(
        frozen(explained_share([trial.outputs], [trial.corrected], [simulated])),
        frozen(centred_vaf(trial.corrected, simulated)),
        frozen(whiteness(residual, max(lags, 1))),
        frozen(np.sqrt(np.mean(residual**2, axis=0))),
        saturated_share(run.applied, u_min, u_max),
    )


@checked(u="i m", u_min="~m", u_max="~m")
def saturated_share(u: Array, u_min: Array, u_max: Array) -> float:
    """Share of samples with an input at its bound, to 1e-6 of it."""
    return float(np.count_nonzero(at_limit(u, u_min, u_max)) / max(len(u), 1))


def at_limit(u: Array, u_min: Array, u_max: Array) -> BoolArray:
    """Whether any input is at its bound (samples,), to 1e-6 of it; `u` (samples, m)."""
    near = (u >= u_max * (1 - 1e-6)) | (u <= u_min * (1 - 1e-6))  # the origin is strictly inside
    return np.asarray(np.any(near, axis=1))


@dataclass(frozen=True)
class HeldOut(Frozen):
    """Agreement of one trial with its prediction from the other trials."""

    # (3.24) after the settling time, % (p,); NaN if the simulation stops early
    vaf: Array
    centred_vaf: Array  # With means removed, % (p,)


def left_out(
    fitted: Estimate, estimate: GainEstimate, index: int, settle: float, *, free: bool = False
) -> HeldOut:
    """Predict a trial with the gain that the other trials have.

    The gain of the weights, or the `free` one, moves by what a refit without the trial changes.
    """
    others = estimate.problem.with_body_fixed().leaving_out(index)
    K, S = np.array(estimate.K), np.array(estimate.S)
    change = refit(others, K, S, _PROMISE, rounds=1).K - K
    trial = fitted.problem.recordings[index]
    base = (K, S) if free else (np.array(fitted.gain), np.array(fitted.metric))
    return predicted(fitted.problem, base[0] + change, base[1], trial, settle)


def predicted(
    problem: Problem, gain: Array, metric: Array, trial: Recording, settle: float
) -> HeldOut:
    """Agreement of a trial with its prediction by a gain (m, n) and metric (m, m)."""
    alone = replace(
        problem.with_nuisance_fixed(), recordings=(trial,), signal_errors=problem.signal_errors
    )
    first = round(settle / alone.plant.dt)
    started = alone
    if problem.unknown_start:
        started = with_fitted_starts(alone, gain, metric, max(first, alone.plant.n))
    run = simulate(controller_for(started, gain, metric), scenarios(started)[0])
    if not run.complete:
        nothing = frozen(np.full(len(problem.plant.outputs), np.nan))
        return HeldOut(nothing, nothing)
    (begun,), simulated = started.recordings, (run.x @ started.plant.C.T)[first:]
    outputs, recorded = begun.outputs[first:], begun.corrected[first:]
    return HeldOut(
        frozen(explained_share([outputs], [recorded], [simulated])),
        frozen(centred_vaf(recorded, simulated)),
    )


def residuals_of(found: Estimate) -> list[Array]:
    """Scaled residuals (samples, p) of each trial under the fitted controller."""
    return by_trial(found.problem, residual_only(found.problem, found.gain, found.metric))


def innovation_roots(found: Estimate) -> Array:
    """First-order autoregression coefficient of the residuals of each output (p,)."""
    return np.asarray(residual_noise(residuals_of(found)).root)


def innovations_criterion(found: Estimate, roots: Array, identified: int = 0) -> float:
    """Akaike's criterion: innovations for `roots` (p,), plus 2 per identified unknown.

    Noise of 1e-9 of the output scale is added, so that rounding makes no difference.
    """
    floor = np.random.default_rng(0)
    parts = [one + EXPLAINED * floor.standard_normal(one.shape) for one in residuals_of(found)]
    innovations = np.concatenate([part[1:] - roots * part[:-1] for part in parts])
    covariance = innovations.T @ innovations / len(innovations)
    return float(len(innovations) * np.linalg.slogdet(covariance)[1]) + 2 * identified
