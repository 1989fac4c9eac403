"""How well a simulation agrees with a recording, and how well other models do.

VAF (3.24), also of trials that were left out, and whether what is left is noise. Models (other
horizons, no limit) are compared by Akaike's criterion too. Residuals are coloured, so the
likelihood is that of their innovations under one autoregression of order one for each output, taken
from the fit itself; over T rows of innovations with covariance V

    AIC = T log det V + 2 k,

k numbers fitted. Every alternative fits as many, so only differences count. Below 2 nobody says
two models apart; above 10 the worse one has no support (Burnham and Anderson 2002, 70).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.special

from impc.arrays import Array, Frozen, frozen
from impc.assess.long_run_covariance import residual_noise
from impc.checking import checked, replace
from impc.control.closed_loop import simulate
from impc.errors import InputError, SolverError, WeightsError
from impc.inverse.noisy_fit import fit_controller, with_fitted_starts
from impc.inverse.problem import controller_for, scenarios
from impc.inverse.residuals import residual_only

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from impc.arrays import Array
    from impc.control.simulation import Simulation
    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem
    from impc.model.plant import Plant
    from impc.model.recordings import Recording


# One second of lags shows a rhythm that was missed; fewer than ten show nothing.
_LEAST_LAGS = 10


@dataclass(frozen=True)
class TrialAgreement(Frozen):
    """One trial against its simulation."""

    vaf: Array  # (3.24) of each output, % (p,)
    centred_vaf: Array  # The same with the means removed, 1 - var(y - y_sim)/var(y), % (p,)
    # p-value of Ljung and Box's test that the residual is white, one second of lags (p,)
    whiteness: Array
    rms: Array  # Root-mean-square residual in the outputs' units (p,)
    saturated: float  # Share of the samples at which an input bound is reached


@checked(recorded="~i j", simulated="i j")
def vaf(recorded: Array, simulated: Array) -> Array:
    """Variance accounted for (3.24): (1 - sum (y - y_sim)^2 / sum y^2) 100 %, one for each column.

    Parameters
    ----------
    recorded, simulated : Array
        y and y_sim (samples, p), in one unit.

    Returns
    -------
    Array
        % (p,); NaN where the recorded output is zero throughout. Missing samples do not count.

    Examples
    --------
    A simulation that is a tenth too small leaves a hundredth of the sum of squares.

    >>> import impc
    >>> recorded = [[1.0], [-2.0], [0.5]]
    >>> impc.vaf(recorded, [[0.9], [-1.8], [0.45]]).round(6)
    array([99.])
    """
    left = np.nansum((recorded - simulated) ** 2, axis=0)
    total = np.nansum(recorded**2, axis=0)
    share = np.divide(left, total, out=np.full_like(left, np.nan), where=total > 0)
    return np.asarray(100 * (1 - share))


@checked(recorded="~i j", simulated="i j")
def centred_vaf(recorded: Array, simulated: Array) -> Array:
    """As `vaf`, with the means removed from what was recorded and from what is left."""
    left = np.nanvar(recorded - simulated, axis=0)
    total = np.nanvar(recorded, axis=0)
    share = np.divide(left, total, out=np.full_like(left, np.nan), where=total > 0)
    return np.asarray(100 * (1 - share))


@checked(residual="i j", lags=1)
def whiteness(residual: Array, lags: int) -> Array:
    """p-values (p,) of Ljung and Box's test (1978) that columns of a residual are white.

    The first `lags` autocorrelations are tested together; NaN where nothing is left to test.
    """
    if lags >= len(residual):
        raise InputError("lags", f"got {lags} of {len(residual)} samples", "give fewer")
    values = []
    for column in residual.T:
        if np.ptp(column) == 0:
            values.append(np.nan)
            continue
        values.append(_ljung_box(column - np.mean(column), lags))
    return np.array(values)


def _ljung_box(noise: Array, lags: int) -> float:
    """p of Q = N (N + 2) sum_k rho_k^2 / (N - k); statsmodels' takes half a second to be loaded."""
    count, places = len(noise), np.arange(1, lags + 1)
    rho = np.array([noise[k:] @ noise[: count - k] for k in places]) / (noise @ noise)
    statistic = count * (count + 2) * np.sum(rho**2 / (count - places))
    return float(scipy.special.chdtrc(lags, statistic))


def agreement(
    plant: Plant, trial: Recording, run: Simulation, u_min: Array, u_max: Array
) -> TrialAgreement:
    """Compare a trial with its simulation from the first sample to the last."""
    simulated = run.x @ plant.C.T
    residual = np.nan_to_num(trial.without_offset - simulated)
    lags = min(max(round(1 / plant.dt), _LEAST_LAGS), trial.samples // 5)
    return TrialAgreement(
        frozen(vaf(trial.without_offset, simulated)),
        frozen(centred_vaf(trial.without_offset, simulated)),
        frozen(whiteness(residual, max(lags, 1))),
        frozen(np.sqrt(np.mean(residual**2, axis=0))),
        saturated_share(run.applied, u_min, u_max),
    )


@checked(u="i m", u_min="~m", u_max="~m")
def saturated_share(u: Array, u_min: Array, u_max: Array) -> float:
    """Share of samples at which any input stands on a bound, to 1e-6 of it."""
    near = (u >= u_max * (1 - 1e-6)) | (u <= u_min * (1 - 1e-6))  # the origin is strictly inside
    return float(np.count_nonzero(np.any(near, axis=1)) / max(len(u), 1))


@dataclass(frozen=True)
class HeldOut(Frozen):
    """One trial as the fit of the others predicts it."""

    # (3.24) after the settling time, % (p,); NaN when the simulation does not reach the end
    vaf: Array
    centred_vaf: Array  # The same with the means removed, % (p,)


def left_out_vaf(other: Estimate, trial: Recording, settle: float) -> HeldOut:
    """VAF of a trial under the controller that was found without it."""
    gain, metric = np.array(other.gain), np.array(other.metric)
    fixed = other.problem.with_nuisance_fixed()
    alone = replace(fixed, recordings=(trial,), offsets=other.problem.offsets)
    first = round(settle / alone.plant.dt)
    started = alone
    if other.problem.unknown_start:
        started = with_fitted_starts(alone, gain, metric, max(first, alone.plant.n))
    run = simulate(controller_for(started, gain, metric), scenarios(started)[0])
    recorded = started.recordings[0].without_offset[first:]
    simulated = (run.x @ started.plant.C.T)[first:]
    if not run.complete:
        nothing = frozen(np.full(recorded.shape[1], np.nan))
        return HeldOut(nothing, nothing)
    return HeldOut(frozen(vaf(recorded, simulated)), frozen(centred_vaf(recorded, simulated)))


_SAME, _RULED_OUT = 2.0, 10.0


@dataclass(frozen=True)
class Alternative:
    """One way to fit the same recordings."""

    name: str  # "as fitted", "no limit" or "horizon N"
    horizon: int  # In samples
    misfit: float  # 2-norm of the residual; infinite when no controller was found
    aic: float  # Above the least of all alternatives
    held_out: float  # Mean VAF over outputs and trials left out, %; NaN with a single trial
    reason: str  # Why there is no controller; empty otherwise


def fit_alternatives(
    problem: Problem,
    fitted: Estimate,
    horizons: Sequence[int],
    settle: float,
    progress: Callable[[str], None] = lambda _: None,
) -> tuple[Alternative, ...]:
    """Fit again without the limit, if there is one, and with each other horizon."""
    posed = [("as fitted", problem)]
    if np.any(np.isfinite(problem.bounds.u_max)):
        posed.append(("no limit", problem.without_bounds()))
    posed += [
        (f"horizon {length}", replace(problem, horizon=length))
        for length in horizons
        if length != problem.horizon
    ]
    roots = np.asarray(residual_noise(residuals_of(fitted, fitted.problem)).root)
    found = []
    for name, other in posed:
        found.append(_fit(name, other, fitted, settle, roots))
        progress(name)
    least = min(item.aic for item in found)
    return tuple(replace(item, aic=item.aic - least) for item in found)


def verdict(one: Alternative, other: Alternative) -> str:
    """What the recordings say of one against the other, in a sentence."""
    if one.reason or other.reason:
        failed = one if one.reason else other
        return f"{failed.name}: no controller ({failed.reason})"
    better, worse = (one, other) if one.aic <= other.aic else (other, one)
    distance = worse.aic - better.aic
    pair = f"{better.name} and {worse.name}"
    if distance < _SAME:
        return f"the recordings do not distinguish {pair} (AIC differs by {distance:.1f})"
    strength = "rule out" if distance > _RULED_OUT else "speak weakly against"
    return (
        f"the recordings {strength} {worse.name} beside {better.name} (AIC +{distance:.0f}, "
        f"held-out VAF {worse.held_out - better.held_out:+.2f} points)"
    )


def _fit(name: str, problem: Problem, fitted: Estimate, settle: float, roots: Array) -> Alternative:
    try:
        found = fitted if name == "as fitted" else fit_controller(problem, fitted.weights)
        held = [_left_out(problem, found, index, settle) for index in range(_trials(problem))]
    except (WeightsError, SolverError) as error:
        return Alternative(name, problem.horizon, np.inf, np.inf, np.nan, str(error))
    aic = innovations_criterion(residuals_of(found, found.problem), roots)
    mean = float(np.mean(held)) if held else float("nan")
    return Alternative(name, problem.horizon, found.misfit, aic, mean, "")


def _trials(problem: Problem) -> int:
    count = len(problem.recordings)
    return count if count > 1 else 0


def _left_out(problem: Problem, found: Estimate, index: int, settle: float) -> Array:
    fit = fit_controller(problem.leaving_out(index), found.weights)
    return np.array(left_out_vaf(fit, problem.recordings[index], settle).vaf)


def residuals_of(found: Estimate, problem: Problem) -> list[Array]:
    """Scaled residuals (samples, p) of each trial of a problem under the controller found."""
    flat = residual_only(problem, found.gain, found.metric)
    ends = np.cumsum(problem.trial_sizes)[:-1]
    parts = np.split(flat, ends)
    return [
        part.reshape(trial.samples, -1)
        for part, trial in zip(parts, problem.recordings, strict=True)
    ]


def innovations_criterion(residuals: list[Array], roots: Array) -> float:
    """Akaike's criterion for residuals (samples, p) of trials, no unknown counted."""
    innovations = np.concatenate([part[1:] - roots * part[:-1] for part in residuals])
    covariance = innovations.T @ innovations / len(innovations)
    return float(len(innovations) * np.linalg.slogdet(covariance)[1])
