"""Competing sensorimotor models of the same recordings: fits, comparison by AIC, report section.

A fit is stored as the start of its coordinates and its final unknowns: evaluating the likelihood
once reproduces it to the last digit.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from impc.arrays import Array, Frozen, frozen
from impc.checking import replace
from impc.control.aims import aim_of, window
from impc.control.closed_loop import prepare_loop
from impc.control.constraint_rows import directions
from impc.errors import ImpcError
from impc.inverse.estimates import Estimate
from impc.inverse.problem import Problem, controller_for, drive_of
from impc.inverse.regulator_span import kept_to
from impc.model.bounds import bound_rows
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.output_feedback import intervals
from impc.output_feedback.doubts import at_limit
from impc.output_feedback.fit import End, OutputFeedbackFit, fit_output_feedback, person_at
from impc.output_feedback.intervals import PersonCovariance
from impc.output_feedback.observer import Observer
from impc.output_feedback.simulation import joint_loop, run_joint
from impc.output_feedback.unknowns import Request, space_at
from impc.reporting.document import Block, Fold, Section
from impc.reporting.finding import Finding
from impc.reporting.shown_units import shown_unit, signal_name

# Horizons in s at which predictions are evaluated; largest number of starts in a trial.
_AHEAD, _STARTS = (0.0, 0.1, 0.5), 100
# Evaluation budgets: requested model, comparison models; the report says if a fit hit its budget.
_ASKED, _BESIDE = 250, 60
# Initial signal-dependent motor noise as a share of the command (typical of isometric force).
_SHARE = 0.1
# A noise SD counts as identified if its 95 % interval ends within a factor of ten.
_IDENTIFIED = np.log(10)
# AIC differences below this do not decide (Burnham and Anderson 2002).
_UNDECIDED = 4.0
_KINDS = {
    "motor": "noise in", "share": "noise in proportion to", "process": "unmodelled change of",
    "sensory": "sensory noise of", "walk": "assumed step of", "recorder": "recording noise of",
}  # fmt: skip
_PROFILED = ", by profile likelihood"
_ENDS = {"low": "95 % CI low", "high": "95 % CI high", "sd": "SD"}


@dataclass(frozen=True)
class PersonModel:
    """One competing model, fitted or not."""

    name: str  # in words
    fit: OutputFeedbackFit | None  # None if its likelihood is undefined
    reason: str  # why there is no fit

    @property
    def criterion(self) -> float:
        """AIC; infinite without a fit."""
        return np.inf if self.fit is None else self.fit.criterion

    def data(self) -> dict[str, Any]:
        """Entry of result.json."""
        heads = {"log_likelihood": "log_likelihood", "aic": "criterion", "count": "count"}
        numbers = {head: getattr(self.fit, name, None)
                   for head, name in {**heads, "converged": "converged"}.items()}  # fmt: skip
        return {"name": self.name, **numbers, "reason": self.reason}


@dataclass(frozen=True)
class PersonReport(Frozen):
    """Content of the report section on noise in senses and muscles."""

    models: tuple[PersonModel, ...]  # the requested one first
    plant: Plant
    least: Array  # (m, n), gain of least squares
    fit: OutputFeedbackFit | None  # of the requested model, if its likelihood is defined
    covariance: PersonCovariance | None  # sandwich covariance of `fit`
    profiled: bool  # whether intervals are by profile likelihood
    # 95 % intervals of the noise SDs (l, 2), in their units: sandwich; if profiled, by profile for
    # weakly identified ones
    levels: Array
    # 95 % intervals of the gain entries (entries, 2); if profiled, all by profile, and NaN where an
    # entry is not individually identified
    entries: Array
    ahead: tuple[int, ...]  # prediction horizons in samples
    errors: Array  # (k, p), root-mean-square prediction errors, in the outputs' units

    @property
    def preferred(self) -> bool:
        """Whether the requested model converged and no other one has a clearly lower AIC."""
        asked = self.models[0]
        if asked.fit is None or not asked.fit.converged:
            return False
        least = min(item.criterion for item in self.models)
        return asked.criterion < least + _UNDECIDED

    def sentences(self) -> list[str]:
        """Findings as sentences."""
        asked, fit, entries = self.models[0], self.fit, np.array(self.entries)
        if fit is None:
            return [f"No model with noise in senses or muscles could be fitted: {asked.reason}."]
        found = [self._compared()]
        if len(entries):
            count = int(np.count_nonzero((entries[:, 0] > 0) | (entries[:, 1] < 0)))
            found.append(f"The 95 % CI of {count} of {len(entries)} gains excludes zero.")
        return [*found, *fit.doubts]

    def _compared(self) -> str:
        asked, *others = self.models
        best = min(others, key=lambda item: item.criterion, default=asked)
        if best is asked or best.fit is None:
            return "No other model of sensing could be fitted for comparison."
        apart = best.criterion - asked.criterion
        if abs(apart) < _UNDECIDED:
            return (f"The recordings do not decide between the models “{asked.name}” and "
                    f"“{best.name}” (AIC differs by {abs(apart):.1f}).")  # fmt: skip
        first, second = (asked, best) if apart > 0 else (best, asked)
        return (f"The model “{first.name}” explains the recordings better than the model "
                f"“{second.name}” (AIC lower by {abs(apart):.1f}).")  # fmt: skip

    def section(self) -> Section:
        """Section of the report."""
        blocks: list[Block] = [*self.sentences(), _model_finding(self)]
        if self.fit is not None:
            fold = Fold(
                "Noise and models, in numbers", [_level_finding(self, self.fit), blocks.pop()]
            )
            blocks += [_gain_finding(self, self.fit), fold]
        return Section("Noise in the loop", blocks)

    def data(self) -> dict[str, Any]:
        """Entry of result.json."""
        fit = self.fit
        found: dict[str, Any] = {"models": [item.data() for item in self.models]}
        if fit is None:
            return found
        return found | {
            "K": fit.K,
            "at_limit": at_limit(fit),
            "profiled": self.profiled,
            "K_intervals": self.entries.reshape(*fit.K.shape, 2),
            "sensed": fit.observer.sensed,
            "known": fit.observer.walk is None,
            "levels": {
                name: {"value": value, "low": low, "high": high}
                for name, value, (low, high) in zip(
                    fit.space.names, fit.levels, self.levels, strict=True
                )
            },
            "confusion": intervals.confusion(fit),
            "whiteness": fit.whiteness,
            "ahead": self.ahead,
            "errors_ahead": self.errors,
        }


#: (name, compute, decode, encode) -> the model, from the store or computed.
Remember = Callable[
    [str, Callable[[], PersonModel], Callable[[Any], PersonModel], Callable[[PersonModel], Any]],
    PersonModel,
]


def person_report(
    found: Estimate,
    asked: Observer,
    walk: Array,
    *,
    profiled: bool = False,
    done: Callable[[str], None] = lambda _: None,
    remember: Remember = lambda _name, compute, _decode, _encode: compute(),
) -> PersonReport:
    """Fit the requested and the comparison models, starting from a least squares fit.

    `walk` (d,); `remember` (name, compute, decode, encode).
    """
    models: list[PersonModel] = []
    for name, posed, person in persons(found.problem, asked, walk):
        first, budget = replace(found, problem=posed), _BESIDE if models else _ASKED
        fit_one = functools.partial(_model, name, first, person, budget)
        decode = functools.partial(decode_model, name, posed, person)
        models.append(remember(name, fit_one, decode, encode_model))
        done(name)
    fit, plant, none = models[0].fit, found.problem.plant, frozen(np.zeros((0, 2)))
    report = PersonReport(
        tuple(models), plant, found.gain, fit, None, profiled, none, none, (), frozen([[]]),
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
            ahead=ahead,
            errors=frozen(prediction_errors(fit, ahead)),
        )
    done("intervals")
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
    fit = person_at(End(space, place, unseen, given["evaluations"], given["converged"]))
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


def _model_finding(report: PersonReport) -> Finding:
    least = min(item.criterion for item in report.models)
    rows = [
        (item.name, item.fit.count, float(item.fit.log_likelihood), float(item.criterion - least),
         item.fit.converged, item.reason)
        if item.fit is not None else (item.name, None, np.nan, np.nan, None, item.reason)
        for item in report.models
    ]  # fmt: skip
    heads = ["the_person", "searched", "log_likelihood", "criterion", "settled", "reason"]
    labels = {"searched": "Numbers fitted", "criterion": "AIC over the lowest",
              "settled": "Converged", "reason": "Why not"}  # fmt: skip
    caption = "Models of sensing on the same recordings, the requested one first."
    table = pd.DataFrame(rows, columns=heads)
    hidden = () if any(item.reason for item in report.models) else ("reason",)
    return Finding("person_models", table, caption, digits=6, labels=labels, hidden=hidden)


def _level_finding(report: PersonReport, fit: OutputFeedbackFit) -> Finding:
    """Table of noise SDs; for one that is not identified only the upper end is shown."""
    rows, plant = [], report.plant
    names = zip(fit.space.names, fit.levels, report.levels, strict=True)
    for (kind, signal), value, ends in ((one[0].split(" ", 1), *one[1:]) for one in names):
        factor, unit = (100.0, "%") if kind == "share" else shown_unit(plant, signal)
        reach = np.log(ends[1] / value)
        sd, low = (value, ends[0]) if reach < _IDENTIFIED else (np.nan, 0.0)
        high = ends[1] if reach < intervals.FARTHEST else np.inf
        words = f"{_KINDS[kind]} {signal_name(plant, signal)}"
        rows.append((words, *(factor * float(one) for one in (sd, low, high)), unit))
    table = pd.DataFrame(rows, columns=["noise", "sd", "low", "high", "unit"])
    caption = f"Noise: SD of one sample, with 95 % intervals{_PROFILED * report.profiled}."
    return Finding("person_levels", table, caption, digits=3, labels=_ENDS)


def _gain_finding(report: PersonReport, fit: OutputFeedbackFit) -> Finding:
    plant, rows = report.plant, []
    numbers = np.column_stack([np.ravel(fit.K), report.entries, np.ravel(report.least)])
    for k, (control, state) in enumerate(itertools.product(plant.controls, plant.states)):
        (above, unit), (below, per) = shown_unit(plant, control), shown_unit(plant, state)
        by = f", {signal_name(plant, control)}" * (plant.m > 1)
        shown = map(float, above / below * numbers[k])
        rows.append((f"{signal_name(plant, state)}{by}", *shown, f"{unit} per {per}"))
    heads = ["gain", "maximum_likelihood", "low", "high", "without_noise_in_the_loop", "unit"]
    kept = kept_to(fit.problem)
    among = "" if kept is None else f", restricted to gains of weights over {kept.name}"
    caption = f"Gain of this person{among}, with 95 % intervals{_PROFILED * report.profiled}."
    labels = {**_ENDS, "maximum_likelihood": "Value"}
    table = pd.DataFrame(rows, columns=heads)
    return Finding("person_gain", table, caption, labels=labels, digits=3)
