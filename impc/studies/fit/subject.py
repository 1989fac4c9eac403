"""Fit the bounded controller of a subject to all trials (section 3.5).

Preliminary gain and physical parameters (3.19), bounds (3.22), weights of the controller from all
trials with an initial state for each, VAF (3.24) in fitted and left-out trials, intent (3.23) to
(3.26), and the other methods on the same recordings.
"""

from __future__ import annotations

import functools
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from tqdm.auto import tqdm

from impc.arrays import Array, frozen
from impc.assess.assessments import evaluate_method
from impc.assess.ceiling import ceiling
from impc.assess.diagnosis import Diagnosis, diagnosed
from impc.assess.frequency_response import frequency_response
from impc.assess.input_limits import LimitCurve, limit_curve
from impc.assess.intent import intent
from impc.assess.lack_of_fit import LackOfFit, lack_of_fit
from impc.assess.printed_gain import command_regression, gain_estimate
from impc.assess.structures import assess_structure, no_structure
from impc.assess.variance_accounted_for import agreement, left_out
from impc.assess.weights_ranges import estimate_draws, weights_summary_or_reason
from impc.assess.weights_test import identifiability, weights_test
from impc.checking import checked, replace
from impc.errors import DataError, ImpcError, SolverError, WeightsError
from impc.inverse.cross_check import cross_checked
from impc.inverse.estimates import Estimate
from impc.inverse.methods import METHODS, fit
from impc.inverse.noisy_fit import first_end, fit_controller
from impc.inverse.problem import Problem, aims, simulated
from impc.inverse.refit import refit
from impc.inverse.search import FEW, with_jumps
from impc.inverse.structured import fit_structured
from impc.model.foresight import physical_states
from impc.studies.fit.asked import (
    fit_bounds,
    fit_structures,
    moving_body,
    output_feedback,
    require_dressed,
)
from impc.studies.fit.result import LITTLE, FitResult, FittedParameter
from impc.studies.fit.settings import FitSettings, ObserverSettings
from impc.studies.fit.uncertainty import assess, count_stages
from impc.studies.pool import threads

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from concurrent.futures import ThreadPoolExecutor

    import pandas as pd

    from impc.assess.assessments import MethodFit
    from impc.assess.printed_gain import GainEstimate
    from impc.assess.resampling import Replicate
    from impc.assess.structures import StructureFit
    from impc.assess.variance_accounted_for import HeldOut, TrialAgreement
    from impc.assess.weights_ranges import WeightsSummary
    from impc.control.simulation import Simulation
    from impc.inverse.unknowns import Fitted
    from impc.model.bounds import Bounds
    from impc.model.plant import Plant
    from impc.model.plant_family import PlantFamily
    from impc.model.recordings import Recording
    from impc.output_feedback.models import PersonReport
    from impc.studies.fit.uncertainty import Attempt

_THREADS = 2
# Evidence (-log p) of an alarm in a first search that cannot come from its early end.
_PLAIN = 50.0
_UNUSABLE = "the controller explains less than half of a recorded signal (VAF below 50 %)."


@dataclass(frozen=True)
class FitProgress:
    """Callbacks that report progress and return stored results of an interrupted fit."""

    done: Callable[[str], None] = lambda _: None  # Called with the name of each completed stage
    # (name of stage, compute) -> estimate, stored (`impc.studies.fit.memory`) or computed
    estimate: Callable[[str, Callable[[], Estimate]], Estimate] = lambda _, compute: compute()
    # (name of stage, compute) -> bootstrap replicate, stored or computed
    replicate: Callable[[str, Callable[[], Replicate]], Replicate] = lambda _, compute: compute()
    # (name of stage, compute, encode, decode) -> result of an optional subpackage
    part: Callable[..., Any] = lambda _name, compute, _encode, _decode: compute()
    # Callbacks for a problem with one more unknown; None if nothing is stored
    about: Callable[[Problem], FitProgress] | None = None

    def anew(self, problem: Problem) -> FitProgress:
        """Callbacks for another problem."""
        return FitProgress(self.done) if self.about is None else self.about(problem)


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


@checked
def fit_problem(
    plant: Plant,
    recordings: Sequence[Recording],
    settings: FitSettings,
    family: PlantFamily | None = None,
) -> Problem:
    """Pose the inverse problem of a subject with scaled outputs and unknown initial states.

    Parameters
    ----------
    plant : Plant
        Plant; its disturbances are the recorded perturbations.
    recordings : sequence of Recording
        Trials of one subject.
    settings : FitSettings
        Horizon, bounds and options.
    family : PlantFamily, optional
        Plant as a function of the physical parameters that are fitted with the gain.

    Returns
    -------
    Problem
        Each output is scaled by its root mean square over all trials.

    Raises
    ------
    DataError, InputError, BoundsError
        If there is no recording, a trial is too short, an output is zero in all trials, or a bound
        cannot be set.

    Examples
    --------
    >>> import control
    >>> import impc
    >>> plant = impc.Plant(control.ss([[1.1]], [[1]], [[1]], 0, 1))
    >>> law = impc.Controller(plant, impc.Weights(1, 1), impc.Bounds(plant), horizon=3)
    >>> trial = impc.Recording(plant, law.simulate([1.0], steps=30).x)
    >>> problem = impc.fit_problem(plant, [trial], impc.FitSettings(horizon=3, u_max=0.5))
    >>> problem.unknown_start, problem.bounds.u_max
    (True, array([0.5]))
    """
    if not recordings:
        raise DataError("recordings", "the list is empty", "pass at least one trial")
    outputs = np.concatenate([trial.outputs for trial in recordings])
    scale = np.sqrt(np.nanmean(outputs**2, axis=0))
    for name, size in zip(plant.outputs, scale, strict=True):
        if size == 0:
            raise DataError(f"output {name}", "is zero in every trial", "check its column")
    shortest = min(trial.samples for trial in recordings)
    least = round(settings.settle / plant.dt) + physical_states(plant)
    if shortest <= least:
        raise DataError(
            "recordings",
            f"the shortest trial has {shortest} samples, but its initial state needs {least}",
            "use longer trials, or lower [fit] settle",
        )
    require_dressed(plant, settings)
    plant, family = moving_body(plant, family, settings)
    posed = Problem(
        plant,
        fit_bounds(plant, settings, recordings),
        settings.horizon,
        tuple(_first_guess(plant, trial) for trial in recordings),
        terminal_set=None if settings.terminal_set == "auto" else settings.terminal_set,
        output_scale=scale,
        offsets=settings.offsets,
        signal_errors=settings.signal_errors,
        unknown_start=True,
        family=family,
        structure=next(iter(fit_structures(plant, settings)), None),
        feedback_states=settings.feedback_states,
        solver=settings.solver,
    )
    return with_jumps(posed)


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

    Left out are the other methods, the set of weights, limit curves and analyses on request.
    """
    settings = replace(settings, structures=[], methods=[], profiles=[], horizons=[])
    settings = replace(settings, unknown_limit=False, replicates=0, observer=None)
    started, failures = time.perf_counter(), dict[str, str]()
    attempt, progress = functools.partial(_attempt, failures), FitProgress()
    problem, progress, fitted, estimate, lack = _first_fits(problem, progress, attempt)
    own = evaluate_method(fitted, problem.bounds)
    doubted = lack[-1] is not None and lack[-1].alarm
    test = weights_test(fitted, estimate, contradicted=doubted)
    trials = len(problem.recordings)
    held = [
        left_out(fitted, estimate, index, settings.settle, free=test.rejected)
        for index in range(trials if _leaves_out(trials, settings) else 0)
    ]
    if held:
        own = replace(own, held_out=frozen([item.vaf for item in held]))
    known, weights = fitted.problem.with_nuisance_fixed(), fitted.stage_weights
    K, metrics, sizes = np.array(fitted.gain), np.array(fitted.metrics), state_sizes(own.runs)
    skipped = (None, "Not computed in a cohort.")
    after = progress.done, progress.replicate, attempt
    return FitResult(
        settings,
        problem,
        fitted,
        estimate,
        _parameters(estimate),
        intent(known.plant, K, metrics, sizes, weights),
        identifiability(known, weights),
        assess(problem, fitted, estimate, skipped, settings, *after),
        _agreements(known, own.runs, problem.bounds),
        tuple(held),
        (own,),
        lack,
        float("nan"),
        time.perf_counter() - started,
        test,
        failures,
        _structures(problem, replace(settings, held_out=False), fitted, progress),
    )


def _attempt(failures: dict[str, str], stage: str, compute: Callable[[], Any], default: Any) -> Any:
    """Result of a stage; if it fails, the default, with the reason in `failures`."""
    try:
        return compute()
    except (ImpcError, np.linalg.LinAlgError) as error:
        failures[stage] = str(error)
        return default


def _fitted(problem: Problem, settings: FitSettings, progress: FitProgress) -> FitResult:
    started = time.perf_counter()
    failures: dict[str, str] = {}
    attempt = functools.partial(_attempt, failures)
    problem, progress, fitted, estimate, lack = _first_fits(problem, progress, attempt)
    found = _estimates(problem, fitted, settings, progress)
    if not np.array_equal(found["inverse_mpc"].gain, fitted.gain):  # improved from another method
        estimate = gain_estimate(found["inverse_mpc"])
    fitted = found["inverse_mpc"]
    known, weights = fitted.problem.with_nuisance_fixed(), fitted.stage_weights
    plant, K, metrics = known.plant, np.array(fitted.gain), np.array(fitted.metrics)
    *others, own = [evaluate_method(one, problem.bounds) for one in found.values()]
    sizes = state_sizes(own.runs)
    usable = bool(np.all(own.vaf >= LITTLE))
    doubted = lack[-1] is not None and lack[-1].alarm
    test = weights_test(fitted, estimate, contradicted=doubted)

    def whole_set(pool: ThreadPoolExecutor) -> tuple[WeightsSummary | None, str]:
        """Summary of all weights with the fitted gain, or None and the reason."""
        if not usable or test.rejected:
            return None, test.sentence if usable else _UNUSABLE
        drawn = functools.partial(estimate_draws, plant, weights, estimate)
        draws = attempt("drawn gains", drawn, ()) if settings.intent_draws else ()
        return weights_summary_or_reason(plant, K, metrics, sizes, draws, pool.map)

    methods, held_out, weights_found, curves = _beside_it(
        estimate, own, others, settings, progress, attempt, whole_set, rejected=test.rejected
    )
    structures = _structures(problem, settings, fitted, progress)
    after = progress.done, progress.replicate, attempt
    uncertainty = assess(problem, fitted, estimate, weights_found, settings, *after)
    trials = _agreements(known, methods[-1].runs, problem.bounds)
    body_known = replace(fitted, problem=fitted.problem.with_body_fixed())
    person = functools.partial(_person, problem, settings, body_known, progress)
    return FitResult(
        settings,
        problem,
        fitted,
        estimate,
        _parameters(estimate),
        intent(plant, K, metrics, sizes, weights),
        identifiability(known, weights),
        uncertainty if usable else replace(uncertainty, intervals=()),
        trials,
        held_out,
        methods,
        lack,
        attempt("terminal set", functools.partial(_terminal_set_difference, methods[-1]), np.nan),
        time.perf_counter() - started,
        test,
        failures,
        structures,
        attempt("subject with sensory noise", person, None),
        ceiling(fitted.problem, settings.settle),
        attempt("regression of commands", functools.partial(_regressed, fitted), None),
        curves,
        frequency_response(fitted.problem, methods[-1].runs),
    )


def _curves(fitted: Estimate, own: MethodFit) -> tuple[LimitCurve, ...]:
    """Limit curve of each input that reaches its limit."""
    reached = own.largest_input >= (1 - 1e-6) * np.asarray(fitted.problem.bounds.u_max)
    found = [limit_curve(fitted, int(control)) for control in np.flatnonzero(reached)]
    return tuple(curve for curve in found if curve is not None)


def _regressed(fitted: Estimate) -> pd.DataFrame | None:
    """Gain by regression on recorded commands; None without them, or for command changes."""
    problem = fitted.problem
    recorded = any(len(trial.commands) for trial in problem.recordings)
    return command_regression(fitted) if recorded and not problem.plant.commands else None


def _first_fits(
    problem: Problem, progress: FitProgress, attempt: Attempt
) -> tuple[Problem, FitProgress, Estimate, GainEstimate, tuple[LackOfFit | None, ...]]:
    """Inverse MPC, with one more unknown if tests of a first search or of the fit point to it."""

    def tested(at: GainEstimate | Fitted) -> LackOfFit | None:
        found: LackOfFit | None
        found = attempt("test of the model", functools.partial(lack_of_fit, at), None)
        return found

    def cause_of(at: Fitted, found: LackOfFit | None, least: float = 0.0) -> Diagnosis | None:
        compute = functools.partial(diagnosed, problem, at, found, least)
        cause: Diagnosis | None = attempt("diagnosis", compute, None)
        return cause

    search = functools.partial(first_end, problem)
    first = attempt("first search", search, None) if problem.recorded_numbers > FEW else None
    begins: tuple[Fitted, ...] = () if first is None else (first,)
    cause = None if first is None else cause_of(first, tested(first), _PLAIN)
    while True:
        if cause is not None and cause.problem is not None:
            problem, begins = cause.problem, cause.ends
            progress = progress.anew(problem)
        fitted = progress.estimate("inverse_mpc", functools.partial(_whole_fit, problem, begins))
        estimate = gain_estimate(fitted)
        last = tested(estimate)
        if cause is None:  # the first search raised no clear alarm
            end = refit(fitted.problem, np.array(fitted.gain), np.array(fitted.metric))
            cause = cause_of(end, last)
            if cause is not None and cause.problem is not None:
                continue
        progress.done("inverse MPC")
        freed = cause is not None and cause.problem is not None
        before = (cause.found,) if cause is not None and freed else ()
        return problem, progress, fitted, estimate, (*before, last)


def _whole_fit(problem: Problem, begins: tuple[Fitted, ...]) -> Estimate:
    """Fit from the ends of first searches, if there are any."""
    if not begins:
        return fit(problem)
    started = time.perf_counter()
    return replace(fit_controller(problem, begins), seconds=time.perf_counter() - started)


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
) -> tuple[
    tuple[MethodFit, ...],
    tuple[HeldOut, ...],
    tuple[WeightsSummary | None, str],
    tuple[LimitCurve, ...],
]:
    """Other methods, left-out trials, limit curves and the set of weights, in parallel."""
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
        limits = pool.submit(attempt, "limit curve", functools.partial(_curves, fitted, own), ())
        for found in others:
            progress.done(found.estimate.method)
        found_set = whole_set(pool)
        progress.done("set of weights")
        for index, other in enumerate(pending):
            held_out.append(other.result())
            progress.done(_without(index))
        curves = limits.result()
    held = tuple(one for one in held_out if one is not None)
    if len(held) < len(held_out):
        held = ()  # the table has rows for all trials or for none
    if held:
        own = replace(own, held_out=frozen([item.vaf for item in held]))
    return (*others, own), held, found_set, curves


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


def _first_guess(plant: Plant, trial: Recording) -> Recording:
    """Start of the search for x0: rest, or the first output if there is no disturbance."""
    if np.any(trial.disturbance) or np.any(trial.x0):
        return trial
    return replace(trial, x0=frozen(np.linalg.pinv(plant.C) @ np.nan_to_num(trial.outputs[0])))


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
