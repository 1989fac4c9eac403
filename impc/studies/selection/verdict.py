"""Verdicts of `impc select` and `impc key-parameters`.

A parameter counts as estimated if its 95 % interval is inside the search range in every fit. It
counts as repeatable if the 95 % interval of its ICC begins at `GOOD` or above, as in `impc
reliability`.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from impc.assess.covariance import TWO_SIDED
from impc.levels import Level
from impc.reporting.rendering import number
from impc.reporting.rules import Kind, Line, Rules, always
from impc.studies.reliability.icc import GOOD
from impc.studies.selection.analysis import KeyParameters, StudySelection
from impc.studies.selection.model import ParametricModel

if TYPE_CHECKING:
    import pandas as pd

_POOR = 50.0  # VAF of a poor model, %
#: Column of the bias by fixing parameters, and end of a note on an estimate.
BIAS, STUCK = "bias_percent_of_the_range", "; estimate at a limit"


class SelectFacts:
    """Phrases and numbers shared by verdict, checks and the text for a paper."""

    def __init__(self, model: ParametricModel, found: StudySelection, table: pd.DataFrame) -> None:
        chosen, reaching = found.chosen.values(), table[table["note"] != ""]
        opened = [index for index in found.free if model.names[index] in set(reaching["symbol"])]
        rest = [index for index in found.free if index not in opened]
        of_open = table["symbol"].isin(model.named(opened)).sum()
        stuck = Counter(reaching.loc[reaching["note"].str.endswith(STUCK), "parameter"])
        self.size, self.estimated, self.fixed = model.size, len(rest), model.size - len(found.free)
        self.names, self.open_names = model.words(rest), model.words(opened)
        self.reached = f"{len(reaching)} of {of_open} intervals of {self.open_names}"
        self.stuck = ", ".join(f"{name} in {n} of {len(chosen)} fits" for name, n in stuck.items())
        which = "the fixed one is" if self.fixed == 1 else f"the {self.fixed} fixed ones are"
        self.condition = f", if {which} as assumed" if self.fixed else ""
        # Of the estimated parameters, or of all
        shown = table[table["symbol"].isin(model.named(rest or found.free))]
        self.worst = shown.sort_values(BIAS).to_dict("records")[-1]
        wrong = f"up to {number(self.worst[BIAS])} % of its search range"
        if self.worst[BIAS] >= 100:
            wrong = "more than its whole search range, and is not usable"
        self.shift = f"{self.worst['parameter']} may be wrong by {wrong}"
        # Whether all variances with the prior stay within the bound
        self.kept = all(np.all(one.known.variance <= found.bound) for one in chosen)
        self.kept |= not self.fixed
        every = float(np.mean([np.mean(one.fit.vaf) for one in found.nominal.values()]))
        least = float(np.mean([np.mean(one.refit.vaf) for one in chosen]))
        self.vaf = f"{number(every)} % with all parameters, {number(least)} % with the chosen ones"
        self.poor = every < _POOR


_ESTIMATED = Kind[SelectFacts](
    Level.GREEN, always, "{estimated} of {size} parameters can be estimated{condition}.",
    "The recordings determine {names} in every person and visit.",
)  # fmt: skip
_REACHED = replace(
    _ESTIMATED, level=Level.AMBER, when=lambda it: it.open_names,
    title="Some intervals end at the search range", found="{reached} end at the search range.",
    means="The recordings do not determine these parameters in every person and visit.",
    todo=("Do not report {open_names}.",
          "Use a richer movement of the target, more trials, or a wider search range."),
)  # fmt: skip
SELECT_RULES = Rules[SelectFacts](
    {},
    kinds=(
        Kind(
            Level.RED, lambda it: it.poor, "The model explains less than half of this movement.",
            "Do not interpret its parameters.",
        ),
        replace(
            _REACHED, level=Level.RED, when=lambda it: not it.estimated,
            headline="None of {size} parameters can be estimated.",
            sentence="No parameter has all its 95 % intervals inside the search range.",
        ),
        _REACHED,
        replace(
            _ESTIMATED, level=Level.AMBER, when=lambda it: not it.kept,
            title="The estimates depend on parameters that were fixed",
            found="If the fixed parameters are wrong by one SD between people, {shift}.",
            means="If a person differs from the assumed values, the estimates are biased. The "
            "intervals on this page include this error; intervals for exactly known values do not.",
            todo=("Report the assumed values, and the intervals on this page.",
                  "Measure fixed parameters in another experiment, or use a richer movement of the "
                  "target."),
        ),
        _ESTIMATED,
    ),
    may=(
        Line(lambda it: it.estimated and not it.poor, "Can be estimated: {names}.",
             "Report the estimates with the intervals on this page and the assumed values."),
    ),
    may_not=(
        Line(lambda it: it.open_names, "Values of {open_names}.",
             "Their 95 % intervals end at the search range."),
        Line(lambda it: it.fixed, "The fixed parameters.",
             "Their values are assumed, not estimated."),
        Line(lambda it: not it.kept, "Differences between people.",
             "Because of the fixed parameters, {shift}."),
        Line(always, "That other parameters have no effect.",
             "The recordings cannot separate them."),
    ),
)  # fmt: skip


class KeyFacts:
    """Phrases and numbers shared by verdict, text and key numbers."""

    def __init__(self, model: ParametricModel, found: KeyParameters) -> None:
        subsets, tried = found.selection, found.candidates
        explained = [item for item in tried if item.explained]
        best = max(explained or tried, key=lambda one: (one.kept, one.certain), default=None)
        self.size, self.keys, self.names = model.size, len(found.chosen), model.words(found.chosen)
        self.fixed, (self.people, self.visits) = self.size - self.keys, found.nominal.shape[1:]
        self.explained = len(explained)
        # Whether the ICC of a subset is high enough, but perhaps not its interval
        self.hopeful = any(item.reliability >= GOOD for item in explained)
        self.least, self.begins, self.icc = "-", "", "no ICC could be computed"
        if best is not None and np.isfinite(best.reliability):
            self.least = number(best.reliability, 3)
            self.begins = f"95 % intervals begin at {number(best.certain, 2)} or above"
            self.icc = f"ICC of at least {self.least}, {self.begins}"
        width = 100 * TWO_SIDED * math.sqrt(subsets.bound)
        known = f"known to within {number(width, 2)} % of the search range"
        if width >= 100:
            known = "known, but perhaps no better than the search range"
        kind = {2: "pairs", 3: "triples"}.get(subsets.size, f"sets of {subsets.size} parameters")
        self.filters = (
            f"Parameters {known}, in every person and visit: {len(subsets.subsets)} {kind}. "
            f"Fitted: {len(tried)}; these explain the movement: {len(explained)}; these are also "
            f"repeatable between visits: {sum(item.kept for item in tried)}."
        )


_NONE = Kind[KeyFacts](
    Level.AMBER, lambda it: not it.explained,
    "No parameters can be estimated together and explain these movements.",
    "Report no parameter of this model as repeatable.",
    title="No subset passes the first filters", found="{filters}",
    means="The recordings do not determine the parameters, or these people differ too much from "
    "the fixed ones.",
    todo=("Check the model, its fixed values and the units of the recordings.",
          "Use a richer movement of the target, or more trials."),
)  # fmt: skip
_MORE_PEOPLE = "Measure more people, or the same people at more visits."
KEY_RULES = Rules[KeyFacts](
    {},
    kinds=(
        _NONE,
        replace(
            _NONE, when=lambda it: it.explained and not it.keys and it.hopeful,
            headline="{people} people and {visits} visits do not show whether a parameter is "
            "repeatable.",
            badge="Undecided", title="The intervals of the ICC are too wide",
            found="Best subset: {icc}. {filters}",
            means="In few people or visits, a high ICC may be due to chance.",
            todo=(_MORE_PEOPLE,),
        ),
        replace(
            _NONE, when=lambda it: it.explained and not it.keys and not it.hopeful,
            headline="No subset of parameters is shown to be repeatable between visits.",
            title="No ICC is high enough", found="Best subset: {icc}. {filters}",
            means="The order of the people may differ at the next visit.",
            todo=(_MORE_PEOPLE, "Average over more trials."),
        ),
        Kind(
            Level.AMBER, lambda it: it.keys and it.fixed,
            "{keys} of {size} parameters are key parameters, if the others are as assumed.",
            "They are {names}.", title="The other parameters were assumed",
            found="{fixed} of {size} parameters were fixed at assumed values.",
            means="If a person differs from these values, the estimates are biased. No interval on "
            "this page includes this error.",
            todo=("Report the assumed values with the estimates.",
                  "Run impc select: its intervals include this error."),
        ),
        Kind(Level.GREEN, always, "{keys} of {size} parameters are key parameters.",
             "They are {names}."),
    ),
    may=(Line(lambda it: it.keys, "As key parameters: {names}.", "{filters}"),),
    may_not=(
        Line(lambda it: not it.keys, "A parameter as repeatable.", "{filters}"),
        Line(lambda it: it.keys and it.fixed,
             "The other parameters, or estimates without the assumed values.",
             "The other values were assumed."),
    ),
)  # fmt: skip
