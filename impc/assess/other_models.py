"""The same fit with another horizon, or without the limit: what the recordings say for each.

Two measures: VAF of trials that were left out, and Akaike's criterion. Residuals are coloured, so
the likelihood is that of their innovations under one autoregression of order one for each output,
taken from the fit itself; over T rows of innovations with covariance V

    AIC = T log det V + 2 k,

k numbers fitted. Every alternative fits as many, so only differences count. Below 2 nobody tells
two models apart; above 10 the worse one has no support (Burnham and Anderson 2002, 70).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.assess.long_run_covariance import residual_noise
from impc.assess.variance_accounted_for import left_out_vaf
from impc.checking import replace
from impc.errors import SolverError, WeightsError
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.residuals import residual_only

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from impc.arrays import Array
    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem

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
        return f"the recordings cannot tell {pair} apart (AIC differs by {distance:.1f})"
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
    return left_out_vaf(fit, problem.recordings[index], settle)[0]


def residuals_of(found: Estimate, problem: Problem) -> list[Array]:
    """Scaled residuals (samples, p) of each trial of a problem under the controller found."""
    flat = residual_only(problem, found.gain, found.metric)
    ends = np.cumsum(problem.trial_sizes)[:-1]
    parts = np.split(flat, ends)
    return [
        part.reshape(trial.outputs.shape)
        for part, trial in zip(parts, problem.recordings, strict=True)
    ]


def innovations_criterion(residuals: list[Array], roots: Array) -> float:
    """Akaike's criterion for residuals (samples, p) of trials, no unknown counted.

    Of their innovations under autoregressions of order one with given `roots` (p,).
    """
    innovations = np.concatenate([part[1:] - roots * part[:-1] for part in residuals])
    covariance = innovations.T @ innovations / len(innovations)
    return float(len(innovations) * np.linalg.slogdet(covariance)[1])
