"""What a fit says of the weights: statements, weights, readings by rules, entries with ranges."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from impc.reporting.finding import Chart, Finding, Picture, table_of
from impc.studies.charts import weights_chart
from impc.studies.fit.interval_figures import shown_statements
from impc.studies.fit.verdict import direction_name
from impc.studies.methods_table import weight_entries

if TYPE_CHECKING:
    from impc.assess.intent_statements import Statement
    from impc.assess.weights_ranges import WeightsSummary
    from impc.studies.fit.result import FitResult

_STATEMENTS = Picture(
    "statements",
    "Statements on what costs more, each with its range over all weights with this gain",
    "A statement holds for all weights with this gain where its bar stays on one side of zero. "
    "In colour and bold: it may be made of the subject, at 95 %.",
    narrow=True,
)
_READINGS = Picture(
    "intent",
    "Eigenvalues of Q, and shares of the states in the dominant cost, for every rule",
    "Left: eigenvalues of Q. Right: share of each state in the dominant cost at the size that the "
    "states have in the recordings.",
)


def statement_findings(result: FitResult) -> list[Finding]:
    """Statements that hold for every weight with the gain, and the cost weights of the states."""
    summary = result.uncertainty.weights
    if summary is None:
        said = [f"Not available: {result.uncertainty.weights_reason}"]
        return [Finding("statements", sentences=said)]
    figure = _STATEMENTS if shown_statements(result) else None
    return [replace(statement_finding(summary), figure=figure), *weight_interval_findings(summary)]


def statement_finding(summary: WeightsSummary) -> Finding:
    """Statements that hold for every weight with the gain, and those on which weights disagree."""
    table = table_of(
        sorted(summary.statements, key=lambda item: (not item.made, item.holds is None)),
        {
            "statement": lambda item: item.says,
            "verdict": _verdict,
            "other_gains_that_agree_percent": lambda item: (
                np.nan if item.confidence is None else 100 * float(item.confidence)
            ),
            "low": lambda item: float(item.low),
            "high": lambda item: float(item.high),
        },
    )
    folded = "Every statement with its range"
    return Finding("statements", table, _tried(summary), folded=folded)


def weight_interval_findings(summary: WeightsSummary) -> list[Finding]:
    """Cost weights of the named states; without drawn gains there are none."""
    if not summary.cost_weights:
        return []
    table = table_of(
        summary.cost_weights,
        {
            "state": lambda item: item.state,
            "low_fitted_gain": lambda item: float(item.low),
            "high_fitted_gain": lambda item: float(item.high),
            "low": lambda item: float(item.low_drawn),
            "high": lambda item: float(item.high_drawn),
        },
    )
    caption = (
        "What a typical excursion costs, d^2 Q at trace R = m, over all weights: with the fitted "
        f"gain, and (95 %) with it or any of {summary.drawn} others that the recordings allow."
    )
    return [Finding("cost_weights", table, caption, folded="Every cost weight with its range")]


def _tried(summary: WeightsSummary) -> str:
    tried = (
        f"The gain is an estimate: each statement was tried on {summary.drawn} other gains that "
        "the recordings allow. One that holds for all weights of all gains but one at most may be "
        "made of the subject, at 95 %."
        if summary.drawn
        else "The gain is an estimate, and other gains were not tried ([fit] intent_draws): none "
        "may be made of the subject."
    )
    return (
        "Statements on the states that are recorded or cost most, at the size that they have in "
        f"the recordings. {tried} Low and high are those of the difference, or of the mixed cost "
        "weight, over the cost weight of the state named first, at the fitted gain."
    )


def _verdict(item: Statement) -> str:
    if item.holds is None:
        return "weights of the fitted gain disagree"
    if not item.made:
        return "not made"
    return "true for all" if item.holds else "false for all"


def reading_finding(result: FitResult) -> Finding:
    """Weights with the fitted gain by several rules."""
    problem, found = result.fitted.problem, result.intent
    summary = result.uncertainty.weights
    table = table_of(
        found.readings,
        {
            "rule": lambda item: item.rule,
            "largest_eigenvalue": lambda item: float(item.eigenvalues[-1]),
            "dominant_direction": lambda item: direction_name(item.dominant, problem.plant.states),
            "turned_by_degrees": lambda item: float(item.angle),
            "condition_number": lambda item: float(item.condition),
        },
    )
    return Finding(
        "readings",
        table,
        "Weights with exactly the same gain, so with the same behaviour, by several rules.",
        [
            *(f"Not available: {line}" for line in found.missing),
            *(set_sentences(summary) if summary else []),
        ],
        Chart(_READINGS, weights_chart(problem, found)),
        digits=3,
    )


def set_sentences(summary: WeightsSummary) -> list[str]:
    """What the set of weights is, and what becomes of the dominant direction over it."""
    kept = "survives" if summary.widest_angle < 10 else "does not survive"
    drawn = (
        f"The gain is an estimate too: over {summary.drawn} others that the recordings allow the "
        f"dominant direction of the weights of least condition number turns by up to "
        f"{summary.angle_of_gain:.0f} degrees (95 %)."
    )
    return [
        f"The recordings give the gain. Weights with exactly that gain form a convex set of "
        f"{summary.dimension} dimensions, all with the same behaviour; the ranges below are over "
        f"its members with a condition number up to {summary.limit:.2g}, ten times the least.",
        f"The dominant direction {kept} over the set: it turns by up to "
        f"{summary.widest_angle:.0f} degrees (found by search; more may be possible).",
        *([drawn] if summary.drawn else []),
        "The condition number depends on the units of the states, and so does the member that it "
        "chooses. The analytic centre does not.",
    ]


def weight_finding(result: FitResult) -> Finding:
    """Entries of the reported weights, with their ranges where they were computed."""
    plant, weights = result.given.plant, result.intent.reported.weights
    summary = result.uncertainty.weights
    # At trace R = m: with one command the scale of the entries.
    ranged = summary.entries if summary is not None and plant.m == 1 else ()
    ranges = {frozenset((item.first, item.second)): (item.low, item.high) for item in ranged}
    none = (np.nan, np.nan)
    rows = [
        (*entry, *(ranges.get(frozenset(entry[1:3]), none) if entry[0] == "Q" else none))
        for entry in weight_entries(plant, weights)
    ]
    heads = ["matrix", "first", "second", "unit", "value", "low", "high"]
    table = pd.DataFrame(rows, columns=heads)
    return Finding(
        "weights",
        table,
        "The reported weights, at R = 1 of the first command. Low and high: over all weights with "
        "this gain, for the states that are recorded or cost most.",
        folded="The reported weights, and ranges of their entries",
    )
