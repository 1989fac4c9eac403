"""Verdict of a cohort: which groups, visits or conditions differ, by how much, and warnings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

from impc.levels import Level
from impc.reporting.rules import Kind, Line, Rules, always
from impc.reporting.verdict import Claim
from impc.studies.cohort.results import SIGNIFICANT, Cohort
from impc.studies.cohort.unit_result import LOGARITHM

# Share of fits with a warning, or of missing fits, above which the report is amber.
_MANY = 0.1
# Share of people with a determined gain below which the report is amber.
_FEW = 0.7


def _warnings(cohort: Cohort) -> str:
    """The most frequent warnings with their numbers."""
    heads = cohort.with_warning["headline"]
    return " ".join(f"{head.rstrip('.')} ({count})."
                    for head, count in Counter(heads).most_common(3))  # fmt: skip


def _outliers(cohort: Cohort) -> str:
    """The fits to be looked at: "P03 (3.4 times)"."""
    far = cohort.units.assign(ratio=cohort.far).dropna(subset=["ratio"])
    return ", ".join(f"{row['subject']} ({row['ratio']:.2g} times)"
                     for row in far.to_dict("records")[:8])  # fmt: skip


def _differences(cohort: Cohort) -> list[Claim]:
    """The differences that are found; central weights are a convention."""
    lead = cohort.lead
    if lead is None or lead.p_holm > SIGNIFICANT:
        return []
    found = (one for one in cohort.tested if one.p_holm <= SIGNIFICANT)
    shown = [one for one in found if not one.measure.startswith("centre")][:6]
    return [
        Claim(cohort.sentence(one), f"{cohort.numbers(one)}.{cohort.without_outliers(one)}")
        for one in shown
    ]


def _none_found(cohort: Cohort) -> bool:
    return cohort.lead is not None and cohort.lead.p_holm > SIGNIFICANT


_WORDS: dict[str, Callable[[Any], object]] = {
    "of": lambda c: c,  # {of.warned}: a number of the cohort
    "fits": lambda c: len(c.units),
    "asked": lambda c: len(c.units) + len(c.failed),
    "failed": lambda c: len(c.failed),
    "reason": lambda c: next(iter(c.failed.values())),
    "warnings": _warnings,
    "without_warned": Cohort.without_warned,
    "outliers": _outliers,
    "without_outliers": lambda c: c.without_outliers(c.lead),
    "gain": lambda c: c.determined[0],
    "known": lambda c: c.determined[1],
    "all": lambda c: c.determined[2],
    "measure": lambda c: "cost weight" if c.measure.startswith(LOGARITHM) else "gain",
    "pair": lambda c: {"visit": "visits", "condition": "conditions"}.get(c.lead.question, "groups"),
    "sentence": lambda c: c.sentence(c.lead),
    "estimate": lambda c: c.sentence(c.lead)[:-1],
    "numbers": lambda c: c.numbers(c.lead),
    "result": lambda c: _RESULT.verdict(c).headline,
    "details": lambda c: _RESULT.verdict(c).sentence,
}
# Alerts of red and of amber reports.
_WARNED: dict[str, Any] = {
    "title": "{of.warned} of {fits} fits have a warning",
    "found": "{warnings}{without_warned}",
    "means": "The gains of these people may be biased by more than their intervals show; a bias "
    "that differs between groups looks like a difference between people.",
    "todo": (
        "Open the pages of these people; run impc fit for one and follow its warnings.",
        "Change the settings in the same way for all people, and run the study again.",
        "Report the difference with and without these people.",
    ),
}
_FAILED: dict[str, Any] = {
    "title": "{failed} of {asked} fits failed",
    "found": "First reason: {reason}.",
    "means": "The remaining people may differ from all people of the study.",
    "todo": (
        "Correct the recordings that are named under Subjects.",
        "Run the same command again: finished fits are kept.",
    ),
}
_NONE = (
    "No fit of this study can be used.",
    "{fits} of {asked} fits are complete; none may be reported.",
)
#: What was found, apart from warnings.
_RESULT: Rules[Cohort] = Rules(
    _WORDS,
    (
        Kind(
            Level.GREEN,
            lambda c: c.lead is None and any(one.measure[:2] == "K." for one in c.compared),
            "Gains are known well enough in too few people for a comparison.",
            "Each mean needs at least three people whose gains are known about equally well.",
        ),
        Kind(
            Level.GREEN, lambda c: c.lead is None, "Fitted people: {of.people}.",
            "There are too few people in two groups, or with two visits, for a comparison.",
        ),
        Kind(
            Level.GREEN, _none_found, "No difference in a {measure} between the {pair} was found.",
            "Estimate: {estimate} ({numbers}). This is not significant after correction for "
            "several tests. It does not show that they are equal.{without_outliers}",
        ),
        Kind(Level.GREEN, always, "{sentence}", "{numbers}.{without_outliers}"),
    ),
)  # fmt: skip
RULES: Rules[Cohort] = Rules(
    _WORDS,
    (
        Kind(Level.RED, lambda c: not len(c.usable) and len(c.units), *_NONE, **_WARNED),
        Kind(Level.RED, lambda c: not len(c.usable) and c.failed, *_NONE, **_FAILED),
        Kind(Level.AMBER, lambda c: c.warned > _MANY * len(c.units), "{result}", "{details}",
             **_WARNED),
        Kind(
            Level.AMBER, lambda c: c.outliers, "{result}", "{details}",
            "{of.outliers} of {fits} fits are far from the others of their group",
            "Subjects, and a gain relative to their group's median: {outliers}.",
            "A gain above three times, or below a third, of the median is more often a wrong fit "
            "than an unusual person. One such fit can move the mean of a group.",
            ("Look at these people under Subjects and at their recordings.",
             "Report the difference with and without them."),
        ),
        Kind(
            Level.AMBER, lambda c: c.determined[1] < _FEW * c.determined[2],
            "{result}", "{details}",
            "The {gain} is determined in only {known} of {all} people",
            "In the others the 95 % interval is wider than the gain itself, or a change of other "
            "gains makes up for one of this gain.",
            "All people count, each by how well their gain is known: the means rest mostly on few "
            "people, and only large differences are found.",
            ("Record more or longer trials, or use a stronger perturbation; impc plan shows how "
             "many.",
             "Set [fit.structure]: a few cost weights need less data than ten gains."),
        ),
        Kind(Level.AMBER, lambda c: len(c.failed) > _MANY * (len(c.units) + len(c.failed)),
             "{result}", "{details}", **_FAILED),
        Kind(Level.GREEN, always, "{result}", "{details}"),
    ),
    may=(
        Line(_none_found, "That no difference was found, with the interval above."),
        _differences,
    ),
    may_not=(
        Line(lambda c: c.lead, "That groups or visits are equal if no difference was found.",
             "The interval of a difference shows how large it may be."),
        Line(lambda c: c.lead and "structure_refused" not in c.units.columns,
             "What the groups try to minimise.",
             "Many weights lead to the same gain. Set [fit.structure] to compare weights."),
        Line(lambda c: c.lead and c.determined[1] < c.determined[2],
             "The {gain} of a single person, except in {known} of {all}.", "It is not determined."),
        Line(lambda c: c.lead and c.warned, "Gains of single people whose fit has a warning.",
             "See Subjects."),
    ),
)  # fmt: skip
