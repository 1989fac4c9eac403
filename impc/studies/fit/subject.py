"""Fit the bounded controller of a subject to all trials (section 3.5).

Preliminary gain and physical parameters (3.19), bounds (3.22), weights of the controller from all
trials with an initial state for each, VAF (3.24) in fitted and left-out trials, intent (3.23) to
(3.26), and the other methods on the same recordings.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from impc.arrays import Array, frozen
from impc.assess.assessments import MethodFit, evaluate_method
from impc.assess.ceiling import ceiling
from impc.assess.frequency_response import frequency_response
from impc.assess.intent import Intent, intent
from impc.assess.printed_gain import GainEstimate, gain_estimate
from impc.assess.structures import StructureFit, assess_structure, no_structure
from impc.assess.variance_accounted_for import agreement, left_out
from impc.assess.weights_ranges import WeightsSummary, estimate_draws, weights_summary_or_reason
from impc.assess.weights_test import WeightsTest, identifiability, weights_test
from impc.checking import replace
from impc.control.simulation import Simulation
from impc.errors import SolverError, WeightsError
from impc.inverse.cross_check import cross_checked
from impc.inverse.estimates import Estimate
from impc.inverse.methods import METHODS
from impc.inverse.problem import Problem
from impc.inverse.structured import fit_structured
from impc.studies.fit.asked import fit_structures, output_feedback
from impc.studies.fit.first import FitProgress, first_fits
from impc.studies.fit.result import LITTLE, FitResult, FittedParameter
from impc.studies.fit.settings import FitSettings, ObserverSettings
from impc.studies.fit.uncertainty import analyses, assess
from impc.studies.methods_table import method_label
from impc.studies.pool import threads

if TYPE_CHECKING:
    from concurrent.futures import ThreadPoolExecutor

    from impc.output_feedback.models import PersonReport

_THREADS = 2
# Titles of stages. The number and not the name of a structure: stored results have these names.
_EQUAL = "cost weights that fit equally well"
_STRUCTURE, _NOISE = "cost weights within structure {}", "noise in the loop: {}"
_UNUSABLE = "the controller explains less than half of a recorded signal (VAF below 50 %)."


def stages(problem: Problem, settings: FitSettings) -> tuple[str, ...]:
    """Titles of the stages that `fit_recordings` reports, in order."""
    names = ["inverse_mpc", *_beside(settings)]
    found = [*map(method_label, names), _EQUAL, *_left_out_titles(problem, settings)]
    count = (settings.structure is not None) + len(settings.structures)
    found += [_STRUCTURE.format(index + 1) for index in range(count)]
    found += analyses(problem, settings)
    if settings.observer is not None:
        persons = output_feedback().persons(problem, *_asked(problem, settings.observer))
        found += [_NOISE.format(name) for name in (*(name for name, *_ in persons), "intervals")]
    return tuple(found)


def _beside(settings: FitSettings) -> tuple[str, ...]:
    """Methods that are compared with inverse MPC, in the order of the table."""
    first = ("preliminary",) if settings.feedback_states else ()
    return (*first, *settings.methods)


def _left_out_titles(problem: Problem, settings: FitSettings) -> list[str]:
    """Titles of the trials that are predicted by a fit to the others."""
    trials = len(problem.recordings)
    count = trials if settings.held_out and trials > 1 else 0
    return [f"Trial {k + 1} left out" for k in range(count)]


def fit_alone(problem: Problem, settings: FitSettings) -> FitResult:
    """Fit a subject without other methods, the set of weights and analyses on request."""
    settings = replace(settings, structures=[], methods=[], profiles=[], horizons=[])
    settings = replace(settings, unknown_limit=False, replicates=0, observer=None)
    return fit_recordings(problem, replace(settings, feedback_states=[]), alone=True)


def fit_recordings(
    problem: Problem,
    settings: FitSettings,
    progress: FitProgress | None = None,
    *,
    alone: bool = False,
) -> FitResult:
    """Fit a subject as `impc fit` does; `alone`: as `fit_alone` does."""
    if settings.observer is not None:
        output_feedback()  # raises early if it is not installed
    started, progress = time.perf_counter(), progress or FitProgress()
    problem, progress, fitted, estimate, lack = first_fits(problem, progress)
    found = _estimates(problem, fitted, settings, progress)
    if not np.array_equal(found["inverse_mpc"].gain, fitted.gain):  # improved from another method
        estimate = gain_estimate(found["inverse_mpc"])
    fitted = found["inverse_mpc"]
    *others, own = [evaluate_method(one, problem.bounds) for one in found.values()]
    for other in others:
        progress.done(method_label(other.name))
    known, weights = fitted.problem.with_nuisance_fixed(), fitted.stage_weights
    pair = np.array(fitted.gain), np.array(fitted.metrics)
    intended = intent(known.plant, *pair, state_sizes(own.runs), weights)
    sides = np.array(problem.bounds.u_min), np.array(problem.bounds.u_max)
    doubted = lack[-1] is not None and lack[-1].alarm
    test = weights_test(fitted, estimate, contradicted=doubted)
    usable = bool(np.all(own.vaf >= LITTLE))
    with threads(1 if alone else _THREADS) as pool:
        pending = _left_out(fitted, estimate, settings, progress, pool, free=test.rejected)
        whole: tuple[WeightsSummary | None, str] = None, "Not computed in a cohort."
        if not alone:
            whole = _weights(estimate, own, intended, test, settings, progress, pool)
        own = replace(own, held_out=pending())
    structures = _structures(problem, settings, fitted, progress, alone=alone)
    uncertainty = assess(problem, fitted, estimate, whole, settings, progress)
    person = functools.partial(_person, problem, settings, fitted, progress)
    return FitResult(
        settings=settings,
        given=problem,
        estimate=estimate,
        parameters=_parameters(estimate),
        intent=intended,
        identifiability=identifiability(known, weights),
        uncertainty=uncertainty if usable or alone else replace(uncertainty, intervals=()),
        trials=tuple(
            agreement(known.plant, trial, run, *sides)
            for trial, run in zip(known.recordings, own.runs, strict=True)
        ),
        methods=(*others, own),
        lack=lack,
        weights_test=test,
        failures=progress.failures,
        structures=structures,
        person=progress.attempt("subject with sensory noise", person, None),
        ceiling=None if alone else ceiling(fitted.problem, settings.settle),
        response=None if alone else frequency_response(fitted.problem, own.runs),
        seconds=time.perf_counter() - started,
    )


def _estimates(
    problem: Problem, fitted: Estimate, settings: FitSettings, progress: FitProgress
) -> dict[str, Estimate]:
    """Estimates of all methods, inverse MPC last; each also tries the solutions of the others."""

    def estimate(name: str) -> Estimate:
        compute = functools.partial(METHODS[name].estimate, problem, fitted)
        return progress.estimate(method_label(name), compute)

    names = _beside(settings)
    with threads(_THREADS) as pool:
        found = dict(zip(names, pool.map(estimate, names), strict=True))
    return cross_checked(problem, found | {"inverse_mpc": fitted})


def _left_out(
    fitted: Estimate,
    estimate: GainEstimate,
    settings: FitSettings,
    progress: FitProgress,
    pool: ThreadPoolExecutor,
    *,
    free: bool,
) -> Callable[[], Array]:
    """Submit the predictions of trials from the others; call the result for their VAF (., p)."""
    predict = functools.partial(left_out, fitted, estimate, settle=settings.settle, free=free)
    names = _left_out_titles(fitted.problem, settings)
    pending = [
        pool.submit(progress.attempt, name, functools.partial(predict, k), None)
        for k, name in enumerate(names)
    ]

    def found() -> Array:
        held = []
        for name, other in zip(names, pending, strict=True):
            one = other.result()
            held += [] if one is None else [one.vaf]
            progress.done(name)
        complete = held and len(held) == len(names)  # rows for all trials or for none
        return frozen(held if complete else np.empty((0, len(fitted.problem.plant.outputs))))

    return found


def _weights(
    estimate: GainEstimate,
    own: MethodFit,
    found: Intent,
    test: WeightsTest,
    settings: FitSettings,
    progress: FitProgress,
    pool: ThreadPoolExecutor,
) -> tuple[WeightsSummary | None, str]:
    """Summary of all weights with the fitted gain, or None and the reason."""
    fitted = own.estimate
    summary: tuple[WeightsSummary | None, str] = None, test.sentence
    if not np.all(own.vaf >= LITTLE):
        summary = None, _UNUSABLE
    elif not test.rejected:
        plant, K = fitted.problem.with_nuisance_fixed().plant, np.array(fitted.gain)
        drawn = functools.partial(estimate_draws, plant, fitted.stage_weights, estimate)
        attempt = functools.partial(progress.attempt, "drawn gains", drawn, ())
        at = plant, K, np.array(fitted.metrics), np.array(found.sizes)
        draw = attempt if settings.intent_draws else tuple
        summary = weights_summary_or_reason(*at, draw, pool.map)
    progress.done(_EQUAL)
    return summary


def _person(
    problem: Problem, settings: FitSettings, fitted: Estimate, progress: FitProgress
) -> PersonReport | None:
    """Fit of the model with sensory noise, if requested."""
    asked = settings.observer
    if asked is None:
        return None
    report: PersonReport = output_feedback().person_report(
        replace(fitted, problem=fitted.problem.with_body_fixed()),
        *_asked(problem, asked),
        profiled=asked.profiles,
        done=lambda name: progress.done(_NOISE.format(name)),
        remember=lambda name, *how: progress.part(_NOISE.format(name), *how),
    )
    return report


def _asked(problem: Problem, asked: ObserverSettings) -> tuple[Any, Array]:
    """Requested observer and its perturbation (`asked_observer` of the subpackage)."""
    given = msgspec.structs.asdict(asked)
    del given["profiles"]
    found: tuple[Any, Array] = output_feedback().asked_observer(
        problem.plant, problem.recordings, **given
    )
    return found


def _structures(
    problem: Problem,
    settings: FitSettings,
    fitted: Estimate,
    progress: FitProgress,
    *,
    alone: bool,
) -> tuple[StructureFit, ...]:
    """Fits of all structures in the settings, started at the unrestricted weights."""
    found, held_out = [], not alone and bool(_left_out_titles(problem, settings))
    for index, structure in enumerate(fit_structures(problem.plant, settings)):
        stage = _STRUCTURE.format(index + 1)
        fit = functools.partial(fit_structured, problem, structure, fitted)
        try:
            one = progress.estimate(stage, fit)
        except (WeightsError, SolverError) as error:
            found.append(no_structure(structure, len(problem.plant.outputs), str(error)))
        else:
            found.append(
                assess_structure(
                    problem, structure, one, fitted, settings.settle, held_out=held_out
                )
            )
        progress.done(stage)
    return tuple(found)


def _parameters(estimate: GainEstimate) -> tuple[FittedParameter, ...]:
    family, covariance = estimate.problem.family, estimate.covariance
    if family is None:
        return ()
    at_nominal, values = family.values(np.zeros(len(family.names))), estimate.parameters
    scale = family.nominal * np.exp(estimate.problem.logarithms)
    shares = np.zeros(len(family.names))
    identified = np.array(covariance.individually_identified)
    if np.any(identified):
        shares[family.stated] = np.mean(np.array(covariance.shares)[identified], axis=0)
    return tuple(
        FittedParameter(
            name,
            float(at_nominal[k]),
            float(values[k]),
            float(scale[k] * covariance.parameters[k]),
            float(family.nominal[k] * family.deviations[k]) if family.stated[k] else None,
            float(shares[k]),
        )
        for k, name in enumerate(family.names)
    )


def state_sizes(runs: tuple[Simulation, ...]) -> Array:
    """RMS of each state (n,); for states that stay zero, the smallest RMS of the others."""
    sizes = np.sqrt(np.mean(np.concatenate([run.x for run in runs]) ** 2, axis=0))
    moving = sizes[sizes > 0]
    if len(moving) == 0:
        raise SolverError("simulation", "all states stay zero", "check the disturbance's column")
    return np.asarray(np.maximum(sizes, np.min(moving)))
