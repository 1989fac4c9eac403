"""Verdict of a comparison of methods."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from impc.reporting.finding import Level
from impc.reporting.rendering import number
from impc.reporting.rules import Kind, Line, Rules, always
from impc.reporting.shown_units import signal_name
from impc.studies.fit.facts import limits, with_unit
from impc.studies.methods_figure import by_score, explained, largest_commands, unexplained
from impc.studies.methods_table import method_label

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.assess.assessments import MethodFit

# VAF (%) below which a model is poor; ratio of unexplained variances above which it is worse.
_HALF, _WORSE = 50.0, 1.1
# Largest ratio that is printed: exact recordings leave nothing unexplained.
_MUCH = 1000


class Facts:
    """Ranking and labels that sentences and numbers share."""

    def __init__(self, fits: Sequence[MethodFit]) -> None:
        plant, bounds = fits[0].estimate.problem.plant, fits[0].bounds
        word = signal_name(plant, plant.controls[0]).removeprefix("commanded ")
        self.fits = fits
        self.fitted = sum(one.estimate.K is not None for one in fits)
        # Methods that reach the end of every trial, best first
        self.ranked = [one for one in by_score(fits) if not np.any(np.isnan(explained(one)))]
        # For example "6 N m" (empty without limits) and "torque limit"
        self.limit = " and ".join(limits(plant, np.array(bounds.u_min), np.array(bounds.u_max)))
        self.word = f"{word} limit" if plant.m == 1 else "limit"
        self.free = [one for one in self.ranked if not _knows(one)]
        self.kept = [one for one in self.ranked if one.keeps_bounds]
        self.held = bool(self.ranked) and all(len(one.held_out) for one in self.ranked)
        self.where = "left-out trials" if self.held else "the fitted trials"

    @property
    def best(self) -> MethodFit:
        """Best method that reaches the end of every trial."""
        return self.ranked[0]

    @cached_property
    def other(self) -> MethodFit | None:
        """Best method of the other kind, with or without limit; without limits the second best."""
        others = self.ranked[1:]
        if self.limit:
            others = [one for one in others if _knows(one) != _knows(self.best)]
        return next(iter(others), None)

    @property
    def against(self) -> str:
        """What `other` is."""
        if not self.limit:
            return "next model"
        return f"best model {'without a' if _knows(self.best) else 'with the'} limit"

    @property
    def unbounded(self) -> MethodFit:
        """Best method that ignores the limit, or the best of all."""
        return self.free[0] if self.limit and self.free else self.other or self.best

    @property
    def alone(self) -> bool:
        """Whether it is the only method: a page made from Python."""
        return len(self.fits) == 1

    @property
    def times(self) -> float:
        """Unexplained variance of the other method over that of the best."""
        return 1.0 if self.other is None else unexplained(self.other) / unexplained(self.best)

    @property
    def factor(self) -> str:
        """`times` in words."""
        return number(self.times, 2) if self.times < _MUCH else f"over {_MUCH:g}"

    @property
    def poor(self) -> bool:
        """Whether the best method explains less than half of a signal."""
        return float(np.min(explained(self.best))) < _HALF

    @property
    def beyond(self) -> bool:
        """Whether no method within the limit comes close to the best, which needs more."""
        if not self.limit or self.other is None or self.best.keeps_bounds:
            return False
        return not self.kept or unexplained(self.kept[0]) > _WORSE * unexplained(self.best)

    @property
    def matters(self) -> bool:
        """Whether every method that ignores the limit needs more."""
        one_limit = self.limit and self.other is not None
        return bool(one_limit) and not any(one.keeps_bounds for one in self.free)

    @property
    def each(self) -> str:
        """Variance that the best method explains of each signal."""
        plant = self.best.estimate.problem.plant
        parts = zip(plant.outputs, explained(self.best), strict=True)
        return ", ".join(f"{value:.2f} % ({signal_name(plant, name)})" for name, value in parts)

    @property
    def sentence(self) -> str:
        """What the best and the other method explain and need."""
        said = f"“{name_of(self.best)}” explains {share(self.best)} of the variance in {self.where}"
        if self.other is not None:
            needs = needed(self.other if _knows(self.best) else self.best)
            whose = f" with up to {needs}" if _knows(self.best) else f"; the first needs {needs}"
            said += f", the {self.against} {share(self.other)}{whose if self.limit else ''}"
        return f"{said}."


def name_of(fit: MethodFit) -> str:
    """Label of a method."""
    return method_label(fit.name)


def share(fit: MethodFit) -> str:
    """Explained variance in words."""
    return f"{100 - unexplained(fit):.2f} %"


def needed(fit: MethodFit) -> str:
    """Largest command in words: "12.7 N m", or "210 % of a limit" for several commands."""
    value, _, label = largest_commands(fit)
    unit = label[label.rindex("(") + 1 : -1].replace("its limit", "a limit")
    return with_unit(number(value), unit)


def _knows(fit: MethodFit) -> bool:
    """Whether the method takes the limits of the command into account."""
    return bool(np.any(np.isfinite(fit.estimate.problem.bounds.u_max)))


_EXPLAINS = Kind[Facts](
    Level.GREEN, always, "“{best}” explains {share} of the variance.", "{sentence}"
)
RULES = Rules[Facts](
    {
        "best": lambda it: name_of(it.best),
        "share": lambda it: share(it.best),
        "needs": lambda it: needed(it.unbounded),
        "times": lambda it: it.factor,
        "limit": lambda it: it.limit,
        "word": lambda it: it.word,
        "where": lambda it: it.where,
        "each": lambda it: it.each,
        "status": lambda it: it.best.estimate.status.sentence,
        "next": lambda it: "Call impc.report with settings, or use impc fit."
        if it.best.name == "inverse_mpc" else "Use impc compare.",
        "sentence": lambda it: it.sentence,
    },
    kinds=(
        Kind(
            Level.RED, lambda it: not it.ranked,
            "No model follows these recordings to their end.",
            "The simulations of every model stop before the end of a trial.",
        ),
        replace(_EXPLAINS, level=Level.RED, when=lambda it: it.ranked and it.poor,
                headline="No model explains half of every recorded signal."),
        replace(
            _EXPLAINS, level=Level.AMBER, when=lambda it: it.ranked and it.beyond,
            headline="The model that explains most needs more than {limit}.",
            title="The {word} does not agree with the recordings",
            found="“{best}” explains most and needs up to {needs}; the limit was given as {limit}.",
            means="The limit may be too low, or the person does not move like a controller with "
            "this limit.",
            todo=("Run impc fit with `unknown_limit = true`, which estimates the limit; compare "
                  "again.", "Check body mass, height and the units of the recordings."),
        ),
        replace(
            _EXPLAINS, level=Level.AMBER, when=lambda it: it.ranked and it.alone,
            sentence="{status}", title="Intervals and left-out trials are missing",
            found="This page shows the result of one method on the trials that it was fitted to.",
            means="How far the gain and the cost weights may be from the truth is unknown.",
            todo=("{next}",),
        ),
        replace(
            _EXPLAINS, when=lambda it: it.ranked and it.matters and it.times > _WORSE,
            headline="Without the {word} of {limit}, {times} times as much variance is left "
            "unexplained, and {needs} would be needed.",
        ),
        replace(
            _EXPLAINS, when=lambda it: it.ranked and it.matters,
            headline="Models without the {word} explain as much, but would need {needs} instead of "
            "{limit}.",
        ),
        replace(
            _EXPLAINS, when=lambda it: it.limit and it.free and it.other is not None
            and all(one.keeps_bounds for one in it.free),
            headline="No model needs more than {limit}: the {word} does not matter here.",
        ),
        _EXPLAINS,
    ),
    may=(
        Line(lambda it: it.ranked and not it.poor and it.other is None,
             "How much of the movement is explained.", "{each} of {where}."),
        Line(lambda it: it.ranked and not it.poor and it.other is not None,
             "“{best}” explains most.", "{each} of {where}."),
        Line(lambda it: it.ranked and not it.poor and not it.beyond and it.matters
             and it.times > _WORSE,
             "The {word} matters.", "Without it {times} times as much variance is left "
             "unexplained, and up to {needs} are needed."),
    ),
    may_not=(
        Line(lambda it: it.ranked and it.poor, "Which model is best.",
             "All explain less than half of a recorded signal."),
        Line(lambda it: it.ranked and it.beyond, "That the person keeps to the {word}.",
             "The model that explains most needs more."),
        Line(lambda it: it.ranked and not it.poor, "Gains and cost weights.",
             "They have no intervals here; impc fit computes them."),
        Line(lambda it: it.ranked and not it.poor,
             "That the person computes commands in this way.",
             "Another rule that gives the same command would look the same."),
        Line(lambda it: it.ranked and not it.poor and not it.held, "How well a model predicts.",
             "No trial was left out."),
    ),
)  # fmt: skip
