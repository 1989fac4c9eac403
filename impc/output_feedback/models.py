"""Fit competing sensorimotor models to the same recordings and compare them by AIC."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.arrays import Array, frozen
from impc.assess.variance_accounted_for import whiteness
from impc.checking import replace
from impc.control.aims import aim_of, window
from impc.control.closed_loop import prepare_loop
from impc.control.constraint_rows import directions
from impc.errors import ImpcError
from impc.inverse.problem import controller_for, drive_of
from impc.inverse.regulator_span import kept_to
from impc.model.bounds import bound_rows
from impc.output_feedback import profile
from impc.output_feedback.covariance import confusion, person_covariance
from impc.output_feedback.fit import OutputFeedbackFit, fit_output_feedback
from impc.output_feedback.joint_loop import joint_loop
from impc.output_feedback.kept import decode_model, encode_model
from impc.output_feedback.observer import Observer
from impc.output_feedback.page import PersonModel, PersonReport
from impc.output_feedback.simulation import run_joint

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem
    from impc.model.plant import Plant
    from impc.model.recordings import Recording

# Horizons in s at which predictions are evaluated; largest number of starts in a trial.
_AHEAD, _STARTS = (0.0, 0.1, 0.5), 100
# Evaluation budgets: requested model, comparison models; the report says if a fit hit its budget.
_ASKED, _BESIDE = 250, 60
# Initial signal-dependent motor noise as a share of the command (typical of isometric force).
_SHARE = 0.1
# Lags of the whiteness test: 1 s, which shows a missed rhythm; at least this many.
_LEAST_LAGS = 10


#: (name, compute, encode, decode) -> the model, from the store or computed.
Remember = Callable[
    [str, Callable[[], PersonModel], Callable[[PersonModel], Any], Callable[[Any], PersonModel]],
    PersonModel,
]


def person_report(
    found: Estimate,
    asked: Observer,
    walk: Array,
    *,
    profiled: bool = False,
    done: Callable[[str], None] = lambda _: None,
    remember: Remember = lambda _name, compute, _encode, _decode: compute(),
) -> PersonReport:
    """Fit the requested and the comparison models, starting from a least squares fit.

    `walk` (d,); `remember` (name, compute, encode, decode).
    """
    models: list[PersonModel] = []
    problem = found.problem
    for name, posed, person in persons(problem, asked, walk):
        budget = _BESIDE if models else _ASKED
        first = replace(found, problem=posed)
        fit_one = functools.partial(_model, name, first, person, budget)
        decode = functools.partial(decode_model, name, posed, person)
        models.append(remember(name, fit_one, encode_model, decode))
        done(name)
    fit = models[0].fit
    if fit is None:
        done("intervals of the person")
        return _nothing(tuple(models), found, profiled=profiled)
    covariance = person_covariance(fit)
    levels, entries = covariance.level_intervals(fit.levels), covariance.entry_intervals(fit.K)
    if profiled:
        levels = profile.level_intervals(fit, covariance)
        entries = profile.entry_intervals(fit, covariance)
    done("intervals of the person")
    ahead = tuple(sorted({1 + round(time / problem.plant.dt) for time in _AHEAD}))
    return PersonReport(
        tuple(models),
        problem.plant,
        found.gain,
        fit,
        covariance,
        profiled,
        levels,
        entries,
        confusion(fit),
        frozen(_white(fit)),
        ahead,
        frozen(prediction_errors(fit, ahead)),
    )


def _nothing(models: tuple[PersonModel, ...], found: Estimate, *, profiled: bool) -> PersonReport:
    """Report if the likelihood of the requested model is undefined."""
    none = frozen(np.zeros((0, 2)))
    plant = found.problem.plant
    white = frozen([np.nan] * len(plant.outputs))
    return PersonReport(
        models, plant, found.gain, None, None, profiled, none, none, None, white, (), frozen([[]])
    )


def _model(name: str, first: Estimate, person: Observer, budget: int) -> PersonModel:
    try:
        return PersonModel(name, fit_output_feedback(first, person, max_evaluations=budget), "")
    except ImpcError as error:
        return PersonModel(name, None, str(error))


def asked_observer(
    plant: Plant,
    recordings: Sequence[Recording],
    *,
    sensed: Sequence[str],
    motor: bool,
    share: bool,
    process: bool,
    known: bool,
) -> tuple[Observer, Array]:
    """Observer that [fit.observer] requests, and step SDs of an unknown perturbation (d,).

    The noise SDs are placeholders: the search starts from those that the residuals suggest.
    """
    steps = np.concatenate([np.diff(trial.disturbance, axis=0) for trial in recordings])
    size = np.sqrt(np.mean(steps**2, axis=0))
    walk = np.where(size > 0, size, 1.0)
    person = Observer(
        plant,
        sensed,
        motor=float(motor),
        share=_SHARE * share,
        process=float(process),
        sensory=1.0,
        walk=None if known else walk,
    )
    return person, walk


def persons(problem: Problem, asked: Observer, walk: Array) -> list[tuple[str, Problem, Observer]]:
    """Models to compare: name, problem and observer, the requested one first; `walk` (d,)."""
    seeing = replace(asked, sensed=(), C=asked.C[:0], sensory=asked.sensory[:0], walk=None)
    quiet = replace(seeing, motor=0 * asked.motor, share=0 * asked.share, process=0 * asked.process)
    models = []
    if asked.estimates:
        models += [("estimates, perturbation known", problem, replace(asked, walk=None))]
        if len(walk):
            unknown = replace(asked, walk=walk if asked.walk is None else asked.walk)
            models.append(("estimates, perturbation not known", problem, unknown))
        if asked.walk is not None:
            models.reverse()
    if np.any(seeing.levels):
        models.append(("sees every state, noise in the loop", problem, seeing))
    models.append(("sees every state, noise in the recorder alone", problem, quiet))
    if kept_to(problem) is not None:
        models.append((f"{models[0][0]}, any gain", replace(problem, structure=None), asked))
    if len(bound_rows(problem.bounds, problem.plant).b):
        models.append((f"{models[0][0]}, no limit", problem.without_bounds(), asked))
    return models


def _white(fit: OutputFeedbackFit) -> Array:
    """Whiteness p-values of the standardised innovations of all trials, concatenated."""
    lags = max(_LEAST_LAGS, round(1 / fit.problem.plant.dt))
    rows = []
    for trial in fit.identified.trials:
        deviations = np.sqrt(np.einsum("tpp->tp", trial.spreads))
        rows.append(trial.innovations / deviations)
    joined = np.concatenate(rows)
    return whiteness(joined, min(lags, len(joined) - 1))


def prediction_errors(fit: OutputFeedbackFit, ahead: tuple[int, ...]) -> Array:
    """Root-mean-square prediction errors (k, p) of the filter, k numbers of samples `ahead`.

    From the filtered state the plant is simulated without noise, with recorded perturbations.
    """
    problem, plant = fit.problem, fit.problem.plant
    controller = controller_for(problem, fit.K, fit.S)
    law = prepare_loop(controller, directions(controller, 0), whole=True)
    joint = joint_loop(plant, fit.observer, fit.recorder)
    farthest = max(ahead)
    quiet = np.zeros((farthest, len(joint.F))), np.zeros((farthest, plant.m))
    errors = []
    for trial, identified in zip(problem.recordings, fit.identified.trials, strict=True):
        starts = range(0, trial.samples - farthest, max(1, trial.samples // _STARTS))
        aim = aim_of(controller, drive_of(trial, trial.x0), law.along)
        for t in starts:
            driven = np.array(trial.disturbance[t : t + farthest])
            start, part = identified.filtered[t], window(aim, t, farthest)
            z, _, _ = run_joint(law, joint, start, driven, part, quiet)
            expected = z[list(ahead)] @ joint.C.T
            errors.append(expected - trial.outputs[t + np.array(ahead)])
    if not errors:
        return np.full((len(ahead), len(plant.outputs)), np.nan)
    return np.asarray(np.sqrt(np.mean(np.square(errors), axis=0)))
