"""What a fit can and cannot tell, as tables and sentences of its page."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.assess.intervals import entry_names
from impc.assess.other_models import verdict
from impc.model.signal_units import UNKNOWN, gain_unit
from impc.reporting.document import TextTable, table_of
from impc.reporting.rendering import number

if TYPE_CHECKING:
    from impc.assess.all_intervals import Certainty
    from impc.assess.intent_statements import Statement
    from impc.assess.intervals import Interval
    from impc.assess.weights_ranges import WeightsSummary
    from impc.model.plant import Plant
    from impc.studies.fit.result import FitResult

_METHODS = {
    "sandwich": "colour of the residuals",
    "cramer-rao": "as if they were white",
    "block": "block bootstrap",
    "model": "model bootstrap",
    "profile": "profile likelihood",
}
_NO_ENDS = "not determined"


def intervals_table(result: FitResult) -> TextTable:
    """Intervals of every number, a column for each method, beside the gain of the weights."""
    certainty, plant = result.certainty, result.fitted.problem.plant
    of_weights = dict(zip(entry_names(plant), np.ravel(result.fitted.gain), strict=True))
    methods = [key for key in _METHODS if any(item.method == key for item in certainty.intervals)]
    found = {(item.name, item.method): item for item in certainty.intervals}
    names = list(dict.fromkeys(item.name for item in certainty.intervals))
    rows, units = [], number_units(plant)
    for name in names:
        known = [found[name, method] for method in methods if (name, method) in found]
        value = known[0].value
        cells = []
        for method in methods:
            item = found.get((name, method))
            cells.append("-" if item is None else _told(item))
        shown = "not determined" if value is None else number(value, 4)
        theirs = number(float(of_weights[name]), 4) if name in of_weights else "-"
        rows.append((number_name(plant, name), units.get(name, UNKNOWN), shown, *cells, theirs))
    level = certainty.intervals[0].level
    caption = (
        f"What the recordings tell, with intervals of {100 * level:.0f} %. Where residuals are "
        "coloured, as those of people are, the second column is too narrow. An entry that is not "
        "told takes part in directions that hardly show in the recordings: within the range in "
        "brackets it cannot be told from others, and the table of directions says which "
        "combinations are. The last column is the gain of the reported weights. A rule chose "
        "them, so it has no interval of its own: outside the estimate's, these weights do not "
        "quite behave as the recordings do."
    )
    shown_methods = [_METHODS[method] for method in methods]
    heads = ("number", "unit", "value", *shown_methods, "gain of the weights")
    return TextTable(caption, heads, rows)


def number_name(plant: Plant, name: str) -> str:
    """What a reader calls a number of a fit by its `name` in files, such as K.command.theta1."""
    kind, _, rest = name.partition(".")
    if name not in number_units(plant):
        return name
    if kind == "u_max":
        return f"limit of {rest}"
    control = next(one for one in plant.controls if rest.startswith(f"{one}."))
    state = rest.removeprefix(f"{control}.")
    return f"gain of {state}" if plant.m == 1 else f"gain of {state} to {control}"


def number_units(plant: Plant) -> dict[str, str]:
    """Units of the numbers of a fit by their names: K.<control>.<state>, u_max.<control>."""
    return {
        f"K.{control}.{state}": gain_unit(plant, control, state)
        for control in plant.controls
        for state in plant.states
    } | {f"u_max.{control}": plant.unit(control) for control in plant.controls}


def set_sentences(summary: WeightsSummary) -> tuple[str, ...]:
    """What the set of weights is, and what becomes of the dominant direction over it."""
    kept = "survives" if summary.widest_angle < 10 else "does not survive"
    return (
        f"The recordings give the gain. Weights with exactly that gain form a convex set of "
        f"{summary.dimension} dimensions, all with the same behaviour; the ranges below are over "
        f"its members with a condition number up to {summary.limit:.2g}, ten times the least.",
        f"The dominant direction {kept} over the set: it turns by up to "
        f"{summary.widest_angle:.0f} degrees (found by search; more may be possible).",
        *_over_drawn(summary),
        "The condition number depends on the units of the states, and so does the member that it "
        "chooses. The analytic centre does not.",
    )


def _over_drawn(summary: WeightsSummary) -> tuple[str, ...]:
    if not summary.drawn:
        return ()
    return (
        f"The gain is an estimate too: over {summary.drawn} others that the recordings allow the "
        f"dominant direction of the weights of least condition number turns by up to "
        f"{summary.angle_of_gain:.0f} degrees (95 %).",
    )


def statements_table(summary: WeightsSummary) -> TextTable:
    """Statements that hold for every member, and those that members disagree on."""
    tried = (
        f"The gain is an estimate: each statement was tried on {summary.drawn} other gains that "
        "the recordings allow. One that holds for all weights of all gains but one at most may be "
        "made of the subject, at 95 %."
        if summary.drawn
        else "The gain is an estimate, and other gains were not tried ([fit] intent_draws): none "
        "may be made of the subject."
    )
    return table_of(
        "Statements on the states that are recorded or cost most, at the size that they have in "
        f"the recordings. {tried} The range is that of the difference, or of the mixed price, over "
        "the price of the state named first, at the fitted gain.",
        sorted(summary.statements, key=lambda item: (not item.made, item.holds is None)),
        {
            "statement": lambda item: item.says,
            "at 95 %": _verdict,
            "other gains that agree": _over_gains,
            "range at the fitted gain": lambda item: f"{item.low:.3g} to {item.high:.3g}",
        },
    )


def prices_table(summary: WeightsSummary) -> TextTable | None:
    """Prices of the named states, for the fitted gain and for all that the recordings allow."""
    if not summary.prices:
        return None
    return table_of(
        "What a typical excursion costs, d^2 Q at trace R = m, over all weights: with the fitted "
        f"gain, and with it or any of {summary.drawn} others that the recordings allow (95 %).",
        summary.prices,
        {
            "state": lambda item: item.state,
            "fitted gain": lambda item: f"{number(item.low)} to {number(item.high)}",
            "95 % interval": lambda item: f"{number(item.low_drawn)} to {number(item.high_drawn)}",
        },
    )


def entries_table(summary: WeightsSummary) -> TextTable:
    """Ranges of entries of Q."""
    return table_of(
        "Range of entries of Q over the set, at trace R = m, by semidefinite programs.",
        summary.entries,
        {
            "entry": lambda item: f"Q {item.first}, {item.second}",
            "least": lambda item: number(item.low),
            "most": lambda item: number(item.high),
        },
    )


def limit_sentences(certainty: Certainty) -> tuple[str, ...]:
    """What the recordings say of the input limit."""
    return tuple(
        item.reason[0].upper()
        + item.reason[1:]
        + f" (distance of no limit {item.against_none:.1f}, threshold {item.quantile:.1f}; "
        + f"interval {_range(item.low, item.high)})."
        for item in certainty.limits
    )


def alternatives_table(certainty: Certainty) -> TextTable | None:
    """The fit beside other horizons and no limit."""
    if not certainty.alternatives:
        return None
    first = certainty.alternatives[0]
    return table_of(
        "The same recordings with other horizons and without limit. AIC is above the least, for "
        "the innovations of the residuals; VAF is of trials left out.",
        certainty.alternatives,
        {
            "fit": lambda item: item.name,
            "horizon": lambda item: str(item.horizon),
            "AIC above the least": lambda item: number(item.aic),
            "left out VAF %": lambda item: number(item.held_out, 5),
            "the recordings say": lambda item: "" if item is first else verdict(first, item),
        },
    )


def _verdict(item: Statement) -> str:
    if not item.made:
        return "not made"
    return "true for all" if item.holds else "false for all"


def _told(item: Interval) -> str:
    ends = _range(item.low, item.high)
    return ends if item.told or ends == _NO_ENDS else f"not identified ({ends})"


def _over_gains(item: Statement) -> str:
    if item.holds is None:
        return "weights of the fitted gain disagree"
    return "not tried" if item.confidence is None else f"{100 * item.confidence:.0f} %"


def _range(low: float, high: float) -> str:
    if low == -float("inf") and high == float("inf"):
        return _NO_ENDS
    left = "no end" if low == -float("inf") else number(low, 4)
    right = "no end" if high == float("inf") else number(high, 4)
    return f"{left} to {right}"
