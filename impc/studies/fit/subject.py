"""Fit the bounded controller of a subject to all trials (section 3.5).

Preliminary gain and physical parameters (3.19), bounds (3.22), weights of the controller from all
trials with an initial state for each, VAF (3.24) in fitted and left-out trials, intent (3.23) to
(3.26), and the other methods on the same recordings.
"""

from __future__ import annotations

import functools
import time
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from tqdm.auto import tqdm

from impc.arrays import Array, frozen
from impc.assess.assessments import evaluate_method
from impc.assess.ceiling import ceiling
from impc.assess.frequency_response import frequency_response
from impc.assess.intent import intent
from impc.assess.printed_gain import command_regression, gain_estimate
from impc.assess.structures import assess_structure, no_structure
from impc.assess.variance_accounted_for import agreement, left_out
from impc.assess.weights_ranges import estimate_draws, weights_summary_or_reason
from impc.assess.weights_test import identifiability, weights_test
from impc.checking import replace
from impc.errors import SolverError, WeightsError
from impc.inverse.cross_check import cross_checked
from impc.inverse.estimates import Estimate
from impc.inverse.methods import METHODS
from impc.inverse.problem import Problem, aims, simulated
from impc.inverse.structured import fit_structured
from impc.studies.fit.asked import (
    fit_structures,
    output_feedback,
)
from impc.studies.fit.first import FitProgress, attempted, first_fits
from impc.studies.fit.result import LITTLE, FitResult, FittedParameter
from impc.studies.fit.settings import FitSettings, ObserverSettings
from impc.studies.fit.uncertainty import assess, count_stages
from impc.studies.pool import threads

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from concurrent.futures import ThreadPoolExecutor

    import pandas as pd

    from impc.assess.assessments import MethodFit
    from impc.assess.lack_of_fit import LackOfFit
    from impc.assess.printed_gain import GainEstimate
    from impc.assess.structures import StructureFit
    from impc.assess.variance_accounted_for import HeldOut, TrialAgreement
    from impc.assess.weights_ranges import WeightsSummary
    from impc.control.simulation import Simulation
    from impc.model.bounds import Bounds
    from impc.output_feedback.models import PersonReport
    from impc.studies.fit.uncertainty import Attempt

_THREADS = 2
_UNUSABLE = "the controller explains less than half of a recorded signal (VAF below 50 %)."


def stages(problem: Problem, settings: FitSettings) -> int:
    """Number of stages that `fit_recordings` reports."""
    trials = len(problem.recordings)
    left_out = trials if _leaves_out(trials, settings) else 0
    structures = (settings.structure is not None) + len(settings.structures)
    models = 0
    if settings.observer is not None:
        feedback = output_feedback()
        models = len(feedback.persons(problem, *_asked(problem, settings.observer))) + 1
    others = structures + models + count_stages(problem, settings)
    return 1 + len(_beside(settings)) + left_out + others


def _beside(settings: FitSettings) -> tuple[str, ...]:
    """Methods that are compared with inverse MPC, in the order of the table."""
    first = ("preliminary",) if settings.feedback_states else ()
    return (*first, *settings.methods)


def fit_recordings(
    problem: Problem,
    settings: FitSettings,
    progress: FitProgress | Callable[[str], None] | bool | None = None,
) -> FitResult:
    """Fit a subject as `impc fit` does.

    With `progress` True a bar is shown; a callable is called with the name of each completed stage.
    """
    if progress is True:
        with tqdm(total=stages(problem, settings), unit="stage") as bar:

            def advance(name: str) -> None:
                bar.set_postfix_str(name, refresh=False)
                bar.update()

            return fit_recordings(problem, settings, advance)
    if settings.observer is not None:
        output_feedback()  # raises early if it is not installed
    if not isinstance(progress, FitProgress):
        progress = FitProgress(progress) if callable(progress) else FitProgress()
    return _fitted(problem, settings, progress)


def fit_alone(problem: Problem, settings: FitSettings) -> FitResult:
    """Fit a subject as `fit_recordings` does, without what only its own page shows.

    Left out are the other methods, the set of weights and analyses on request.
    """
    settings = replace(settings, structures=[], methods=[], profiles=[], horizons=[])
    settings = replace(settings, unknown_limit=False, replicates=0, observer=None)
    started, failures, progress = time.perf_counter(), dict[str, str](), FitProgress()
    attempt = functools.partial(attempted, failures)
    problem, progress, fitted, estimate, lack = first_fits(problem, progress, attempt)
    own = evaluate_method(fitted, problem.bounds)
    common = _common(problem, fitted, estimate, lack, own)
    free = common["weights_test"].rejected
    held = tuple(
        left_out(fitted, estimate, index, settings.settle, free=free)
        for index in range(len(problem.recordings))
        if _leaves_out(len(problem.recordings), settings)
    )
    skipped = (None, "Not computed in a cohort.")
    after = progress.done, progress.replicate, attempt
    return FitResult(
        settings=settings,
        uncertainty=assess(problem, fitted, estimate, skipped, settings, *after),
        held_out=held,
        methods=(_with_held_out(own, held),),
        terminal_set_difference=np.nan,
        seconds=time.perf_counter() - started,
        failures=failures,
        structures=_structures(problem, replace(settings, held_out=False), fitted, progress),
        **common,
    )


def _fitted(problem: Problem, settings: FitSettings, progress: FitProgress) -> FitResult:
    started, failures = time.perf_counter(), dict[str, str]()
    attempt = functools.partial(attempted, failures)
    problem, progress, fitted, estimate, lack = first_fits(problem, progress, attempt)
    found = _estimates(problem, fitted, settings, progress)
    if not np.array_equal(found["inverse_mpc"].gain, fitted.gain):  # improved from another method
        estimate = gain_estimate(found["inverse_mpc"])
    fitted = found["inverse_mpc"]
    *others, own = [evaluate_method(one, problem.bounds) for one in found.values()]
    common = _common(problem, fitted, estimate, lack, own)
    usable, test = bool(np.all(own.vaf >= LITTLE)), common["weights_test"]

    def whole_set(pool: ThreadPoolExecutor) -> tuple[WeightsSummary | None, str]:
        """Summary of all weights with the fitted gain, or None and the reason."""
        if not usable or test.rejected:
            return None, test.sentence if usable else _UNUSABLE
        plant, K = fitted.problem.with_nuisance_fixed().plant, np.array(fitted.gain)
        drawn = functools.partial(estimate_draws, plant, fitted.stage_weights, estimate)
        draws = attempt("drawn gains", drawn, ()) if settings.intent_draws else ()
        at = plant, K, np.array(fitted.metrics), np.array(common["intent"].sizes)
        return weights_summary_or_reason(*at, draws, pool.map)

    methods, held_out, weights_found = _beside_it(
        estimate, own, others, settings, progress, attempt, whole_set, rejected=test.rejected
    )
    structures = _structures(problem, settings, fitted, progress)
    after = progress.done, progress.replicate, attempt
    uncertainty = assess(problem, fitted, estimate, weights_found, settings, *after)
    body_known = replace(fitted, problem=fitted.problem.with_body_fixed())
    person = functools.partial(_person, problem, settings, body_known, progress)
    terminal = functools.partial(_terminal_set_difference, methods[-1])
    return FitResult(
        settings=settings,
        uncertainty=uncertainty if usable else replace(uncertainty, intervals=()),
        held_out=held_out,
        methods=methods,
        terminal_set_difference=attempt("terminal set", terminal, np.nan),
        failures=failures,
        structures=structures,
        person=attempt("subject with sensory noise", person, None),
        ceiling=ceiling(fitted.problem, settings.settle),
        commands=attempt("regression of commands", functools.partial(_regressed, fitted), None),
        response=frequency_response(fitted.problem, methods[-1].runs),
        seconds=time.perf_counter() - started,
        **common,
    )


def _common(
    problem: Problem,
    fitted: Estimate,
    estimate: GainEstimate,
    lack: tuple[LackOfFit | None, ...],
    own: MethodFit,
) -> dict[str, Any]:
    """The parts of every result, by the names of its attributes."""
    known, weights = fitted.problem.with_nuisance_fixed(), fitted.stage_weights
    K, metrics, sizes = np.array(fitted.gain), np.array(fitted.metrics), state_sizes(own.runs)
    doubted = lack[-1] is not None and lack[-1].alarm
    return {
        "given": problem,
        "fitted": fitted,
        "estimate": estimate,
        "parameters": _parameters(estimate),
        "intent": intent(known.plant, K, metrics, sizes, weights),
        "identifiability": identifiability(known, weights),
        "trials": _agreements(known, own.runs, problem.bounds),
        "lack": lack,
        "weights_test": weights_test(fitted, estimate, contradicted=doubted),
    }


def _with_held_out(own: MethodFit, held: Sequence[HeldOut]) -> MethodFit:
    return replace(own, held_out=frozen([item.vaf for item in held])) if held else own


def _regressed(fitted: Estimate) -> pd.DataFrame | None:
    """Gain by regression on recorded commands; None without them, or for command changes."""
    problem = fitted.problem
    recorded = any(len(trial.commands) for trial in problem.recordings)
    return command_regression(fitted) if recorded and not problem.plant.commands else None


def _estimates(
    problem: Problem, fitted: Estimate, settings: FitSettings, progress: FitProgress
) -> dict[str, Estimate]:
    """Estimates of all methods, inverse MPC last; each also tries the solutions of the others."""

    def estimate(name: str) -> Estimate:
        compute = functools.partial(METHODS[name].estimate, problem, fitted)
        return progress.estimate(name, compute)

    names = _beside(settings)
    with threads(_THREADS) as pool:
        found = dict(zip(names, pool.map(estimate, names), strict=True))
    return cross_checked(problem, found | {"inverse_mpc": fitted})


def _beside_it(
    estimate: GainEstimate,
    own: MethodFit,
    others: list[MethodFit],
    settings: FitSettings,
    progress: FitProgress,
    attempt: Attempt,
    whole_set: Callable[[ThreadPoolExecutor], tuple[WeightsSummary | None, str]],
    *,
    rejected: bool,
) -> tuple[tuple[MethodFit, ...], tuple[HeldOut, ...], tuple[WeightsSummary | None, str]]:
    """Other methods, left-out trials and the set of weights, in parallel."""
    held_out: list[HeldOut | None] = []
    fitted, trials = own.estimate, len(own.estimate.problem.recordings)
    with threads(_THREADS) as pool:
        without = functools.partial(
            left_out, fitted, estimate, settle=settings.settle, free=rejected
        )
        pending = [
            pool.submit(attempt, _without(index), functools.partial(without, index), None)
            for index in range(trials if _leaves_out(trials, settings) else 0)
        ]
        for found in others:
            progress.done(found.estimate.method)
        found_set = whole_set(pool)
        progress.done("set of weights")
        for index, other in enumerate(pending):
            held_out.append(other.result())
            progress.done(_without(index))
    held = tuple(one for one in held_out if one is not None)
    if len(held) < len(held_out):
        held = ()  # the table has rows for all trials or for none
    return (*others, _with_held_out(own, held)), held, found_set


def _person(
    problem: Problem, settings: FitSettings, fitted: Estimate, progress: FitProgress
) -> PersonReport | None:
    """Fit of the model with sensory noise, if requested."""
    asked = settings.observer
    if asked is None:
        return None
    report: PersonReport = output_feedback().person_report(
        fitted,
        *_asked(problem, asked),
        profiled=asked.profiles,
        done=progress.done,
        remember=progress.part,
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
    problem: Problem, settings: FitSettings, fitted: Estimate, progress: FitProgress
) -> tuple[StructureFit, ...]:
    """Fits of all structures in the settings, started at the unrestricted weights."""
    found, held_out = [], _leaves_out(len(problem.recordings), settings)
    for index, structure in enumerate(fit_structures(problem.plant, settings)):
        stage = f"structure {index + 1}"
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


def _agreements(
    known: Problem, runs: Sequence[Simulation], bounds: Bounds
) -> tuple[TrialAgreement, ...]:
    return tuple(
        agreement(known.plant, trial, run, np.array(bounds.u_min), np.array(bounds.u_max))
        for trial, run in zip(known.recordings, runs, strict=True)
    )


def _leaves_out(trials: int, settings: FitSettings) -> bool:
    return settings.held_out and trials > 1


def _without(index: int) -> str:
    return f"without trial {index + 1}"


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


def _terminal_set_difference(fitted: MethodFit) -> float:
    """Largest change of a scaled output if the terminal set is added (or removed)."""
    found = fitted.estimate
    if aims(found.problem.plant, found.problem.recordings):
        return float("nan")
    problem = replace(found.problem, terminal_set=not found.problem.terminal_set)
    pair = [fitted.runs, simulated(problem, found.gain, found.metric)]
    if not all(run.complete for runs in pair for run in runs):
        return float("nan")
    return max(
        float(np.max(np.abs((a.x - b.x) @ problem.plant.C.T / problem.output_scale)))
        for a, b in zip(*pair, strict=True)
    )
