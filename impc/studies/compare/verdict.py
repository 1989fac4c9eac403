"""Verdict of a comparison of methods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from impc.assess.assessments import MethodFit
from impc.levels import Level
from impc.reporting.rendering import number
from impc.reporting.rules import Kind, Line, Rules, always
from impc.reporting.shown_units import signal_name
from impc.studies.fit.facts import limits, with_unit
from impc.studies.methods_figure import by_score, explained, largest_commands, unexplained
from impc.studies.methods_table import method_label

# VAF (%) below which a model is poor; ratio of unexplained variances above which it is worse.
_HALF, _WORSE = 50.0, 1.1
# Largest ratio that is printed: exact recordings leave nothing unexplained.
_MUCH = 1000


class Facts:
    """Ranking, numbers and phrases that verdict, page and text share."""

    def __init__(self, fits: Sequence[MethodFit]) -> None:
        plant, bounds = fits[0].estimate.problem.plant, fits[0].bounds
        word = signal_name(plant, plant.controls[0]).removeprefix("commanded ")
        self.fits, self.fitted = fits, sum(one.estimate.K is not None for one in fits)
        # Methods that reach the end of every trial, best first
        self.ranked = [one for one in by_score(fits) if not np.any(np.isnan(explained(one)))]
        # For example "6 N m" (empty without limits) and "torque limit"
        self.limit = " and ".join(limits(plant, np.array(bounds.u_min), np.array(bounds.u_max)))
        self.word = f"{word} limit" if plant.m == 1 else "limit"
        self.held = bool(self.ranked) and all(len(one.held_out) for one in self.ranked)
        self.where = "left-out trials" if self.held else "the fitted trials"
        self.others: list[MethodFit] = []  # Of the other kind, with or without limit
        self.free: list[MethodFit] = []  # Methods that ignore the limit
        self.poor = self.beyond = self.matters = False
        if not self.ranked:
            return
        self.best, self.others = self.ranked[0], self.ranked[1:]
        self.poor, aware = float(np.min(explained(self.best))) < _HALF, _knows(self.best)
        self.against = "next model"
        if self.limit:
            self.against = f"best model {'without a' if aware else 'with the'} limit"
            self.free = _least_first([one for one in self.ranked if not _knows(one)])
            self.others = self.free if aware else [one for one in self.others if _knows(one)]
        # The method that ignores the limit, or the second, or the best
        self.unbounded = (*self.free, *self.others, self.best)[0]
        # Unexplained variance of the best of the others over that of the best
        self.times = unexplained((*self.others, self.best)[0]) / unexplained(self.best)
        self.factor = number(self.times, 2) if self.times < _MUCH else f"over {_MUCH:g}"
        kept = [one for one in self.ranked if one.keeps_bounds]
        if self.limit and self.others:
            self.matters = not any(one.keeps_bounds for one in self.free)
            self.beyond = not self.best.keeps_bounds and (
                not kept or unexplained(kept[0]) > _WORSE * unexplained(self.best)
            )
        self.sentence = f"“{name_of(self.best)}” explains {share(self.best)} of the variance in "
        self.sentence += self.where
        if self.others:
            self.sentence += f", the {self.against} {share(self.others[0])}"
        if self.limit and self.others:
            needs = f"; the first needs up to {needed(self.best)}"
            self.sentence += f" with up to {needed(self.others[0])}" if aware else needs


def _least_first(fits: list[MethodFit]) -> list[MethodFit]:
    """The methods; of those as good as the best, first the one that needs the least command."""
    near = [one for one in fits if unexplained(one) <= _WORSE * unexplained(fits[0])]
    first = min(near, key=lambda one: largest_commands(one)[0], default=None)
    return sorted(fits, key=lambda one: one is not first)


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
    Level.GREEN, always, "“{best}” explains {share} of the variance.", "{sentence}."
)
RULES = Rules[Facts](
    {
        "best": lambda it: name_of(it.best),
        "share": lambda it: share(it.best),
        "needs": lambda it: needed(it.unbounded),
        "each": lambda it: ", ".join(
            f"{value:.2f} % ({signal_name(it.best.estimate.problem.plant, name)})"
            for name, value in zip(it.best.estimate.problem.plant.outputs, explained(it.best),
                                   strict=True)
        ),
        "status": lambda it: it.best.estimate.status.sentence,
        "next": lambda it: "Call impc.report with settings, or use impc fit."
        if it.best.name == "inverse_mpc" else "Use impc compare.",
    },
    kinds=(
        Kind(
            Level.RED, lambda it: not it.ranked,
            "No model follows these recordings to their end.",
            "The simulations of every model stop before the end of a trial.",
        ),
        replace(_EXPLAINS, level=Level.RED, when=lambda it: it.poor,
                headline="No model explains half of every recorded signal."),
        replace(
            _EXPLAINS, level=Level.AMBER, when=lambda it: it.beyond,
            headline="The model that explains most needs more than {limit}.",
            title="The {word} does not agree with the recordings",
            found="“{best}” explains most and needs up to {needs}; the limit was given as {limit}.",
            means="The limit may be too low, or the person does not move like a controller with "
            "this limit.",
            todo=("Run impc fit with `unknown_limit = true`, which estimates the limit; compare "
                  "again.", "Check body mass, height and the units of the recordings."),
        ),
        replace(
            _EXPLAINS, level=Level.AMBER, when=lambda it: it.ranked and len(it.fits) == 1,
            sentence="{status}", title="Intervals and left-out trials are missing",
            found="This page shows the result of one method on the trials that it was fitted to.",
            means="How far the gain and the cost weights may be from the truth is unknown.",
            todo=("{next}",),
        ),
        replace(
            _EXPLAINS, when=lambda it: it.matters and it.times > _WORSE,
            headline="Without the {word} of {limit}, {factor} times as much variance is left "
            "unexplained, and {needs} would be needed.",
        ),
        replace(
            _EXPLAINS, when=lambda it: it.matters,
            headline="Models without the {word} explain as much, but would need {needs} instead of "
            "{limit}.",
        ),
        replace(
            _EXPLAINS, when=lambda it: it.limit and it.free and it.others
            and all(one.keeps_bounds for one in it.free),
            headline="No model needs more than {limit}: the {word} does not matter here.",
        ),
        _EXPLAINS,
    ),
    may=(
        Line(lambda it: it.ranked and not it.poor and not it.others,
             "How much of the movement is explained.", "{each} of {where}."),
        Line(lambda it: it.ranked and not it.poor and it.others,
             "“{best}” explains most.", "{each} of {where}."),
        Line(lambda it: it.matters and not it.poor and not it.beyond
             and it.times > _WORSE,
             "The {word} matters.", "Without it {factor} times as much variance is left "
             "unexplained, and up to {needs} are needed."),
    ),
    may_not=(
        Line(lambda it: it.poor, "Which model is best.",
             "All explain less than half of a recorded signal."),
        Line(lambda it: it.beyond, "That the person keeps to the {word}.",
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
