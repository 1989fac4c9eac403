"""Comparison of groups and visits of a cohort, measure by measure.

    two groups     Welch's t-test on subject means over visits, Hedges' g
    two visits     paired t-test on subjects with both visits, d_z = mean / SD of the differences
    both           Welch's t-test on the subjects' changes per visit
    all visits     mixed model of cost weights within a structure: group, visit, subject
    reliability    ICC(A,1) between visits

A gain that the recordings of a unit do not identify is treated as missing (`not_identified`).
P-values are also given after Holm's correction over the measures of one question.
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
# Largest standard error over the median size of an entry. The unit's own value is not used, because
# the remaining values would then be too large on average. Well identified small entries are kept:
# entries with true value zero have a median size of 0.67 standard errors.
_LARGEST = 2.0


@dataclass(frozen=True)
class Comparison:
    """One comparison of one measure in one condition; missing numbers are NaN."""

    question: str  # "group", "visit", "change", "mixed" or "reliability"
    measure: str
    condition: str
    first: str = ""  # Compared groups or visits; empty for the reliability
    second: str = ""
    estimate: float = np.nan  # Difference of means (second minus first), or ICC
    low: float = np.nan  # 95 % interval
    high: float = np.nan
    effect: float = np.nan  # Hedges' g or d_z
    p: float = np.nan
    n: int = 0  # Number of subjects
    p_holm: float = np.nan
    note: str = ""  # Reason why there is no number


def measures_of(units: pd.DataFrame) -> tuple[str, ...]:
    """Columns of the table `units` that are compared, independent of the data.

    Logarithms of cost weights within a structure (without one: cost weights of recorded outputs in
    the analytic centre), gains on recorded outputs and their rates (all gains if no state has the
    name of an output), and VAF. Gains on delay or muscle states are left out: they have little
    meaning, and more measures reduce the power after Holm's correction.
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
    """All possible comparisons; gains that a unit does not identify are missing."""
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
    """Comparison with the results of a t-test of SciPy."""
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
    """Welch's t-test on each subject's change per visit (least-squares slope over visits)."""
    place = {visit: index for index, visit in enumerate(dict.fromkeys(part["visit"]))}
    slopes: dict[str, list[float]] = {asked.first: [], asked.second: []}
    for (group, _), rows in part.dropna(subset=[asked.measure]).groupby(["group", "subject"]):
        if group in slopes and rows["visit"].nunique() > 1:
            visits = [place[visit] for visit in rows["visit"]]
            slopes[group].append(float(np.polyfit(visits, rows[asked.measure], 1)[0]))
    return _welch(asked, *map(np.array, slopes.values()))


def _mixed(part: pd.DataFrame, asked: Comparison) -> Comparison:
    """Group effect in a mixed model with visit effects and subject intercepts (REML)."""
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
        why = "; ".join(str(item.message) for item in raised[:1]) or "no standard error"
        note = f"the mixed model did not converge ({one_line(why)[:60]})"
        return replace(asked, n=n, note=note)
    # n - 2 degrees of freedom between subjects: exact if every subject has all visits.
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
    """Hedges' g: difference divided by the pooled SD, corrected for small samples."""
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
    """Number of units that do not identify a gain, by its column; zero counts are omitted.

    An entry is identified if its standard error is at most twice the median size of the entry over
    all units with a standard error. The standard error includes unidentified directions
    (`GainCovariance.entries`).
    """
    gains = units.filter(regex=r"^K\.")
    lost = (only_identified(units)[gains.columns].isna() & gains.notna()).sum()
    return {str(name): int(count) for name, count in lost.items() if count}


def only_identified(units: pd.DataFrame) -> pd.DataFrame:
    """The table `units` with NaN for gains that a unit does not identify."""
    kept = units.copy()
    for name in units.columns:
        beside = f"K_deviation{name[1:]}"
        if name.startswith("K.") and beside in units.columns:
            deviation = units[beside].astype(float)
            usual = units[name].astype(float).abs()[np.isfinite(deviation)].median()
            kept[name] = units[name].where(deviation <= _LARGEST * usual)
    return kept
