"""Comparison of groups, visits and conditions of a cohort, measure by measure.

A mean over people is that of a random-effects meta-analysis: each person counts by the inverse of
the variance of the estimate plus the variance between people, after DerSimonian and Laird (Paule
and Mandel's variance grows with few uncertain gains that are far off). Its standard error takes
these shares p (of sum 1) as given, and the variances from the values y and mean m:

    SE^2 = sum a (y - m)^2,    df = 1 / (sum p^2 + (sum a)^2 - sum a^2),    a = p^2 / (1 - p)

(HC2 with Satterthwaite's degrees of freedom, Bell and McCaffrey 2002), but not below the error that
the fits leave to a common value, (sum 1 / variance)^-1/2. With equal shares, as for measures
without a standard error, the tests are Welch's and Student's. Hartung and Knapp's error is
not used: a gain that the recordings do not determine stays near the start of the search, so that it
deviates less than its variance says. In simulated groups of 5 to 20 people with a third of such
fits their 95 % interval covers 85 to 92 %, this one 94 to 97 % (test_comparison.py).

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
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd
import scipy

from impc.arrays import Array
from impc.assess.covariance import TWO_SIDED
from impc.assess.several_tests import holm
from impc.checking import replace
from impc.errors import DataError
from impc.studies.reliability.icc import icc

_FEWEST = 3  # People in each mean
_LEAST = 2.0  # People of equal shares to whom a mean must correspond, 1 / sum p^2
_KNOWN = 1e9  # Degrees of freedom of a standard error that the fits state
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


class Mean(NamedTuple):
    """Weighted mean over people."""

    n: int  # Number of people
    value: float = np.nan
    error: float = np.nan  # Standard error
    freedom: float = np.nan  # Degrees of freedom of the error
    between: float = np.nan  # Variance between people
    spread: float = np.nan  # SD of the values
    people: float = np.nan  # Number of people of equal shares to whom it corresponds

    @property
    def lacks(self) -> str:
        """Reason why nothing is said about it; empty if there is none."""
        if self.n < _FEWEST:
            return f"too few subjects ({self.n})"
        few = self.people < _LEAST
        return "one subject counts for more than all others together" if few else ""

    @property
    def ends(self) -> Array:
        """The lower end of the 95 % interval, the mean, and the upper end."""
        reach = scipy.stats.t.ppf(0.975, self.freedom) * self.error
        return np.asarray(self.value + reach * np.array([-1.0, 0.0, 1.0]))


def weighted_mean(given: pd.Series[float], squares: pd.Series[float]) -> Mean:
    """Mean of values of people, except NaN; `squares` of their errors, zeros for equal shares."""
    from statsmodels.stats.meta_analysis import combine_effects  # noqa: PLC0415  # a second

    known = np.isfinite(given)
    values, variances = np.asarray(given[known]), np.asarray(squares[known])
    n = len(values)
    if n < _FEWEST:
        return Mean(n)
    shares, between = np.full(n, 1 / n), float(np.var(values, ddof=1))
    with np.errstate(divide="ignore", invalid="ignore"):  # equal values have no heterogeneity
        if variances.any():
            found = combine_effects(values, variances.clip(1e-12 * variances.max()), "dl")
            between = max(float(found.tau2), 0.0)
            shares = np.asarray(found.weights_rel_re if between else found.weights_rel_fe)
        mean, of_squares = float(shares @ values), float(shares @ shares)
        a, apart = shares**2 / (1 - shares), (values - mean) ** 2
        freedom = float(1 / (of_squares + a.sum() ** 2 - a @ a))
        spread = float(np.sqrt(shares @ apart / (1 - of_squares)))
        error = float(np.sqrt(a @ apart))
        least = float(np.sum(1 / variances) ** -0.5) if variances.any() else 0.0
    if error < least:
        error, freedom = least, _KNOWN
    return Mean(n, mean, error, freedom, between, spread, 1 / of_squares)


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
    rows = part[["subject", along]].assign(weight=weight, times=weight * part[measure])
    sums = rows.dropna(subset=["times"]).groupby(["subject", along])[["weight", "times"]].sum()
    weights, times = (sums[name].unstack(along) for name in ("weight", "times"))
    return times / weights, (0 if equal else 1) / weights


def mean_of(part: pd.DataFrame, measure: str) -> Mean:
    """Mean of a measure over the people of the rows `part`."""
    values, variances = _people(part.assign(all="all"), measure, "all")
    return weighted_mean(values["all"], variances["all"]) if len(values) else Mean(0)


def in_order(names: Iterable[str], reference: str) -> list[str]:
    """Distinct names that are not empty; the reference comes first."""
    given = [name for name in dict.fromkeys(names) if name]
    first = [reference] if reference in given else [one for one in given if _USUAL.search(one)]
    return [*first[:1], *(name for name in given if name not in first[:1])]


def compare_cohort(
    units: pd.DataFrame, measures: Collection[str], reference: str = ""
) -> tuple[Comparison, ...]:
    """All possible comparisons, with p-values corrected over the measures of each question."""
    if len(units) == 0:
        return ()
    found = list[Comparison]()

    def ask(question: str, condition: str, names: Iterable[str]) -> None:
        for pair in itertools.combinations(in_order(names, reference), 2):
            asked = (Comparison(question, name, condition, *pair) for name in measures)
            tests = [difference_of(units, one, reference) for one in asked]
            corrected = holm(np.array([item.p for item in tests])).tolist()
            found.extend(map(lambda one, p: replace(one, p_holm=p), tests, corrected))

    for condition, part in units.groupby("condition"):
        name, groups, visits = str(condition), sorted(set(part["group"])), part["visit"]
        several = visits.nunique() > 1
        ask("group", name, groups)
        ask("change", name, groups if several else ())
        ask("visit", name, visits)
        if several:
            found += [_reliable(part, Comparison("reliability", one, name)) for one in measures]
    ask("condition", "", sorted(set(units["condition"])))
    return tuple(found)


def difference_of(units: pd.DataFrame, asked: Comparison, reference: str) -> Comparison:
    """A comparison as `asked`, in the table `units`."""
    pair, along = [asked.first, asked.second], asked.question
    part = units if along == "condition" else units[units["condition"] == asked.condition]
    if along == "change":
        values, variances = _changes(part, asked.measure, reference)
    else:
        values, variances = _people(part, asked.measure, along)
    values, variances = values.reindex(columns=pair), variances.reindex(columns=pair)
    samples = [(values[name], variances[name]) for name in pair]
    if along in ("visit", "condition"):
        samples = [(values[pair[1]] - values[pair[0]], variances.sum(axis=1, skipna=False))]
    asked = replace(asked, n=sum(int(variance.notna().sum()) for _, variance in samples))
    return t_test(asked, [weighted_mean(*sample) for sample in samples])


def t_test(asked: Comparison, means: Sequence[Mean]) -> Comparison:
    """t-test of the difference between two means (the second minus the first), or of one mean."""
    from statsmodels.stats.meta_analysis import effectsize_smd  # noqa: PLC0415  # a second

    squares = np.array([mean.error**2 for mean in means])
    notes = [mean.lacks for mean in means if mean.lacks]
    if notes or not squares.any():
        return replace(asked, note=(*notes, "all subjects have the same value")[0])
    each, error = np.array([mean.freedom for mean in means]), float(np.sqrt(squares.sum()))
    freedom = float(squares.sum() ** 2 / np.sum(squares**2 / each))
    estimate, effect = means[0].value, means[0].value / means[0].spread
    if len(means) == 2:
        first, second = means
        estimate = second.value - first.value
        effect, _ = effectsize_smd(second.value, second.spread, second.n,
                                   first.value, first.spread, first.n)  # fmt: skip
    reach = float(scipy.stats.t.ppf(0.975, freedom)) * error
    return replace(
        asked, estimate=estimate, low=estimate - reach, high=estimate + reach,
        between=float(np.sqrt(np.mean([mean.between for mean in means]))), effect=float(effect),
        p=2 * float(scipy.stats.t.sf(abs(estimate) / error, freedom)),
    )  # fmt: skip


def _changes(part: pd.DataFrame, measure: str, reference: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Change per visit (least-squares slope over visits) of each subject, by group."""
    visits = in_order(part["visit"], reference)
    values, variances = (table[visits] for table in _people(part, measure, "visit"))
    place = (values.notna() * np.arange(len(visits))).where(values.notna())
    place = place.sub(place.mean(axis=1), axis=0)
    weight = place.div((place**2).sum(axis=1), axis=0)
    found = pd.DataFrame({
        "value": (weight * values).sum(axis=1, min_count=2),
        "variance": (weight**2 * variances).sum(axis=1, min_count=2),
    })  # fmt: skip
    found = found.join(part.groupby("subject")["group"].first()).set_index("group", append=True)
    return found["value"].unstack("group"), found["variance"].unstack("group")


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
