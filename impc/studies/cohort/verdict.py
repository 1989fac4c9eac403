"""Verdict of a cohort: which groups or visits differ, by how much, and warnings."""

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

#: Prefix of columns of logarithms, which are compared as ratios.
LOGARITHM = "log_cost_weight."
_LEADING = ("K.", LOGARITHM)
# Questions about means, in the order of preference.
_QUESTIONS = ("group", "mixed", "change", "visit")
# Share of fits with a warning, or of missing fits, above which the report is amber.
_MANY = 0.1
# Share of people with an identified gain below which the report is amber.
_FEW = 0.7


@dataclass(frozen=True)
class Cohort:
    """Results of a cohort for page, figures and terminal."""

    units: pd.DataFrame  # Table units.csv
    described: Mapping[str, Any]  # Content of any fit: signals and their units
    failed: Mapping[str, str]  # Unit -> reason why it has no fit

    def _of(self, *levels: Level) -> pd.DataFrame:
        """Units whose fits have one of the levels."""
        wanted = [level.value for level in levels]
        return self.units[self.units["level"].isin(wanted)] if len(self.units) else self.units

    @cached_property
    def usable(self) -> pd.DataFrame:
        """Units with a green or amber fit; gains that are not identified are NaN."""
        return only_identified(self._of(Level.GREEN, Level.AMBER))

    @cached_property
    def warned(self) -> int:
        """Number of fits with a warning."""
        return len(self._of(Level.AMBER, Level.RED))

    @cached_property
    def compared(self) -> tuple[Comparison, ...]:
        """All comparisons of green and amber fits."""
        return compare_cohort(self._of(Level.GREEN, Level.AMBER))

    @cached_property
    def tested(self) -> list[Comparison]:
        """Comparisons with a p-value, most important first."""
        return sorted((item for item in self.compared if np.isfinite(item.p)), key=_rank)

    @property
    def lead(self) -> Comparison | None:
        """Comparison in the headline: of gains, or of cost weights within a structure."""
        return next((one for one in self.tested if one.measure.startswith(_LEADING)), None)

    @property
    def measure(self) -> str:
        """Measure of the first figure; empty without units."""
        chosen = measures_of(self.units) if len(self.units) else ()
        return self.lead.measure if self.lead else next(iter(chosen), "")

    @cached_property
    def ends(self) -> pd.DataFrame:
        """Measure of each unit with its interval; NaN if not identified, except "shown"."""
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
        """Name of a signal in words."""
        return str(self.described.get("words", {}).get(signal, signal.replace("_", " ")))

    def name(self, measure: str) -> str:
        """Name of a column of units.csv in words."""
        kind, _, rest = measure.partition(".")
        if kind == "K":
            control, _, state = rest.partition(".")
            several = len(self.described.get("controls", ())) > 1
            return f"gain on {self.word(state)}" + f" ({self.word(control)})" * several
        words = {"vaf": "variance accounted for, {}", "centre_weight": "central cost weight of {}",
                 "log_cost_weight": "cost weight of {}"}  # fmt: skip
        return words.get(kind, kind.replace("_", " ")).format(self.word(rest))

    def unit(self, measure: str) -> str:
        """Unit of a measure; "-" for logarithms."""
        known = {"vaf": "%", "log_cost_weight": "-"} | self.described.get("units", {})
        return str(known.get(measure, known.get(measure.partition(".")[0], UNKNOWN)))

    def amount(self, item: Comparison) -> tuple[str, str]:
        """Difference with unit and "less" or "more", and its interval in the same form."""
        ends = np.array([item.estimate, item.low, item.high])
        if item.measure.startswith(LOGARITHM):
            value, low, high = np.exp(ends)
            return f"{number(float(value))} times", f"{between(low, high)} times"
        # For negative gains, a lower value is "more".
        below = item.measure.startswith("K.") and self.usable[item.measure].median() < 0
        word = "less" if (item.estimate < 0) != below else "more"
        low, high = sorted(np.sign(item.estimate or 1.0) * ends[1:])
        unit = self.unit(item.measure)
        said = f"{'percentage points' if unit == '%' else unit} {word}"
        return f"{number(abs(item.estimate))} {said}", f"{between(low, high)} {said}"

    def sentence(self, item: Comparison) -> str:
        """Sentence on a difference."""
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
        """Interval, number of people, p-value and effect size."""
        effect = "Cohen's d" if item.question == "visit" else "Hedges' g"
        size = f", {effect} = {number(item.effect)}" if np.isfinite(item.effect) else ""
        ends = self.amount(item)[1]
        return f"95 % CI {ends}, n = {item.n} people, Holm {probability(item.p_holm)}{size}"

    @cached_property
    def identified(self) -> tuple[str, int, int]:
        """First gain, number of people in whom it is identified, number of all fitted people."""
        gains = [name for name in (self.measure, *measures_of(self.units)) if name[:2] == "K."]
        if not gains:
            return "", 0, 0
        known = self.usable.loc[self.usable[gains[0]].notna(), "subject"]
        return self.name(gains[0]), known.nunique(), self.units["subject"].nunique()

    def without_warned(self) -> str:
        """Sentence on the leading difference in fits without a warning; empty if there is none."""
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
    """Verdict of a cohort."""
    fits, lead = len(cohort.units), cohort.lead
    if not len(cohort.usable):
        said = f"{fits} of {fits + len(cohort.failed)} fits are complete; none may be reported."
        alerts = _alerts(cohort, Level.RED)
        return Verdict(Level.RED, "No fit of this study can be used.", said, alerts)
    alerts = _alerts(cohort, Level.AMBER)
    level = Level.AMBER if alerts else Level.GREEN
    if lead is None:
        headline = f"Fitted people: {cohort.units['subject'].nunique()}."
        said = "There are too few people in two groups, or with two visits, for a comparison."
        if any(item.measure.startswith("K.") for item in cohort.compared):
            headline = "Gains are identified in too few people for a comparison."
            said = "At least three people in each group, or with both visits, are needed."
        return Verdict(level, headline, said, alerts)
    numbers = cohort.numbers(lead)
    if lead.p_holm > 0.05:
        what = "visits" if lead.question == "visit" else "groups"
        kind = "cost weight" if lead.measure.startswith(LOGARITHM) else "gain"
        said = f"Estimate: {cohort.sentence(lead)[:-1]} ({numbers}). This is not significant after "
        said += "correction for several tests. It does not show that they are equal."
        may = [Claim("That no difference was found, with the interval above.")]
        headline = f"No difference in a {kind} between the {what} was found."
        return Verdict(level, headline, said, alerts, may, _may_not(cohort))
    differing = [one for one in cohort.tested if one.p_holm <= 0.05]
    may = [Claim(cohort.sentence(item), f"{cohort.numbers(item)}.") for item in differing
           if not item.measure.startswith("centre")][:6]  # centre: by convention # fmt: skip
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
            "The gains of these people may be biased by more than their intervals show; a bias "
            "that differs between groups looks like a difference between people.",
            ("Open the pages of these people; run impc fit for one and follow its warnings.",
             "Change the settings in the same way for all people, and run the study again.",
             "Report the difference with and without these people."),
        ))  # fmt: skip
    name, known, of = cohort.identified
    if known < _FEW * of:
        found.append(Alert(
            level, f"The {name} is identified in only {known} of {of} people",
            "In the others its standard error is more than twice the median size of this gain.",
            "The remaining people may differ from all people of the study, and small groups show "
            "only large differences.",
            ("Record more or longer trials, or use a stronger perturbation; impc plan shows how "
             "many.",
             "Set [fit.structure]: a few cost weights need less data than ten gains."),
        ))  # fmt: skip
    if failed > _MANY * (fits + failed):
        found.append(Alert(
            level, f"{failed} of {fits + failed} fits failed",
            f"First reason: {next(iter(cohort.failed.values()))}.",
            "The remaining people may differ from all people of the study.",
            ("Correct the recordings that are named under Subjects.",
             "Run the same command again: finished fits are kept."),
        ))  # fmt: skip
    return found


def _may_not(cohort: Cohort) -> list[Claim]:
    name, known, of = cohort.identified
    structured = "structure_refused" in cohort.units.columns
    cases = (
        (True, "That groups or visits are equal if no difference was found.",
         "The interval of a difference shows how large it may be."),
        (not structured, "What the groups try to minimise.",
         "Many weights lead to the same gain. Set [fit.structure] to compare weights."),
        (known < of, f"The {name} of {of - known} of {of} people.", "It is not identified."),
        (cohort.warned, "Gains of single people whose fit has a warning.", "See Subjects."),
    )  # fmt: skip
    return [Claim(text, why) for holds, text, why in cases if holds]
