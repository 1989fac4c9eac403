"""Groups and visits of a cohort compared, measure by measure.

    two groups     Welch's t on the subjects' means over their visits, Hedges' g
    two visits     paired t on subjects who have both, d_z = mean / SD of the differences
    both           Welch's t on the subjects' changes per visit: whether groups change differently
    all visits     a mixed model of cost weights within a structure: group, visit, a mean for each
    subject reliability    ICC(A,1) between visits

A gain that the recordings of a unit do not identify is no datum (`not_identified`).
Several measures are tested at once: beside each p stands Holm's, over the measures of one question.
"""

from __future__ import annotations

import itertools
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.stats
from statsmodels.regression.mixed_linear_model import MixedLM

from impc.assess.several_tests import holm
from impc.checking import replace
from impc.errors import DataError, one_line
from impc.studies.reliability.icc import icc

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pandas as pd

    from impc.arrays import Array

_FEWEST = 3
_COST_WEIGHT = "log_cost_weight."
# A deviation may be so many times the usual size of an entry. Small entries that are well
# identified stay: those of a gain whose truth is zero have a median size of 0.67 of their
# deviation. It is not compared with the unit's own value, for what stayed would then be too large
# on average.
_LARGEST = 2.0


@dataclass(frozen=True)
class Comparison:
    """One question asked of one measure in one condition."""

    question: str  # "group", "visit", "change", "mixed" or "reliability"
    measure: str  # Of which, by name
    condition: str
    first: str  # What is compared; empty for the reliability
    second: str
    estimate: float  # Difference of means (second minus first), or the ICC
    low: float  # Interval of 95 %; NaN where the method gives none
    high: float
    effect: float  # Hedges' g or d_z; NaN for the others
    p: float  # NaN for the reliability
    n: int  # Subjects
    p_holm: float = np.nan
    note: str = ""  # Why there is no number; empty otherwise


def measures_of(units: pd.DataFrame) -> tuple[str, ...]:
    """Columns of the table `units` that are compared: few, chosen before the data are seen.

    Logarithms of cost weights within a structure, or without one cost weights of recorded outputs
    in the analytic centre; gains on recorded outputs and their rates; and VAF. Gains on states of a
    delay or a muscle, one by one, say little, and every measure makes Holm's correction harder on
    the others. All gains where no state has an output's name.
    """
    outputs = [name.removeprefix("vaf.") for name in units.columns if name.startswith("vaf.")]
    shown = {*outputs, *(f"{name}_rate" for name in outputs)}
    gains = [name for name in units.columns if name.startswith("K.")]
    named = [name for name in gains if name.split(".", 2)[2] in shown]
    penalised = [name for name in units.columns if name.startswith(_COST_WEIGHT)]
    centre = [name for name in units.columns if name in {f"centre_weight.{o}" for o in outputs}]
    shares = [name for name in units.columns if name.startswith("vaf.")]
    return (*penalised, *(named or gains), *(() if penalised else centre), *shares)


def compare_cohort(units: pd.DataFrame) -> tuple[Comparison, ...]:
    """Answer every question that the units allow, without gains that a unit does not identify."""
    if len(units) == 0:
        return ()
    chosen = measures_of(units)
    found: list[Comparison] = []
    for condition, part in only_identified(units).groupby("condition", sort=True, dropna=False):
        stated = str(condition)
        groups = sorted(set(part["group"]) - {""})
        visits = list(dict.fromkeys(part["visit"]))
        for one, other in itertools.combinations(groups, 2):
            found += _holm([_groups(part, name, stated, one, other) for name in chosen])
            if len(visits) > 1:
                found += _holm([_interaction(part, name, stated, one, other) for name in chosen])
                penalised = [name for name in chosen if name.startswith(_COST_WEIGHT)]
                found += _holm([_mixed(part, name, stated, one, other) for name in penalised])
        for one, other in itertools.combinations(visits, 2):
            found += _holm([_visits(part, name, stated, one, other) for name in chosen])
        if len(visits) > 1:
            found += [_reliability(part, name, stated) for name in chosen]
    return tuple(found)


def _groups(part: pd.DataFrame, measure: str, condition: str, one: str, other: str) -> Comparison:
    means = part.groupby(["group", "subject"])[measure].mean().dropna()
    a, b = (np.asarray(means.get(name, [])) for name in (one, other))
    return _welch("group", measure, condition, one, other, a, b)


def _welch(
    question: str, measure: str, condition: str, one: str, other: str, a: Array, b: Array
) -> Comparison:
    n = len(a) + len(b)
    if min(len(a), len(b)) < _FEWEST:
        return _nothing(question, measure, condition, one, other, n)
    test: Any = scipy.stats.ttest_ind(b, a, equal_var=False)
    interval = test.confidence_interval(0.95)
    return Comparison(
        question, measure, condition, one, other, float(b.mean() - a.mean()),
        float(interval.low), float(interval.high), _hedges(a, b), float(test.pvalue), n,
    )  # fmt: skip


def _visits(part: pd.DataFrame, measure: str, condition: str, one: str, other: str) -> Comparison:
    wide = part.pivot_table(index="subject", columns="visit", values=measure)
    both = wide[[one, other]].dropna() if {one, other} <= set(wide.columns) else wide.iloc[:0]
    if len(both) < _FEWEST:
        return _nothing("visit", measure, condition, one, other, len(both))
    difference = np.asarray(both[other] - both[one])
    test: Any = scipy.stats.ttest_1samp(difference, 0.0)
    interval = test.confidence_interval(0.95)
    spread = float(difference.std(ddof=1))
    return Comparison(
        "visit", measure, condition, one, other, float(difference.mean()), float(interval.low),
        float(interval.high), float(difference.mean() / spread) if spread else np.nan,
        float(test.pvalue), len(both),
    )  # fmt: skip


def _interaction(
    part: pd.DataFrame, measure: str, condition: str, one: str, other: str
) -> Comparison:
    """Welch's t on each subject's change per visit, its least-squares slope over the visits."""
    place = {visit: index for index, visit in enumerate(dict.fromkeys(part["visit"]))}
    slopes: dict[str, list[float]] = {one: [], other: []}
    for (group, _), rows in part.dropna(subset=[measure]).groupby(["group", "subject"]):
        if group in slopes and rows["visit"].nunique() > 1:
            visits = [place[visit] for visit in rows["visit"]]
            slopes[group].append(float(np.polyfit(visits, rows[measure], 1)[0]))
    a, b = np.array(slopes[one]), np.array(slopes[other])
    return _welch("change", measure, condition, one, other, a, b)


def _mixed(part: pd.DataFrame, measure: str, condition: str, one: str, other: str) -> Comparison:
    """Group effect with a mean for each visit and each subject, by restricted likelihood."""
    rows = part[part["group"].isin([one, other])].dropna(subset=[measure])
    each = rows.groupby("group")["subject"].nunique()
    n = int(each.sum())
    if min(each.get(one, 0), each.get(other, 0)) < _FEWEST:
        return _nothing("mixed", measure, condition, one, other, n)
    visits = list(dict.fromkeys(rows["visit"]))[1:]
    second = [rows["group"] == other, *(rows["visit"] == visit for visit in visits)]
    design = [np.ones(len(rows)), *(one.to_numpy(float) for one in second)]
    with warnings.catch_warnings(record=True) as raised:
        warnings.simplefilter("always")
        model = MixedLM(np.asarray(rows[measure], float), np.transpose(design), rows["subject"])
        fitted = model.fit(reml=True)
    effect, error = float(fitted.params[1]), float(fitted.bse[1])
    if not (np.isfinite(error) and error > 0) or not fitted.converged:
        why = "; ".join(str(item.message) for item in raised[:1]) or "no deviation"
        found = _nothing("mixed", measure, condition, one, other, n)
        return replace(found, note=f"the mixed model did not converge ({one_line(why)[:60]})")
    # The effect lies between subjects: exact where every subject has all visits.
    reach = float(scipy.stats.t.ppf(0.975, n - 2)) * error
    p = 2 * float(scipy.stats.t.sf(abs(effect) / error, n - 2))
    ends = effect - reach, effect + reach
    return Comparison("mixed", measure, condition, one, other, effect, *ends, np.nan, p, n)


def _reliability(part: pd.DataFrame, measure: str, condition: str) -> Comparison:
    wide = part.pivot_table(index="subject", columns="visit", values=measure)
    try:
        found = icc(wide.to_numpy(), "A,1")
    except DataError:
        return _nothing("reliability", measure, condition, "", "", len(wide.dropna()))
    nan, ends = float("nan"), (found.value, found.low, found.high)
    return Comparison("reliability", measure, condition, "", "", *ends, nan, nan, found.subjects)


def _hedges(a: Array, b: Array) -> float:
    """Hedges' g: difference over the pooled SD, corrected for small samples."""
    freedom = len(a) + len(b) - 2
    pooled = np.sqrt(((len(a) - 1) * a.var(ddof=1) + (len(b) - 1) * b.var(ddof=1)) / freedom)
    if pooled == 0:
        return float("nan")
    return float((b.mean() - a.mean()) / pooled * (1 - 3 / (4 * freedom - 1)))


def _nothing(
    question: str, measure: str, condition: str, one: str, other: str, n: int
) -> Comparison:
    nan, note = float("nan"), f"too few subjects ({n})"
    return Comparison(
        question, measure, condition, one, other, nan, nan, nan, nan, nan, n, note=note
    )


def _holm(found: list[Comparison]) -> list[Comparison]:
    corrected = holm(np.array([item.p for item in found]))
    return [
        replace(item, p_holm=float(p)) if np.isfinite(p) else item
        for item, p in zip(found, corrected, strict=True)
    ]


def not_identified(units: pd.DataFrame) -> dict[str, int]:
    """How many units do not identify a gain, by its column; none for gains of all units.

    A unit says an entry whose standard deviation is at most twice the median size of the entry
    over the units that give a deviation. The deviation counts what the entry may owe to directions
    that are not identified (`GainCovariance.entries`), so that one identified only with others is
    data too where it is identified well enough.
    """
    gains = units.filter(regex=r"^K\.")
    lost = (only_identified(units)[gains.columns].isna() & gains.notna()).sum()
    return {str(name): int(count) for name, count in lost.items() if count}


def only_identified(units: pd.DataFrame) -> pd.DataFrame:
    """The table `units` with NaN for each gain that `not_identified` has of its unit."""
    kept = units.copy()
    for name in units.columns:
        beside = f"K_deviation{name[1:]}"
        if name.startswith("K.") and beside in units.columns:
            deviation = units[beside].astype(float)
            usual = units[name].astype(float).abs()[np.isfinite(deviation)].median()
            kept[name] = units[name].where(deviation <= _LARGEST * usual)
    return kept


def unidentified_sentences(counts: Mapping[str, int], of: int) -> list[str]:
    """What is left out for it, in one sentence; none where nothing is."""
    if not counts:
        return []
    each = "; ".join(f"the {measure_words(name)} of {count}" for name, count in counts.items())
    return [
        "A gain whose standard deviation is more than twice its usual size is not identified, and "
        f"not compared: of {of} units {each}."
    ]


_WORDS = {
    "K": "gain of {1} to {0}",
    "K_of_weights": "gain of the weights, {1} to {0}",
    "vaf": "VAF of {0}",
    "held_out_vaf": "VAF of {0}, left out",
    "cost_weight": "cost weight of {0}",
    "centre_weight": "cost weight of {0}, analytic centre",
    "largest_input": "largest {0}",
    "log_cost_weight": "logarithm of the cost weight of {0}",
}


def measure_words(name: str) -> str:
    """A column by its `name` in words: "K.command.theta1" is "gain of theta1 to command"."""
    kind, *rest = name.split(".", 2 if name.startswith("K") else 1)
    return _WORDS[kind].format(*rest) if kind in _WORDS and rest else name.replace("_", " ")
