"""Models of how a person senses, side by side, and what the one that was asked for leaves.

Each is fitted by maximum likelihood to the same recordings, from the same first fit, so that
Akaike's criterion compares them: noise in the recorder alone, which is least squares; a person who
sees every state and has noise in the loop; who estimates, the perturbation known, and not known;
the one that was asked for with any gain, where a structure says which there are; and the same
without its limits (docs/noisy-people.md).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.assess import person_profile
from impc.assess.person_covariance import confusion, person_covariance
from impc.assess.variance_accounted_for import whiteness
from impc.checking import replace
from impc.control.closed_loop import prepare_loop
from impc.control.constraint_rows import directions
from impc.control.joint_loop import joint_loop
from impc.control.noisy_person import run_joint
from impc.control.simulation import Status
from impc.errors import ImpcError
from impc.inverse.likelihood_fit import PersonFit, fit_person
from impc.inverse.problem import controller_for
from impc.inverse.regulator_span import kept_to
from impc.model.bounds import bound_rows

if TYPE_CHECKING:
    from impc.assess.person_covariance import Confusion, PersonCovariance
    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem
    from impc.model.observer import Observer

# Samples ahead of which predictions are judged, as seconds; and how many starts in a trial at most.
_AHEAD, _STARTS = (0.0, 0.1, 0.5), 100
# Likelihoods with derivatives of the model that was asked for, and of those beside it, whose page
# says where that was not enough.
_ASKED, _BESIDE = 250, 60
# One second of lags tells a rhythm that was missed; fewer than ten tell nothing.
_LEAST_LAGS = 10


@dataclass(frozen=True)
class PersonModel:
    """One model."""

    name: str  # In words
    fit: PersonFit | None  # None where it has no likelihood
    reason: str  # Why it has none


#: (name, problem, person, compute) -> the model: from memory, or computed now.
RememberPerson = Callable[[str, "Problem", "Observer", Callable[[], PersonModel]], PersonModel]


def afresh_person(
    _name: str, _problem: Problem, _person: Observer, make: Callable[[], PersonModel]
) -> PersonModel:
    """`make` a model, whatever `_name`, `_problem` and `_person`: nothing is remembered."""
    return make()


@dataclass(frozen=True)
class PersonReport(Frozen):
    """What is said of a person who senses with noise."""

    models: tuple[PersonModel, ...]  # The first is the one that was asked for
    fit: PersonFit | None  # That one; None where it has no likelihood
    # Of `fit`, by the sandwich; None where it has no likelihood
    covariance: PersonCovariance | None
    profiled: bool  # Whether intervals follow the likelihood
    # Intervals of 95 % of its levels (l, 2), in their units: by the sandwich, or where profiled by
    # profile for a level that is weakly told
    levels: Array
    # The same of the entries of its gain (entries, 2); where profiled all by profile, NaN where an
    # entry is not told by itself
    entries: Array
    confusion: Confusion | None  # What of gain and noise is told least apart
    whiteness: Array  # p-values that the innovations of each output are white (p,)
    ahead: tuple[int, ...]  # Samples ahead
    # Root-mean-square errors of predictions so far ahead (k, p), in the outputs' units
    errors: Array

    @property
    def at_limit(self) -> bool:
        """Whether a bound was met, so that the likelihood is an approximation."""
        return self.fit is not None and any(
            np.any(trial.status != Status.FREE) for trial in self.fit.told.trials
        )


def person_report(
    found: Estimate,
    asked: Observer,
    walk: Array,
    *,
    profiled: bool = False,
    done: Callable[[str], None] = lambda _: None,
    remember: RememberPerson = afresh_person,
) -> PersonReport:
    """Fit a person and the models beside, from a fit of least squares.

    `walk` (d,); `remember` (name, problem, person, compute).
    """
    models: list[PersonModel] = []
    problem = found.problem
    for name, posed, person in persons(problem, asked, walk):
        budget = _BESIDE if models else _ASKED
        first = replace(found, problem=posed)
        fit_one = functools.partial(_model, name, first, person, budget)
        models.append(remember(name, posed, person, fit_one))
        done(name)
    fit = models[0].fit
    if fit is None:
        done("intervals of the person")
        return _nothing(tuple(models), len(problem.plant.outputs), profiled=profiled)
    covariance = person_covariance(fit)
    levels, entries = covariance.level_intervals(fit.levels), covariance.entry_intervals(fit.K)
    if profiled:
        levels = person_profile.level_intervals(fit, covariance)
        entries = person_profile.entry_intervals(fit, covariance)
    done("intervals of the person")
    ahead = tuple(sorted({1 + round(time / problem.plant.dt) for time in _AHEAD}))
    return PersonReport(
        tuple(models),
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


def _nothing(models: tuple[PersonModel, ...], outputs: int, *, profiled: bool) -> PersonReport:
    """What is said where the person that was asked for has no likelihood."""
    none = frozen(np.zeros((0, 2)))
    white = frozen([np.nan] * outputs)
    return PersonReport(models, None, None, profiled, none, none, None, white, (), frozen([[]]))


def _model(name: str, first: Estimate, person: Observer, budget: int) -> PersonModel:
    try:
        return PersonModel(name, fit_person(first, person, max_evaluations=budget), "")
    except ImpcError as error:
        return PersonModel(name, None, str(error))


def persons(problem: Problem, asked: Observer, walk: Array) -> list[tuple[str, Problem, Observer]]:
    """Each model that is compared: its name, the problem and the person; what is asked for first.

    `walk` (d,).
    """
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


def _white(fit: PersonFit) -> Array:
    """Of all trials together: standardised innovations, trial by trial, in a row."""
    lags = max(_LEAST_LAGS, round(1 / fit.problem.plant.dt))
    rows = []
    for trial in fit.told.trials:
        deviations = np.sqrt(np.einsum("tpp->tp", trial.spreads))
        rows.append(trial.innovations / deviations)
    joined = np.concatenate(rows)
    return whiteness(joined, min(lags, len(joined) - 1))


def prediction_errors(fit: PersonFit, ahead: tuple[int, ...]) -> Array:
    """Root-mean-square errors (k, p) of what the filter expects k numbers of samples `ahead`.

    From the expectation at a sample the plant runs on without noise, perturbations as recorded.
    """
    problem, plant = fit.problem, fit.problem.plant
    controller = controller_for(problem, fit.K, fit.S)
    law = prepare_loop(controller, directions(controller, 0))
    joint = joint_loop(plant, fit.observer, fit.recorder)
    farthest = max(ahead)
    quiet = np.zeros((farthest, len(joint.F))), np.zeros((farthest, plant.m))
    errors = []
    for trial, told in zip(problem.recordings, fit.told.trials, strict=True):
        starts = range(0, trial.samples - farthest, max(1, trial.samples // _STARTS))
        for t in starts:
            driven = np.array(trial.disturbance[t : t + farthest])
            z, _, _ = run_joint(law, joint, told.filtered[t], driven, quiet)
            expected = z[list(ahead)] @ joint.C.T
            errors.append(expected - trial.outputs[t + np.array(ahead)])
    if not errors:
        return np.full((len(ahead), len(plant.outputs)), np.nan)
    return np.asarray(np.sqrt(np.mean(np.square(errors), axis=0)))
