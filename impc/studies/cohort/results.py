"""Results of a cohort: tables, and the words and units of its page, figures and terminal.

    units.csv       one row per unit: labels, verdict, VAF, gain and its standard errors,
                    parameters, logarithms of the cost weights within a structure
    replicates.csv  one row per replicate: labels, number, gain, parameters
    intervals.csv   one row per gain entry or parameter: percentiles of the replicates, empty if the
                    entry is not individually identified

Rows are in the order of the study, columns in the order of the plant. Run times and memory are in
the log, so that the same results give identical files.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from impc.arrays import Array, percentiles
from impc.levels import Level
from impc.model.plant import UNKNOWN
from impc.reporting.rendering import number, p_value, sentence_case
from impc.studies.cohort.comparison import (
    Comparison,
    compare_cohort,
    difference_of,
    interval_of,
    outlying,
)
from impc.studies.cohort.study import LABELS, Study
from impc.studies.cohort.tasks import Store
from impc.studies.cohort.unit_result import LOGARITHM
from impc.studies.fit.facts import between, with_unit
from impc.studies.fit.verdict import UNDETERMINED

_LEADING = ("K.", LOGARITHM)
# Questions about means, in the order of preference.
_QUESTIONS = ("group", "change", "condition", "visit")
#: Corrected p-value of a difference that is found.
SIGNIFICANT = 0.05


@dataclass(frozen=True)
class Cohort:
    """Results of a cohort for page, figures and terminal."""

    units: pd.DataFrame  # Table units.csv
    # Words and units of the columns of any fit (`impc.studies.cohort.unit_result`)
    columns: Mapping[str, Mapping[str, Any]]
    failed: Mapping[str, str]  # Unit -> reason why it has no fit
    reference: str = ""  # Group, visit or condition of comparison; empty for the usual one

    def _of(self, *levels: Level) -> pd.DataFrame:
        """Units whose fits have one of the levels."""
        wanted = [level.value for level in levels]
        return self.units[self.units["level"].isin(wanted)] if len(self.units) else self.units

    @cached_property
    def usable(self) -> pd.DataFrame:
        """Units with a green or amber fit."""
        return self._of(Level.GREEN, Level.AMBER)

    @cached_property
    def with_warning(self) -> pd.DataFrame:
        """Units with a warning, except that no gain is determined: such a fit counts little."""
        found = self._of(Level.AMBER, Level.RED)
        return found[found["kind"] != UNDETERMINED] if len(found) else found

    @property
    def warned(self) -> int:
        """Number of fits with a warning."""
        return len(self.with_warning)

    @property
    def people(self) -> int:
        """Number of people with a fit."""
        return int(self.units["subject"].nunique())

    @property
    def measures(self) -> list[str]:
        """Columns of `units` that are compared."""
        return [name for name, column in self.columns.items() if column["compared"]]

    @cached_property
    def compared(self) -> tuple[Comparison, ...]:
        """All comparisons of green and amber fits."""
        return compare_cohort(self.usable, self.measures, self.reference)

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
        return self.lead.measure if self.lead else next(iter(self.measures), "")

    @cached_property
    def far(self) -> pd.Series[float]:
        """Ratio of a gain to its group's median for fits to be looked at, else NaN."""
        return outlying(self.usable, self.measures).reindex(self.units.index)

    @property
    def outliers(self) -> int:
        """Number of usable fits to be looked at."""
        return int(self.far.notna().sum())

    @cached_property
    def ends(self) -> pd.DataFrame:
        """Measure of each unit with its interval in shown units, and whether it is determined."""
        found = interval_of(self.units, self.measure)
        found[:] = self.shown(self.measure, found.to_numpy())
        kind, _, rest = self.measure.partition(".")
        known = self.units.get(f"{kind}_determined.{rest}", True)
        usable = self.units.index.isin(self.usable.index)
        return found.assign(determined=known & usable).astype({"determined": bool})

    def of(self, measure: str) -> Mapping[str, Any]:
        """Words and units of a measure."""
        nothing = {"name": "", "scale": 1.0, "unit": UNKNOWN, "unit_si": UNKNOWN}
        return self.columns[measure] if measure else nothing

    def amount(self, item: Comparison) -> tuple[str, str, str]:
        """Difference and its interval, both without unit, and the unit with "less" or "more"."""
        ends = self.shown(item.measure, np.array([item.estimate, item.low, item.high]))
        if item.measure.startswith(LOGARITHM):
            return number(float(ends[0])), between(*ends[1:]), "times"
        # For negative gains, a lower value is "more".
        below = item.measure.startswith("K.") and self.usable[item.measure].median() < 0
        word = "less" if (item.estimate < 0) != below else "more"
        low, high = sorted(np.sign(item.estimate or 1.0) * ends[1:])
        unit = self.of(item.measure)["unit"].replace("%", "percentage points")
        return number(abs(ends[0])), between(low, high), f"{unit} {word}"

    def shown(self, measure: str, values: Array) -> Array:
        """Values of a measure as pages show them; logarithms as ratios."""
        ratio = measure.startswith(LOGARITHM)
        return np.exp(values) if ratio else np.asarray(self.of(measure)["scale"] * values)

    def sentence(self, item: Comparison) -> str:
        """Sentence on a difference."""
        value, _, unit = self.amount(item)
        amount, name = f"{value} {unit}", self.of(item.measure)["name"]
        first, second = (_place(item.question, one) for one in (item.first, item.second))
        if item.question == "change":
            said = f"from visit to visit, the {name} rises by {amount} {second} than {first}"
        elif item.measure.startswith("K."):
            top, per, control = (self.of(item.measure)[key] for key in ("top", "per", "control"))
            amount = f"{value} {top} {unit.rpartition(' ')[2]} {control.removeprefix('commanded ')}"
            groups = item.question == "group"
            who = f"{second[3:]} answers" if groups else f"{second} people answer"
            said = f"{who} {per} with {amount} than {first[3:] if groups else first}"
        else:
            than = "as high {} as" if item.measure.startswith(LOGARITHM) else "{} than"
            said = f"the {name} is {amount} {than.format(second)} {first}"
        several = item.condition and self.units["condition"].nunique() > 1
        where = f" ({item.condition})" if several else ""
        return f"{sentence_case(said)}{where}."

    def numbers(self, item: Comparison) -> str:
        """Interval, number of people, SD between them, p-value and effect size."""
        effect = "Cohen's d" if item.question in ("visit", "condition") else "Hedges' g"
        size = f", {effect} = {number(item.effect)}" if np.isfinite(item.effect) else ""
        _, ends, unit = self.amount(item)
        column = self.of(item.measure)
        apart = with_unit(number(item.between * column["scale"]), column["unit"])
        differ = f" who differ by an SD of {apart}"
        people = f"n = {item.n} people{differ * (item.measure[:2] == 'K.' and item.between > 0)}"
        p = p_value(item.p_holm)
        p_holm = f"p_holm {p}" if p[0] == "<" else f"p_holm = {p}"
        return f"95 % CI {ends} {unit}, {people}, {p_holm}{size}"

    @cached_property
    def determined(self) -> tuple[str, int, int]:
        """First gain, number of people in whom it is determined, number of all fitted people."""
        gains = [name for name in (self.measure, *self.measures) if name[:2] == "K."]
        if not gains:
            return "", 0, 0
        known = self.usable.get(f"K_determined{gains[0][1:]}")
        rows = self.usable if known is None else self.usable[known.astype(bool)]
        return self.of(gains[0])["name"], rows["subject"].nunique(), self.people

    def without_warned(self) -> str:
        """The leading difference in fits without a warning, as a sentence; empty without one."""
        return self._only(
            self.units.drop(index=self.with_warning.index), "fits with a warning", self.lead
        )

    def without_outliers(self, item: Comparison | None) -> str:
        """A difference without the fits to be looked at; empty without such fits."""
        which = f"the {self.outliers} fit{'s' * (self.outliers > 1)} to look at"
        kept = self.usable[self.far[self.usable.index].isna()]
        return self._only(kept, which, item if self.outliers else None)

    def _only(self, kept: pd.DataFrame, without: str, item: Comparison | None) -> str:
        if item is None:
            return ""
        other = difference_of(kept, item, self.reference)
        if other.note:
            return f" Without {without}, too few people are left."
        value, ends, unit = self.amount(other)
        return f" Without {without} it is {value} {unit} (95 % CI {ends}, n = {other.n})."


def _place(question: str, name: str) -> str:
    """A group, visit or condition in a sentence."""
    if question == "visit":
        return f"at visit {name}"
    if question == "condition":
        return f"in condition {name}"
    return f"in the {name} group" if len(name) > 1 and name.isalpha() else f"in group {name}"


def _rank(item: Comparison) -> tuple[bool, int, bool, float]:
    last = not item.measure.startswith(_LEADING)
    return not item.p_holm <= SIGNIFICANT, _QUESTIONS.index(item.question), last, item.p


def cohort_tables(study: Study, store: Store) -> dict[str, pd.DataFrame]:
    """Tables by name (see the module's docstring); units without a fit are omitted."""
    found: dict[str, list[dict[str, Any]]] = {"units": [], "replicates": [], "intervals": []}
    for unit in study.units:
        fit = store.fit(unit.name)
        if fit is None:
            continue
        labels = {"unit": unit.name} | {name: getattr(unit, name) for name in LABELS}
        found["units"].append(labels | row_of(fit))
        names = [*(name for name in fit["row"] if name.startswith("K.")), *fit["parameters"]]
        drawn = []
        for index in range(study.replicates):
            again = store.fit(unit.name, index)
            if again is not None:
                values = (*np.ravel(again["K"]), *again["parameters"])
                drawn.append(dict(zip(names, values, strict=True)))
                found["replicates"].append(labels | {"replicate": index + 1} | drawn[-1])
        if len(drawn) > 1:
            found["intervals"] += [labels | row for row in _intervals(fit, pd.DataFrame(drawn))]
    return {name: pd.DataFrame(rows) for name, rows in found.items()}


def row_of(fit: Mapping[str, Any]) -> dict[str, Any]:
    """Columns of units.csv of a stored fit; missing numbers are NaN."""
    return {name: np.nan if value is None else value for name, value in fit["row"].items()}


def _intervals(fit: dict[str, Any], drawn: pd.DataFrame) -> Iterator[dict[str, Any]]:
    for name, values in drawn.items():
        # Along unidentified directions replicates stay at the start: their spread has no meaning.
        known = fit["row"].get(f"K_identified{str(name)[1:]}", True)
        low, high = percentiles(values, 0.95) if known else (np.nan, np.nan)
        unit = fit["shown"].get(name, {}).get("unit_si", UNKNOWN)
        yield {
            "name": name, "unit": unit, "value": fit["row"][name],
            "low": float(low), "high": float(high), "level": 0.95, "replicates": len(drawn),
        }  # fmt: skip
