"""Uncertainty of a fit: intervals of all requested kinds and the set of weights.

Always: intervals of gain and parameters from their covariance, and the weights with the fitted
gain. On request: bootstrap, profile likelihoods, input limit, other horizons
(docs/why/intervals.md).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from impc.arrays import Array
from impc.assess.input_limits import input_limit
from impc.assess.printed_gain import (
    LEVEL,
    GainEstimate,
    Interval,
    covariance_intervals,
    gain_estimate,
)
from impc.assess.profiles import profile_likelihood, require_numbers
from impc.assess.resampling import Replicate, bootstrap_intervals, replicate
from impc.assess.variance_accounted_for import (
    innovation_roots,
    innovations_criterion,
    left_out,
)
from impc.assess.weights_ranges import WeightsSummary
from impc.checking import replace
from impc.errors import SolverError, WeightsError
from impc.inverse.estimates import Estimate
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.problem import Problem
from impc.reporting.shown_units import signal_name
from impc.studies.cache import from_json, to_json
from impc.studies.fit.first import FitProgress
from impc.studies.fit.settings import FitSettings


@dataclass(frozen=True)
class Uncertainty:
    """Results of all requested analyses."""

    intervals: tuple[Interval, ...]  # By every requested method; sandwich intervals first
    # Set of weights with the fitted gain; None if its programs fail
    weights: WeightsSummary | None
    weights_reason: str  # Why there is none; otherwise empty
    # The fit itself, no limit, other horizons; empty unless requested
    alternatives: tuple[Alternative, ...]


# Titles of stages.
_PROFILE, _LIMIT, _REPLICATE = "profile of {}", "limit of {}", "bootstrap replicate {}"
_OTHER = "other horizons: {}"


def analyses(problem: Problem, settings: FitSettings) -> list[str]:
    """Titles of the stages that `assess` reports, in order."""
    plant = problem.plant
    found = list(map(_PROFILE.format, settings.profiles))
    if settings.unknown_limit:
        found += [_LIMIT.format(signal_name(plant, name)) for name in plant.controls]
    if settings.horizons:
        found += [_OTHER.format(name) for name, _ in _alternatives(problem, settings.horizons)]
    return found + [_REPLICATE.format(index + 1) for index in range(settings.replicates)]


def assess(
    problem: Problem,
    fitted: Estimate,
    estimate: GainEstimate,
    weights: tuple[WeightsSummary | None, str],
    settings: FitSettings,
    progress: FitProgress,
) -> Uncertainty:
    """Run the requested analyses."""
    done, attempt = progress.done, progress.attempt
    intervals = list(covariance_intervals(estimate, estimate.covariance, "sandwich"))
    require_numbers(estimate, settings.profiles)
    for name in settings.profiles:
        stage = _PROFILE.format(name)
        profile = attempt(stage, functools.partial(profile_likelihood, estimate, name), None)
        intervals += [] if profile is None else [profile]
        done(stage)
    for control in range(problem.plant.m if settings.unknown_limit else 0):
        name = problem.plant.controls[control]
        stage = _LIMIT.format(signal_name(problem.plant, name))
        limit = attempt(stage, functools.partial(input_limit, fitted, control), None)
        if limit is not None:
            ends = limit.value, limit.low, limit.high
            intervals.append(Interval(f"u_max.{name}", "profile", LEVEL, *ends))
        done(stage)
    alternatives: tuple[Alternative, ...] = ()
    if settings.horizons:
        given = problem, fitted, settings.horizons, settings.settle
        others = functools.partial(fit_alternatives, *given, lambda name: done(_OTHER.format(name)))
        alternatives = attempt("other horizons", others, ())
    replicates = functools.partial(_bootstrap, estimate, settings, progress)
    intervals += attempt("bootstrap", replicates, ())
    return Uncertainty(tuple(intervals), *weights, alternatives)


def _bootstrap(
    estimate: GainEstimate,
    settings: FitSettings,
    progress: FitProgress,
) -> tuple[Interval, ...]:
    if not settings.replicates:
        return ()
    decode = functools.partial(from_json, kind=Replicate)
    found, at = [], (estimate.problem, np.array(estimate.K), np.array(estimate.S))
    for index in range(settings.replicates):
        name = _REPLICATE.format(index + 1)
        compute = functools.partial(replicate, *at, index, settings.seed)
        found.append(progress.part(name, compute, decode, to_json))
        progress.done(name)
    return bootstrap_intervals(estimate, found, "block", LEVEL)


@dataclass(frozen=True)
class Alternative:
    """One way to fit the same recordings."""

    name: str  # "as fitted", "no limit" or "horizon N"
    horizon: int  # In samples
    misfit: float  # 2-norm of the residual; infinite without a controller
    aic: float  # Difference to the least AIC of all alternatives
    held_out: float  # Mean VAF over outputs and held-out trials, %; NaN with one trial
    reason: str  # Why there is no controller; otherwise empty


def fit_alternatives(
    problem: Problem,
    fitted: Estimate,
    horizons: Sequence[int],
    settle: float,
    progress: Callable[[str], None] = lambda _: None,
) -> tuple[Alternative, ...]:
    """Refit without the limit, if there is one, and with each other horizon."""
    roots = innovation_roots(fitted)
    found = []
    for name, other in _alternatives(problem, horizons):
        found.append(_fit(name, other, fitted, settle, roots))
        progress(name)
    least = min(item.aic for item in found)
    return tuple(replace(item, aic=item.aic - least) for item in found)


def _alternatives(problem: Problem, horizons: Sequence[int]) -> list[tuple[str, Problem]]:
    """The problems to fit, with their names."""
    posed = [("as fitted", problem)]
    if np.any(np.isfinite(problem.bounds.u_max)):
        posed.append(("no limit", problem.without_bounds()))
    return posed + [
        (f"horizon {length}", replace(problem, horizon=length))
        for length in horizons
        if length != problem.horizon
    ]


def _fit(name: str, problem: Problem, fitted: Estimate, settle: float, roots: Array) -> Alternative:
    try:
        found = fitted if name == "as fitted" else fit_controller(problem, fitted.weights)
        estimate, count = gain_estimate(found), len(problem.recordings)
        places = range(count if count > 1 else 0)
        held = [left_out(found, estimate, index, settle).vaf for index in places]
    except (WeightsError, SolverError) as error:
        return Alternative(name, problem.horizon, np.inf, np.inf, np.nan, str(error))
    aic = innovations_criterion(found, roots)
    mean = float(np.mean(held)) if held else float("nan")
    return Alternative(name, problem.horizon, found.misfit, aic, mean, "")
