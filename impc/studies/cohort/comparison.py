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
    from collections.abc import Callable, Sequence

    import pandas as pd

    from impc.arrays import Array

    _Test = Callable[[pd.DataFrame, "Comparison"], "Comparison"]

_FEWEST = 3
_COST_WEIGHT = "log_cost_weight."
# A deviation may be so many times the usual size of an entry. Small entries that are well
# identified stay: those of a gain whose truth is zero have a median size of 0.67 of their
# deviation. It is not compared with the unit's own value, for what stayed would then be too large
# on average.
_LARGEST = 2.0


@dataclass(frozen=True)
class Comparison:
    """One question asked of one measure in one condition; NaN where there is no number."""

    question: str  # "group", "visit", "change", "mixed" or "reliability"
    measure: str
    condition: str
    first: str = ""  # What is compared; empty for the reliability
    second: str = ""
    estimate: float = np.nan  # Difference of means (second minus first), or the ICC
    low: float = np.nan  # Interval of 95 %
    high: float = np.nan
    effect: float = np.nan  # Hedges' g or d_z
    p: float = np.nan
    n: int = 0  # Subjects
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
    penalised = [name for name in chosen if name.startswith(_COST_WEIGHT)]
    found: list[Comparison] = []
    for label, part in only_identified(units).groupby("condition", sort=True, dropna=False):
        condition, visits = str(label), list(dict.fromkeys(part["visit"]))
        between: dict[str, tuple[_Test, Sequence[str]]] = {"group": (_groups, chosen)}
        if len(visits) > 1:
            between |= {"change": (_changes, chosen), "mixed": (_mixed, penalised)}
        for pair in itertools.combinations(sorted(set(part["group"]) - {""}), 2):
            for question, (test, names) in between.items():
                asked = [Comparison(question, name, condition, *pair) for name in names]
                found += _holm([test(part, one) for one in asked])
        for pair in itertools.combinations(visits, 2):
            asked = [Comparison("visit", name, condition, *pair) for name in chosen]
            found += _holm([_visits(part, one) for one in asked])
        if len(visits) > 1:
            found += [_reliable(part, Comparison("reliability", name, condition))
                      for name in chosen]  # fmt: skip
    return tuple(found)


def _groups(part: pd.DataFrame, asked: Comparison) -> Comparison:
    means = part.groupby(["group", "subject"])[asked.measure].mean().dropna()
    return _welch(asked, *(np.asarray(means.get(name, [])) for name in (asked.first, asked.second)))


def _welch(asked: Comparison, a: Array, b: Array) -> Comparison:
    if min(len(a), len(b)) < _FEWEST:
        return _nothing(asked, len(a) + len(b))
    return _tested(asked, scipy.stats.ttest_ind(b, a, equal_var=False), b.mean() - a.mean(),
                   _hedges(a, b), len(a) + len(b))  # fmt: skip


def _tested(asked: Comparison, test: Any, estimate: float, effect: float, n: int) -> Comparison:
    """With the numbers of one of scipy's t-tests."""
    low, high = map(float, test.confidence_interval(0.95))
    return replace(asked, estimate=float(estimate), low=low, high=high, effect=float(effect),
                   p=float(test.pvalue), n=n)  # fmt: skip


def _visits(part: pd.DataFrame, asked: Comparison) -> Comparison:
    wide = part.pivot_table(index="subject", columns="visit", values=asked.measure)
    wide = wide.reindex(columns=[asked.first, asked.second]).dropna()
    if len(wide) < _FEWEST:
        return _nothing(asked, len(wide))
    difference = np.asarray(wide[asked.second] - wide[asked.first])
    mean, spread = difference.mean(), difference.std(ddof=1)
    effect = mean / spread if spread else np.nan
    return _tested(asked, scipy.stats.ttest_1samp(difference, 0.0), mean, effect, len(wide))


def _changes(part: pd.DataFrame, asked: Comparison) -> Comparison:
    """Welch's t on each subject's change per visit, its least-squares slope over the visits."""
    place = {visit: index for index, visit in enumerate(dict.fromkeys(part["visit"]))}
    slopes: dict[str, list[float]] = {asked.first: [], asked.second: []}
    for (group, _), rows in part.dropna(subset=[asked.measure]).groupby(["group", "subject"]):
        if group in slopes and rows["visit"].nunique() > 1:
            visits = [place[visit] for visit in rows["visit"]]
            slopes[group].append(float(np.polyfit(visits, rows[asked.measure], 1)[0]))
    return _welch(asked, *map(np.array, slopes.values()))


def _mixed(part: pd.DataFrame, asked: Comparison) -> Comparison:
    """Group effect with a mean for each visit and each subject, by restricted likelihood."""
    pair = [asked.first, asked.second]
    rows = part[part["group"].isin(pair)].dropna(subset=[asked.measure])
    each = rows.groupby("group")["subject"].nunique().reindex(pair, fill_value=0)
    n = int(each.sum())
    if each.min() < _FEWEST:
        return _nothing(asked, n)
    visits = list(dict.fromkeys(rows["visit"]))[1:]
    second = [rows["group"] == asked.second, *(rows["visit"] == visit for visit in visits)]
    design = [np.ones(len(rows)), *(one.to_numpy(float) for one in second)]
    with warnings.catch_warnings(record=True) as raised:
        warnings.simplefilter("always")
        scores = np.asarray(rows[asked.measure], float)
        fitted = MixedLM(scores, np.transpose(design), rows["subject"]).fit(reml=True)
    effect, error = float(fitted.params[1]), float(fitted.bse[1])
    if not (np.isfinite(error) and error > 0) or not fitted.converged:
        why = "; ".join(str(item.message) for item in raised[:1]) or "no deviation"
        note = f"the mixed model did not converge ({one_line(why)[:60]})"
        return replace(asked, n=n, note=note)
    # The effect lies between subjects: exact where every subject has all visits.
    reach = float(scipy.stats.t.ppf(0.975, n - 2)) * error
    p = 2 * float(scipy.stats.t.sf(abs(effect) / error, n - 2))
    return replace(asked, estimate=effect, low=effect - reach, high=effect + reach, p=p, n=n)


def _reliable(part: pd.DataFrame, asked: Comparison) -> Comparison:
    wide = part.pivot_table(index="subject", columns="visit", values=asked.measure)
    try:
        found = icc(wide.to_numpy(), "A,1")
    except DataError:
        return _nothing(asked, len(wide.dropna()))
    return replace(asked, estimate=found.value, low=found.low, high=found.high, n=found.subjects)


def _hedges(a: Array, b: Array) -> float:
    """Hedges' g: difference over the pooled SD, corrected for small samples."""
    freedom = len(a) + len(b) - 2
    pooled = np.sqrt(((len(a) - 1) * a.var(ddof=1) + (len(b) - 1) * b.var(ddof=1)) / freedom)
    if pooled == 0:
        return float("nan")
    return float((b.mean() - a.mean()) / pooled * (1 - 3 / (4 * freedom - 1)))


def _nothing(asked: Comparison, n: int) -> Comparison:
    return replace(asked, n=n, note=f"too few subjects ({n})")


def _holm(found: list[Comparison]) -> list[Comparison]:
    corrected = holm(np.array([item.p for item in found]))
    return [replace(item, p_holm=float(p)) for item, p in zip(found, corrected, strict=True)]


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
