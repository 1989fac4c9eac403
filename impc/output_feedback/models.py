"""Fit competing sensorimotor models to the same recordings, for a comparison by AIC.

A fit is stored as the start of its coordinates and its final unknowns: evaluating the likelihood
once reproduces it to the last digit.
"""

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
from impc.output_feedback import intervals
from impc.output_feedback.fit import fit_output_feedback, person_at
from impc.output_feedback.joint_loop import joint_loop
from impc.output_feedback.observer import Observer
from impc.output_feedback.page import PersonModel, PersonReport
from impc.output_feedback.simulation import run_joint
from impc.output_feedback.unknowns import Request, space_at

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem
    from impc.model.plant import Plant
    from impc.model.recordings import Recording
    from impc.output_feedback.fit import OutputFeedbackFit

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
    for name, posed, person in persons(found.problem, asked, walk):
        first, budget = replace(found, problem=posed), _BESIDE if models else _ASKED
        fit_one = functools.partial(_model, name, first, person, budget)
        decode = functools.partial(decode_model, name, posed, person)
        models.append(remember(name, fit_one, encode_model, decode))
        done(name)
    fit, plant, none = models[0].fit, found.problem.plant, frozen(np.zeros((0, 2)))
    report = PersonReport(
        tuple(models), plant, found.gain, fit, None, profiled, none, none, np.nan,
        frozen([np.nan] * len(plant.outputs)), (), frozen([[]]),
    )  # fmt: skip
    if fit is not None:
        covariance = intervals.person_covariance(fit)
        levels, entries = covariance.level_intervals(fit.levels), covariance.entry_intervals(fit.K)
        if profiled:
            levels = intervals.level_intervals(fit, covariance)
            entries = intervals.entry_intervals(fit, covariance)
        ahead = tuple(sorted({1 + round(time / plant.dt) for time in _AHEAD}))
        report = replace(
            report,
            covariance=covariance,
            levels=levels,
            entries=entries,
            confusion=intervals.confusion(fit),
            whiteness=frozen(_white(fit)),
            ahead=ahead,
            errors=frozen(prediction_errors(fit, ahead)),
        )
    done("intervals of the person")
    return report


def _model(name: str, first: Estimate, person: Observer, budget: int) -> PersonModel:
    try:
        return PersonModel(name, fit_output_feedback(first, person, max_evaluations=budget), "")
    except ImpcError as error:
        return PersonModel(name, None, str(error))


def encode_model(model: PersonModel) -> dict[str, Any]:
    """JSON values of a model, fitted or not."""
    fit = model.fit
    if fit is None:
        return {"fit": None, "reason": model.reason}
    names = ("theta", "unseen", "converged", "evaluations")
    kept = fit.space.origin | {name: getattr(fit, name) for name in names}
    values = {name: np.asarray(one).tolist() for name, one in kept.items()}
    return {"fit": values, "reason": model.reason}


def decode_model(
    name: str, problem: Problem, observer: Observer, kept: dict[str, Any]
) -> PersonModel:
    """Rebuild the model."""
    given = kept["fit"]
    if given is None:
        return PersonModel(name, None, kept["reason"])
    space = space_at(problem, Request(observer), given)
    place, unseen = space.at(np.array(given["theta"])), np.array(given["unseen"])
    fit = person_at(space, place, unseen, given["converged"], given["evaluations"])
    return PersonModel(name, fit, kept["reason"])


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
    lags, trials = max(_LEAST_LAGS, round(1 / fit.problem.plant.dt)), fit.identified.trials
    joined = np.concatenate(
        [one.innovations / np.sqrt(np.einsum("tpp->tp", one.spreads)) for one in trials]
    )
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
