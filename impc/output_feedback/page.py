"""What a fit says of a person who senses with noise: sentences, tables, numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd

from impc.arrays import Array, Frozen
from impc.assess.printed_gain import entry_names
from impc.control.simulation import Status
from impc.inverse.regulator_span import kept_to
from impc.output_feedback.profile import FARTHEST
from impc.reporting.document import Block, Heading, Section
from impc.reporting.finding import Finding, table_of
from impc.reporting.rendering import number
from impc.reporting.shown_units import shown_unit

if TYPE_CHECKING:
    from impc.model.plant import Plant
    from impc.output_feedback.covariance import Confusion, PersonCovariance
    from impc.output_feedback.fit import OutputFeedbackFit

# A level whose interval of 95 % ends beyond a factor of ten is not identified.
_IDENTIFIED = np.log(10)
# Gain and noise that go together by more than this are hardly distinguished.
_CONFUSED = 0.9
# Criteria that differ by less do not decide (Burnham and Anderson 2002).
_UNDECIDED = 4.0
_WHITE = 0.01
# Of simulated subjects, by the sandwich (docs/noisy-people.md, "What the intervals hold").
_AT_LIMIT = (
    "A limit was met, where this likelihood is an approximation: there such intervals held 90 to "
    "95 % of the true values of simulated carts, and 91 % on the simulated seat, 80 % where the "
    "senses alone were noisy."
)


class _Level(NamedTuple):
    """A level with its interval of 95 %, in the unit in which it is shown."""

    name: str
    unit: str
    value: float
    low: float
    high: float

    @property
    def identified(self) -> bool:
        return bool(np.log(self.high / self.value) < _IDENTIFIED)


@dataclass(frozen=True)
class PersonModel:
    """One model."""

    name: str  # In words
    fit: OutputFeedbackFit | None  # None where it has no likelihood
    reason: str  # Why it has none

    @property
    def criterion(self) -> float:
        """Akaike's; infinite where there is no likelihood."""
        return np.inf if self.fit is None else self.fit.criterion

    def data(self) -> dict[str, Any]:
        """For result.json."""
        fit = self.fit
        numbers: tuple[float | None, ...] = (None,) * 4
        if fit is not None:
            numbers = fit.log_likelihood, fit.criterion, fit.count, fit.converged
        heads = "log_likelihood", "aic", "count", "converged"
        return {"name": self.name, **dict(zip(heads, numbers, strict=True)), "reason": self.reason}


@dataclass(frozen=True)
class PersonReport(Frozen):
    """What is said of a person who senses with noise."""

    models: tuple[PersonModel, ...]  # The first is the one that was asked for
    plant: Plant
    least: Array  # Gain of least squares (m, n)
    fit: OutputFeedbackFit | None  # That one; None where it has no likelihood
    # Of `fit`, by the sandwich; None where it has no likelihood
    covariance: PersonCovariance | None
    profiled: bool  # Whether intervals follow the likelihood
    # Intervals of 95 % of its levels (l, 2), in their units: by the sandwich, or where profiled by
    # profile for a level that is weakly identified
    levels: Array
    # The same of the entries of its gain (entries, 2); where profiled all by profile, NaN where an
    # entry is not individually identified
    entries: Array
    confusion: Confusion | None  # What of gain and noise is distinguished least
    whiteness: Array  # p-values that the innovations of each output are white (p,)
    ahead: tuple[int, ...]  # Samples ahead
    # Root-mean-square errors of predictions so far ahead (k, p), in the outputs' units
    errors: Array

    @property
    def at_limit(self) -> bool:
        """Whether a bound was met, so that the likelihood is an approximation."""
        return self.fit is not None and any(
            np.any(trial.status != Status.FREE) for trial in self.fit.identified.trials
        )

    @property
    def preferred(self) -> bool:
        """Whether the subject asked for was found, and no other model is to be preferred."""
        asked = self.models[0]
        if asked.fit is None or not asked.fit.converged:
            return False
        least = min(item.criterion for item in self.models)
        return asked.criterion < least + _UNDECIDED

    def sentences(self, sizes: Array) -> tuple[str, ...]:
        """What may be said of the subject; `sizes` (n,) are those of the states."""
        asked = self.models[0]
        if asked.fit is None:
            return (f"Nothing can be said of a person who senses with noise: {asked.reason}.",)
        lines = [_compared(self)]
        identified = [item for item in _levels(self) if item.identified]
        if identified:
            each = ", ".join(
                f"{item.name} {number(item.value)} {item.unit} ({number(item.low, 2)} to "
                f"{number(item.high, 2)})"
                for item in identified
            )
            lines.append(
                f"As one who {asked.name}: {each}, standard deviations of a sample (95 %)."
            )
        limited = [_AT_LIMIT] if self.at_limit else []
        return (*lines, *_gain_identified(self), *limited, *_apart(self, sizes), *_left(self))

    def section(self) -> Section:
        """Section of the page."""
        blocks: list[Block] = [_model_finding(self)]
        if self.fit is not None:
            blocks += [Heading("Noise"), _level_finding(self)]
            blocks += [Heading("Gain"), _gain_finding(self)]
            blocks += [Heading("What is left"), _left_finding(self)]
        return Section("A person who senses with noise", blocks, "Senses and noise")

    def data(self) -> dict[str, Any]:
        """For result.json."""
        fit = self.fit
        found: dict[str, Any] = {"models": [item.data() for item in self.models]}
        if fit is None or self.confusion is None:
            return found
        return found | {
            "K": fit.K,
            "at_limit": self.at_limit,
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
            "confusion": self.confusion.correlation,
            "whiteness": self.whiteness,
            "ahead": self.ahead,
            "errors_ahead": self.errors,
        }


def _compared(report: PersonReport) -> str:
    asked = report.models[0]
    others = sorted(report.models[1:], key=lambda item: item.criterion)
    if not others or others[0].fit is None:
        return (
            f"As one who {asked.name} the recordings can be identified; nothing stands beside it."
        )
    best = others[0]
    apart = best.criterion - asked.criterion
    if abs(apart) < _UNDECIDED:
        return (
            f"Whether the person {asked.name}, or {best.name}, the recordings do not identify "
            f"(Akaike's criterion {abs(apart):.1f} apart)."
        )
    if apart > 0:
        return (
            f"The recordings prefer one who {asked.name} to all others, by {apart:.1f} in Akaike's "
            f"criterion to the next, who {best.name}."
        )
    return (
        f"The recordings prefer one who {best.name} to the one that was asked for, who "
        f"{asked.name}, by {-apart:.1f} in Akaike's criterion."
    )


def _gain_identified(report: PersonReport) -> list[str]:
    """How much of the gain may be read as a number, and whether its search settled."""
    fit, entries = report.fit, np.array(report.entries)
    if fit is None or not len(entries):
        return []
    identified = int(np.count_nonzero((entries[:, 0] > 0) | (entries[:, 1] < 0)))
    said = (
        f"{identified} of the {len(entries)} entries of this person's gain are distinguishable "
        "from zero: their intervals (95 %) leave it out."
    )
    if identified == 0:
        said = (
            f"None of the {len(entries)} entries of this person's gain is distinguishable from "
            "zero (95 %): the values stand for gains that are several times as large or as "
            "small."
        )
    loose = "" if fit.converged else " The search did not settle: another may end beside it."
    return [f"{said}{loose}"]


def _apart(report: PersonReport, sizes: Array) -> list[str]:
    """Which step of gain and noise is distinguished least, where that is not identified."""
    fit, found = report.fit, report.confusion
    if fit is None or found is None or found.correlation < _CONFUSED:
        return []
    names = entry_names(fit.problem.plant)
    sizes = np.ravel(found.gain) / np.maximum(np.abs(np.ravel(fit.K)), 1e-300)
    entry = int(np.argmax(np.abs(np.ravel(found.gain)) * np.tile(sizes, report.plant.m)))
    level = int(np.argmax(np.abs(found.levels)))
    more = "more" if found.levels[level] * sizes[entry] > 0 else "less"
    return [
        f"Gain and noise are hardly distinguished here (correlation {found.correlation:.2f}): a "
        f"gain {names[entry]} that is {100 * abs(sizes[entry]):.0f} % larger goes with "
        f"{100 * abs(np.expm1(abs(found.levels[level]))):.0f} % {more} of the noise "
        f"{fit.space.names[level]}."
    ]


def _left(report: PersonReport) -> list[str]:
    outputs = report.plant.outputs
    coloured = [
        name
        for name, value in zip(outputs, report.whiteness, strict=True)
        if value < _WHITE  # NaN: nothing is left
    ]
    if not coloured:
        return []
    return [
        f"What this person leaves of {' and '.join(coloured)} is not white: the model misses "
        "something, and its intervals are those of a model that is not true."
    ]


def _model_finding(report: PersonReport) -> Finding:
    least = min(item.criterion for item in report.models)
    rows = [
        (item.name, None, np.nan, np.nan, None, item.reason)
        if item.fit is None
        else (
            item.name,
            item.fit.count,
            float(item.fit.log_likelihood),
            float(item.criterion - least),
            item.fit.converged,
            item.reason,
        )
        for item in report.models
    ]
    heads = ["the_person", "searched", "log_likelihood", "criterion", "settled", "reason"]
    caption = (
        "Models of sensing on the same recordings, the one that was asked for first. The criterion "
        "is Akaike's, over the least; searched: gain or cost weights, initial states, levels of "
        "noise."
    )
    return Finding("person_models", pd.DataFrame(rows, columns=heads), caption, digits=6)


def _level_finding(report: PersonReport) -> Finding:
    how = ", by profile where a level is weakly identified" if report.profiled else ""
    table = table_of(
        _levels(report),
        {
            "noise": lambda item: item.name,
            "level": lambda item: item.value if item.identified else np.nan,
            "low": lambda item: item.low if item.identified else 0.0,
            "high": lambda item: item.high if np.log(item.high / item.value) < FARTHEST else np.inf,
            "unit": lambda item: item.unit,
        },
    )
    caption = (
        f"Levels of noise: standard deviations of one sample, with intervals of 95 %{how}. Of a "
        "level whose interval reaches a factor of ten only the upper end is known."
    )
    return Finding("person_levels", table, caption, digits=3)


def _gain_finding(report: PersonReport) -> Finding:
    fit = report.fit
    assert fit is not None
    least, own = np.ravel(report.least), np.ravel(fit.K)
    how = (
        ", by profile. An entry that is not identified by itself has none."
        if report.profiled
        else ". profiles = true in [fit.observer] follows the likelihood instead, on a seat for "
        "ten minutes and more."
    )
    kept = kept_to(fit.problem)
    among = "" if kept is None else f", among those that weights over {kept.name} can have,"
    rows = [
        (name, float(own[k]), *map(float, report.entries[k]), float(least[k]))
        for k, name in enumerate(entry_names(fit.problem.plant))
    ]
    heads = ["entry", "maximum_likelihood", "low", "high", "least_squares"]
    caption = (
        f"The gain of this person{among} beside that of least squares, with intervals of 95 %{how}"
    )
    return Finding("person_gain", pd.DataFrame(rows, columns=heads), caption)


def _left_finding(report: PersonReport) -> Finding:
    rows = []
    for index, name in enumerate(report.plant.outputs):
        factor, unit = shown_unit(report.plant, name)
        errors = [float(factor * value) for value in report.errors[:, index]]
        rows.append((name, float(report.whiteness[index]), *errors, unit))
    heads = ["output", "p_white", *(f"error_{k}_ahead" for k in report.ahead), "unit"]
    caption = (
        "What the filter leaves: Ljung and Box's test of the innovations over one second, and "
        "root-mean-square errors of what it expects so many samples ahead."
    )
    return Finding("person_residuals", pd.DataFrame(rows, columns=heads), caption, digits=3)


def _levels(report: PersonReport) -> list[_Level]:
    fit = report.fit
    if fit is None:
        return []
    found = []
    for index, name in enumerate(fit.space.names):
        kind, signal = name.split(" ", 1)
        factor, unit = (100.0, "%") if kind == "share" else shown_unit(report.plant, signal)
        value = float(fit.levels[index])
        low, high = (float(end) for end in report.levels[index])
        found.append(_Level(name, unit, factor * value, factor * low, factor * high))
    return found
