"""What a cohort says first: which groups or visits differ, by how much, and how far to trust it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.model.plant import UNKNOWN
from impc.reporting.finding import Level
from impc.reporting.rendering import number, probability
from impc.reporting.verdict import Alert, Claim, Verdict
from impc.studies.cohort.comparison import compare_cohort, measures_of, only_identified
from impc.studies.fit.facts import between

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pandas as pd

    from impc.studies.cohort.comparison import Comparison

#: What columns of logarithms begin with; their comparisons are of ratios.
LOGARITHM = "log_cost_weight."
_LEADING = ("K.", LOGARITHM)
# Questions about means, those that are most asked first.
_QUESTIONS = ("group", "mixed", "change", "visit")
# Share of fits with a warning, or of units without a fit, from which a page is amber.
_MANY = 0.1
# Share of people whose gain is identified, below which it is too.
_FEW = 0.7


@dataclass(frozen=True)
class Cohort:
    """What page, figures and terminal say, made from the table of units."""

    units: pd.DataFrame  # A row each, as in units.csv
    described: Mapping[str, Any]  # The content of any fit: signals and their units
    failed: Mapping[str, str]  # Why a unit has no fit

    def _of(self, *levels: Level) -> pd.DataFrame:
        """Units whose fit has one of the levels."""
        wanted = [level.value for level in levels]
        return self.units[self.units["level"].isin(wanted)] if len(self.units) else self.units

    @cached_property
    def usable(self) -> pd.DataFrame:
        """Units whose fit says something, with NaN for gains that they do not identify."""
        return only_identified(self._of(Level.GREEN, Level.AMBER))

    @cached_property
    def warned(self) -> int:
        """How many fits have a warning."""
        return len(self._of(Level.AMBER, Level.RED))

    @cached_property
    def compared(self) -> tuple[Comparison, ...]:
        """Every comparison."""
        return compare_cohort(self._of(Level.GREEN, Level.AMBER))

    @cached_property
    def tested(self) -> list[Comparison]:
        """Those with a p, the first one first."""
        return sorted((item for item in self.compared if np.isfinite(item.p)), key=_rank)

    @property
    def lead(self) -> Comparison | None:
        """The comparison that the page begins with: of gains, or of cost weights in a structure."""
        return next((one for one in self.tested if one.measure.startswith(_LEADING)), None)

    @property
    def measure(self) -> str:
        """The measure of the first figure; empty without any unit."""
        chosen = measures_of(self.units) if len(self.units) else ()
        return self.lead.measure if self.lead else next(iter(chosen), "")

    @cached_property
    def ends(self) -> pd.DataFrame:
        """That of every unit with its interval: NaN where not identified, but for "shown"."""
        kind, _, rest = self.measure.partition(".")
        value = self.usable[self.measure].reindex(self.units.index).astype(float)
        low, high = (self.units.get(f"{kind}_{end}.{rest}", value) for end in ("low", "high"))
        if kind == "K":
            reach = 1.96 * self.units.get(f"K_deviation.{rest}", np.nan)
            low, high = value - reach, value + reach
        shown = self.units[self.measure].astype(float)
        found = value.to_frame("value").assign(low=low, high=high, shown=shown)
        return found.map(np.exp) if self.measure.startswith(LOGARITHM) else found

    def word(self, signal: str) -> str:
        """A signal in words."""
        return str(self.described.get("words", {}).get(signal, signal.replace("_", " ")))

    def name(self, measure: str) -> str:
        """A column of the table of units in words."""
        kind, _, rest = measure.partition(".")
        if kind == "K":
            control, _, state = rest.partition(".")
            several = len(self.described.get("controls", ())) > 1
            return f"gain on {self.word(state)}" + f" ({self.word(control)})" * several
        words = {"vaf": "variance accounted for, {}", "centre_weight": "central cost weight of {}",
                 "log_cost_weight": "cost weight of {}"}  # fmt: skip
        return words.get(kind, kind.replace("_", " ")).format(self.word(rest))

    def unit(self, measure: str) -> str:
        """The unit of a measure; of logarithms "-"."""
        known = {"vaf": "%", "log_cost_weight": "-"} | self.described.get("units", {})
        return str(known.get(measure, known.get(measure.partition(".")[0], UNKNOWN)))

    def amount(self, item: Comparison) -> tuple[str, str]:
        """A difference with its unit and "less" or "more", and its interval in the same words."""
        ends = np.array([item.estimate, item.low, item.high])
        if item.measure.startswith(LOGARITHM):
            value, low, high = np.exp(ends)
            return f"{number(float(value))} times", f"{between(low, high)} times"
        # A gain below zero is larger the lower it is.
        below = item.measure.startswith("K.") and self.usable[item.measure].median() < 0
        word = "less" if (item.estimate < 0) != below else "more"
        low, high = sorted(np.sign(item.estimate or 1.0) * ends[1:])
        unit = self.unit(item.measure)
        said = f"{'percentage points' if unit == '%' else unit} {word}"
        return f"{number(abs(item.estimate))} {said}", f"{between(low, high)} {said}"

    def sentence(self, item: Comparison) -> str:
        """A difference in one sentence."""
        (amount, _), name = self.amount(item), self.name(item.measure)
        visit = item.question == "visit"
        first, second = (
            f"at visit {one}" if visit
            else f"in the {one} group" if len(one) > 1 and one.isalpha() else f"in group {one}"
            for one in (item.first, item.second)
        )  # fmt: skip
        if item.question == "change":
            said = f"from visit to visit, the {name} rises by {amount} {second} than {first}"
        elif item.measure.startswith("K."):
            _, control, state = item.measure.split(".", 2)
            who = f"{second} people apply" if visit else f"{second[3:]} applies"
            than = first if visit else first[3:].removesuffix(" group")
            effort = self.word(control).removeprefix("commanded ")
            said = f"{who} {amount} {effort} per {self.word(state)} than {than}"
        else:
            than = "as high {} as" if item.measure.startswith(LOGARITHM) else "{} than"
            said = f"the {name} is {amount} {than.format(second)} {first}"
        where = f" ({item.condition})" if self.units["condition"].nunique() > 1 else ""
        return f"{said[:1].upper()}{said[1:]}{where}."

    def numbers(self, item: Comparison) -> str:
        """Interval, number of people, p and size of the effect."""
        effect = "Cohen's d" if item.question == "visit" else "Hedges' g"
        size = f", {effect} = {number(item.effect)}" if np.isfinite(item.effect) else ""
        ends = self.amount(item)[1]
        return f"95 % CI {ends}, n = {item.n} people, Holm {probability(item.p_holm)}{size}"

    @cached_property
    def identified(self) -> tuple[str, int, int]:
        """The first gain, and of how many people it is identified, of all with a fit."""
        gains = [name for name in (self.measure, *measures_of(self.units)) if name[:2] == "K."]
        if not gains:
            return "", 0, 0
        known = self.usable.loc[self.usable[gains[0]].notna(), "subject"]
        return self.name(gains[0]), known.nunique(), self.units["subject"].nunique()

    def without_warned(self) -> str:
        """The first difference again, of fits without a warning; empty where there is none."""
        for item in compare_cohort(self._of(Level.GREEN)) if self.lead else ():
            if _asked(item) == _asked(self.lead) and np.isfinite(item.p):
                value, ends = self.amount(item)
                return f" Without fits with a warning it is {value} (95 % CI {ends}, n = {item.n})."
        return " Without fits with a warning, too few people are left." if self.lead else ""


def _asked(item: Comparison | None) -> tuple[str, ...]:
    if item is None:
        return ()
    return item.question, item.measure, item.condition, item.first, item.second


def _rank(item: Comparison) -> tuple[bool, int, bool, float]:
    last = not item.measure.startswith(_LEADING)
    return not item.p_holm <= 0.05, _QUESTIONS.index(item.question), last, item.p


def cohort_verdict(cohort: Cohort) -> Verdict:
    """The verdict of a cohort."""
    fits, lead = len(cohort.units), cohort.lead
    if not len(cohort.usable):
        said = f"{fits} of {fits + len(cohort.failed)} fits were made, and none may be reported."
        alerts = _alerts(cohort, Level.RED)
        return Verdict(Level.RED, "No fit of this study can be used.", said, alerts)
    alerts = _alerts(cohort, Level.AMBER)
    level = Level.AMBER if alerts else Level.GREEN
    if lead is None:
        headline = f"Fitted people: {cohort.units['subject'].nunique()}."
        said = "There are too few people in two groups, or at two visits, for a comparison."
        if any(item.measure.startswith("K.") for item in cohort.compared):
            headline = "The gains of too few people are identified for a comparison."
            said = "At least three in each group, or with both visits, are needed."
        return Verdict(level, headline, said, alerts)
    numbers = cohort.numbers(lead)
    if lead.p_holm > 0.05:
        what = "visits" if lead.question == "visit" else "groups"
        kind = "cost weight" if lead.measure.startswith(LOGARITHM) else "gain"
        said = f"The clearest difference is {cohort.amount(lead)[0]} in {cohort.name(lead.measure)}"
        said += f" ({numbers}). This does not show that they are alike."
        may = [Claim("That no difference was found, with the interval above.")]
        headline = f"No {kind} differs between the {what}."
        return Verdict(level, headline, said, alerts, may, _may_not(cohort))
    differing = [one for one in cohort.tested if one.p_holm <= 0.05]
    may = [Claim(cohort.sentence(item), f"{cohort.numbers(item)}.") for item in differing
           if not item.measure.startswith("centre")][:6]  # those are a convention # fmt: skip
    return Verdict(level, cohort.sentence(lead), f"{numbers}.", alerts, may, _may_not(cohort))


def _alerts(cohort: Cohort, level: Level) -> list[Alert]:
    warned, fits, failed = cohort.warned, len(cohort.units), len(cohort.failed)
    found = []
    if warned > _MANY * fits:
        heads = cohort.units.loc[cohort.units["level"] != Level.GREEN.value, "headline"]
        each = " ".join(f"{head.rstrip('.')} ({count})."
                        for head, count in Counter(heads).most_common(3))  # fmt: skip
        found.append(Alert(
            level, f"{warned} of {fits} fits have a warning", f"{each}{cohort.without_warned()}",
            "The gains of these people may be shifted by more than their intervals show; a shift "
            "that differs between groups looks like a difference between people.",
            ("Open the pages of these people and follow what impc fit says of one of them.",
             "Change the settings for everybody alike, and run the study again.",
             "Report the difference with and without these people."),
        ))  # fmt: skip
    name, known, of = cohort.identified
    if known < _FEW * of:
        found.append(Alert(
            level, f"The {name} is identified in {known} of {of} people only",
            "In the others its standard error is more than twice the usual size of this gain.",
            "What is left need not be like all people of the study, and small groups show large "
            "differences only.",
            ("Record more or longer trials, or a stronger perturbation; impc plan says how many.",
             "Ask for [fit.structure]: a few cost weights need less data than ten gains."),
        ))  # fmt: skip
    if failed > _MANY * (fits + failed):
        found.append(Alert(
            level, f"{failed} of {fits + failed} fits could not be made",
            f"First reason: {next(iter(cohort.failed.values()))}.",
            "What is left need not be like all people of the study.",
            ("Mend the recordings that are named under Subjects.",
             "Run the same command again: what is done is kept."),
        ))  # fmt: skip
    return found


def _may_not(cohort: Cohort) -> list[Claim]:
    name, known, of = cohort.identified
    structured = "structure_refused" in cohort.units.columns
    cases = (
        (True, "That groups or visits are alike where no difference was found.",
         "The interval of a difference says how large it may be."),
        (not structured, "What the groups care about.",
         "Many weights lead to the same gain. Ask for [fit.structure] to compare weights."),
        (known < of, f"The {name} of {of - known} of {of} people.", "It is not identified."),
        (cohort.warned, "Gains of single people whose fit has a warning.", "See Subjects."),
    )  # fmt: skip
    return [Claim(text, why) for holds, text, why in cases if holds]
