"""Comparison of groups, visits and conditions of a cohort, measure by measure.

A mean over people is that of a random-effects meta-analysis: each person counts by the inverse of
the variance of the estimate plus the variance between people, after DerSimonian and Laird (Paule
and Mandel's variance grows with few uncertain gains that are far off). Its standard error takes
these shares p (of sum 1) as given, and the variances from the values y and mean m:

    SE^2 = sum a (y - m)^2,    df = 1 / (sum p^2 + (sum a)^2 - sum a^2),    a = p^2 / (1 - p)

(HC2 with Satterthwaite's degrees of freedom, Bell and McCaffrey 2002). With equal shares, as for
measures without a standard error, the tests are Welch's and Student's. Hartung and Knapp's error is
not used: a gain that the recordings do not determine stays near the start of the search, so that it
deviates less than its variance says. In simulated groups of 5 to 20 people with a third of such
fits their 95 % interval covers 85 to 92 %, this one 94 to 97 % (test_weighted_means.py).

    group         means of people over visits, Welch's degrees of freedom; effect: Hedges' g
    visit         people with both visits, mean of differences over their SD
    condition     the same for two conditions
    change        change per visit of people in two groups
    reliability   ICC(A,1) between visits, not weighted

P-values are also given after Holm's correction over the measures of one question.
"""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd
import scipy.stats
from statsmodels.stats.meta_analysis import combine_effects, effectsize_smd

from impc.assess.covariance import TWO_SIDED
from impc.assess.several_tests import holm
from impc.checking import replace
from impc.errors import DataError
from impc.studies.reliability.icc import icc

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from impc.arrays import Array

_FEWEST = 3  # People in each mean
_LEAST = 2.0  # People of equal shares to whom a mean must correspond, 1 / sum p^2
_COST_WEIGHT = "log_cost_weight."
# Usual names of what the others are compared with.
_USUAL = re.compile(r"(?<![^\W_])(eo|open|baseline|pre|control)(?![^\W_])", re.IGNORECASE)
# Ratio of a gain to the median of its group, up or down, at which the fit is to be looked at.
_FAR = 3.0


@dataclass(frozen=True)
class Comparison:
    """One comparison of one measure in one condition; missing numbers are NaN."""

    question: str  # "group", "visit", "condition", "change" or "reliability"
    measure: str
    condition: str
    first: str = ""  # Compared groups, visits or conditions; empty for the reliability
    second: str = ""
    estimate: float = np.nan  # Difference of means (second minus first), or ICC
    low: float = np.nan  # 95 % interval
    high: float = np.nan
    between: float = np.nan  # SD between people, without the uncertainty of their fits
    effect: float = np.nan  # Hedges' g or d_z
    p: float = np.nan
    n: int = 0  # Number of subjects
    p_holm: float = np.nan
    note: str = ""  # Reason why there is no number

    @property
    def asked(self) -> tuple[str, ...]:
        """What is compared with what."""
        return self.question, self.measure, self.condition, self.first, self.second


class Mean(NamedTuple):
    """Weighted mean over people."""

    value: float
    error: float  # Standard error
    freedom: float  # Degrees of freedom of the error
    between: float  # Variance between people
    spread: float  # SD of the values
    people: float  # Number of people of equal shares to whom it corresponds

    @property
    def reach(self) -> float:
        """Half of the 95 % interval."""
        return float(scipy.stats.t.ppf(0.975, self.freedom)) * self.error


def weighted_mean(values: Array, variances: Array) -> Mean:
    """Mean of the `values` of people; variances of zero give them equal shares."""
    n = len(values)
    shares, between = np.full(n, 1 / n), float(np.var(values, ddof=1))
    # All variances are equal if there are none; equal values have no heterogeneity.
    with np.errstate(divide="ignore", invalid="ignore"):
        if variances.any():
            least = 1e-12 * variances.max()
            found = combine_effects(values, np.maximum(variances, least), "dl")
            between = max(float(found.tau2), 0.0)
            shares = np.asarray(found.weights_rel_re if between else found.weights_rel_fe)
        mean, squares = float(shares @ values), float(shares @ shares)
        a = shares**2 / (1 - shares)
        apart = (values - mean) ** 2
        freedom = 1 / (squares + a.sum() ** 2 - a @ a)
        spread = np.sqrt(shares @ apart / (1 - squares))
        error = float(np.sqrt(a @ apart))
    return Mean(mean, error, float(freedom), between, float(spread), 1 / squares)


def measures_of(units: pd.DataFrame, inner: Collection[str] = ()) -> tuple[str, ...]:
    """Columns of the table `units` that are compared, independent of the data.

    Logarithms of cost weights within a structure (without one: cost weights of recorded outputs in
    the analytic centre), gains on recorded outputs and their rates (if no state has the name of an
    output: all gains except on `inner` states), and VAF. More measures reduce the power after
    Holm's correction.
    """
    outputs = [name.removeprefix("vaf.") for name in units.columns if name.startswith("vaf.")]
    shown = {*outputs, *(f"{name}_rate" for name in outputs)}
    gains = [name for name in units.columns if name.startswith("K.")]
    named = [name for name in gains if name.split(".", 2)[2] in shown]
    others = [name for name in gains if name.split(".", 2)[2] not in inner]
    penalised = [name for name in units.columns if name.startswith(_COST_WEIGHT)]
    centre = [name for name in units.columns if name in {f"centre_weight.{o}" for o in outputs}]
    shares = [name for name in units.columns if name.startswith("vaf.")]
    return (*penalised, *(named or others), *(() if penalised else centre), *shares)


def interval_of(units: pd.DataFrame, measure: str) -> pd.DataFrame:
    """Columns value, low and high of a measure; without ends they are NaN."""
    kind, _, rest = measure.partition(".")
    value = units[measure].astype(float)
    ends = {end: units.get(f"{kind}_{end}.{rest}", value * np.nan) for end in ("low", "high")}
    return pd.DataFrame({"value": value, **ends}).astype(float)


def _variances(units: pd.DataFrame, measure: str) -> pd.Series[float]:
    """Squares of the standard errors of a measure; zeros for a measure without."""
    kind, _, rest = measure.partition(".")
    given = units.get(f"{kind}_deviation.{rest}")
    if given is not None:
        return given.astype(float) ** 2
    ends = interval_of(units, measure)
    if ends["low"].notna().any():
        return ((ends["high"] - ends["low"]) / (2 * TWO_SIDED)) ** 2
    return pd.Series(0.0, units.index)


def _people(part: pd.DataFrame, measure: str, along: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Values and variances by subject and the column `along`: weighted means of their units.

    Without a standard error (infinite or unknown) a value is NaN and its variance infinite.
    """
    variances = _variances(part, measure)
    equal = not variances.fillna(1.0).any()
    weight = (1.0 + variances) if equal else (1 / variances.clip(lower=1e-300)).fillna(0.0)
    rows = part.assign(weight=weight, times=weight * part[measure]).dropna(subset=[measure])
    sums = rows.groupby(["subject", along])[["weight", "times"]].sum()
    weights, times = (sums[name].unstack(along) for name in ("weight", "times"))
    return times / weights, (0 if equal else 1) / weights


def mean_of(part: pd.DataFrame, measure: str) -> Mean | None:
    """Mean of a measure over the people of the rows `part`; None for too few of them."""
    values, variances = (table[""] for table in _people(part.assign(all=""), measure, "all"))
    known = np.isfinite(values)
    if known.sum() < _FEWEST:
        return None
    found = weighted_mean(np.asarray(values[known]), np.asarray(variances[known]))
    return found if found.people >= _LEAST else None


def in_order(names: Iterable[str], reference: str) -> list[str]:
    """Distinct names that are not empty; the reference comes first."""
    given = [name for name in dict.fromkeys(names) if name]
    first = [reference] if reference in given else [one for one in given if _USUAL.search(one)]
    return [*first[:1], *(name for name in given if name not in first[:1])]


def compare_cohort(
    units: pd.DataFrame, reference: str = "", inner: Collection[str] = ()
) -> tuple[Comparison, ...]:
    """All possible comparisons."""
    if len(units) == 0:
        return ()
    chosen, found = measures_of(units, inner), list[Comparison]()
    for label, part in units.groupby("condition", sort=True, dropna=False):
        visits = in_order(part["visit"], reference)
        groups = in_order(sorted(set(part["group"])), reference)
        several = groups if len(visits) > 1 else []
        for question, names in (("group", groups), ("change", several), ("visit", visits)):
            found += _all_pairs(part, Comparison(question, "", str(label)), names, chosen, visits)
        if len(visits) > 1:
            found += [_reliable(part, Comparison("reliability", name, str(label)))
                      for name in chosen]  # fmt: skip
    conditions = in_order(sorted(set(units["condition"])), reference)
    found += _all_pairs(units, Comparison("condition", "", ""), conditions, chosen, [])
    return tuple(found)


def _all_pairs(
    part: pd.DataFrame, asked: Comparison, names: list[str], chosen: Collection[str],
    visits: list[str],
) -> list[Comparison]:  # fmt: skip
    """Comparisons of all pairs of `names`, corrected for the number of measures."""
    found: list[Comparison] = []
    for first, second in itertools.combinations(names, 2):
        pair = [
            _tested(part, replace(asked, measure=one, first=first, second=second), visits)
            for one in chosen
        ]
        corrected = holm(np.array([item.p for item in pair]))
        found += [replace(item, p_holm=float(p)) for item, p in zip(pair, corrected, strict=True)]
    return found


def _tested(part: pd.DataFrame, asked: Comparison, visits: list[str]) -> Comparison:
    """t-test of the difference between two means, or of the mean difference of pairs."""
    pair = [asked.first, asked.second]
    if asked.question == "change":
        samples = _changes(part, asked, visits)
    else:
        values, variances = (
            table.reindex(columns=pair) for table in _people(part, asked.measure, asked.question)
        )
        if asked.question == "group":
            samples = [(values[name], variances[name]) for name in pair]
        else:
            both = (values[pair[1]] - values[pair[0]], variances.sum(axis=1, skipna=False))
            samples = [both]
    n = sum(int(variance.notna().sum()) for _, variance in samples)
    known = [
        (np.asarray(value[np.isfinite(value)]), np.asarray(variance[np.isfinite(value)]))
        for value, variance in samples
    ]
    if min(len(value) for value, _ in known) < _FEWEST:
        return replace(asked, n=n, note=f"too few subjects ({sum(len(v) for v, _ in known)})")
    means = [weighted_mean(*sample) for sample in known]
    if min(mean.people for mean in means) < _LEAST:
        return replace(asked, n=n, note="one subject counts for more than all others together")
    return _compared(replace(asked, n=n), means, [len(value) for value, _ in known])


def _compared(asked: Comparison, means: list[Mean], sizes: list[int]) -> Comparison:
    """Difference of two means, or a mean difference, with its test."""
    squares = np.array([mean.error**2 for mean in means])
    error, last = float(np.sqrt(squares.sum())), means[-1]
    if not error:
        return replace(asked, note="all subjects have the same value")
    each = np.array([mean.freedom for mean in means])
    freedom = float(squares.sum() ** 2 / np.sum(squares**2 / each))
    estimate = last.value - sum(mean.value for mean in means[:-1])
    reach = float(scipy.stats.t.ppf(0.975, freedom)) * error
    effect = last.value / last.spread
    if len(means) == 2:
        both = zip(means[::-1], sizes[::-1], strict=True)
        effect = effectsize_smd(*(one for mean, size in both
                                  for one in (mean.value, mean.spread, size)))[0]  # fmt: skip
    return replace(
        asked, estimate=estimate, low=estimate - reach, high=estimate + reach,
        between=float(np.sqrt(np.mean([mean.between for mean in means]))), effect=float(effect),
        p=2 * float(scipy.stats.t.sf(abs(estimate) / error, freedom)),
    )  # fmt: skip


def _changes(
    part: pd.DataFrame, asked: Comparison, visits: list[str]
) -> list[tuple[pd.Series[float], pd.Series[float]]]:
    """Change per visit (least-squares slope over visits) of each subject, by group."""
    values, variances = (
        table.reindex(columns=visits) for table in _people(part, asked.measure, "visit")
    )
    place = values.notna() * np.arange(float(len(visits)))
    place = place.where(values.notna()).sub(place.where(values.notna()).mean(axis=1), axis=0)
    weight = place.div((place**2).sum(axis=1).replace(0.0, np.nan), axis=0)
    slope = (weight * values).sum(axis=1, min_count=2)
    variance = (weight**2 * variances).sum(axis=1, min_count=2)
    group = part.groupby("subject")["group"].first()
    return [(slope[group == name], variance[group == name]) for name in (asked.first, asked.second)]


def _reliable(part: pd.DataFrame, asked: Comparison) -> Comparison:
    values, _ = _people(part, asked.measure, "visit")
    try:
        found = icc(values.to_numpy(), "A,1")
    except DataError:
        n = len(values.dropna())
        return replace(asked, n=n, note=f"too few subjects ({n})")
    return replace(asked, estimate=found.value, low=found.low, high=found.high, n=found.subjects)


def outlying(units: pd.DataFrame, measures: Collection[str]) -> pd.Series[float]:
    """Ratio of a gain of each unit to its group's median if it is far from 1, else NaN.

    Far is above 3, or below a third with an interval that excludes the median. Gains whose median
    is below twice the median of their standard errors are not looked at.
    """
    found = pd.Series(np.nan, units.index)
    for name in measures:
        if not name.startswith("K."):
            continue
        ends = interval_of(units, name)
        table = ends.assign(error=np.sqrt(_variances(units, name)))
        usual = table.groupby([units["condition"], units["group"]])
        median = usual["value"].transform("median")
        excluded = (ends["low"] > median) | (ends["high"] < median)
        ratio = ends["value"] / median
        far = (ratio > _FAR) | ((ratio < 1 / _FAR) & excluded)
        far &= median.abs() > 2 * usual["error"].transform("median")
        far &= usual["value"].transform("count") >= _FEWEST
        found = found.where(found.notna() | ~far, ratio)
    return found
