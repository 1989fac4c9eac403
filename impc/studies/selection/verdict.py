"""Verdicts of `impc select` and `impc key-parameters`.

A parameter counts as estimated if its 95 % interval is inside the search range in every fit. It
counts as repeatable if the 95 % interval of its ICC begins at `GOOD` or above, as in `impc
reliability`.
"""

from __future__ import annotations

from dataclasses import replace
from operator import attrgetter
from typing import NamedTuple

from impc.reporting.finding import Level
from impc.reporting.rules import Kind, Line, Rules, always


class SelectFacts(NamedTuple):
    """Phrases and numbers shared by verdict, checks and the text for a paper."""

    size: int  # Number of parameters of the model
    estimated: int  # Number of estimated parameters
    names: str  # Their names
    open_names: str  # Other parameters of the subset; empty if there are none
    reached: str  # How many of their intervals end at the search range
    fixed: int  # Number of fixed parameters
    shift: str  # Largest bias by fixing them
    kept: bool  # Whether all variances with the prior stay within the bound
    stuck: str  # Estimates at a limit of the search; empty if there are none
    vaf: str  # VAF in words
    poor: bool  # Whether the model explains less than half

    @property
    def condition(self) -> str:
        """Condition of the headline; empty if no parameter is fixed."""
        which = "the fixed one is" if self.fixed == 1 else f"the {self.fixed} fixed ones are"
        return f", if {which} as assumed" if self.fixed else ""


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
    {name: attrgetter(name) for name in (*SelectFacts._fields, "condition")},
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
        Line(lambda it: it.estimated and not it.poor, "Can be estimated together: {names}.",
             "Report the estimates with the intervals on this page and the assumed values."),
    ),
    may_not=(
        Line(lambda it: it.open_names, "Values of {open_names}.",
             "{reached} end at the search range."),
        Line(lambda it: it.fixed, "The fixed parameters.",
             "Their values are assumed, not estimated."),
        Line(lambda it: not it.kept, "Differences between people.",
             "Because of the fixed parameters, {shift}."),
        Line(always, "That other parameters have no effect.",
             "The recordings cannot separate them."),
    ),
)  # fmt: skip


class KeyFacts(NamedTuple):
    """Phrases and numbers shared by verdict, text and key numbers."""

    size: int  # Number of parameters of the model
    keys: int  # Number of key parameters
    names: str  # Their names
    fixed: int  # Number of the other parameters
    people: int
    visits: int
    filters: str  # How many subsets pass each filter
    icc: str  # Lowest ICC of the best subset, and where the intervals begin
    least: str  # The ICC alone
    begins: str  # Where the intervals begin
    tried: int  # Number of refitted subsets
    explained: int  # Number of these that explain the movement
    hopeful: bool  # Whether the ICC of one of these is high enough, but not its interval


_NONE = Kind[KeyFacts](
    Level.AMBER, lambda it: not it.tried,
    "No parameters can be estimated together in every person and visit.",
    "Report no parameter of this model as repeatable.",
    title="No subset is precise enough", found="{filters}",
    means="The recordings do not determine the parameters.",
    todo=("Use a richer movement of the target, or more trials.",
          "Raise --bound if wider intervals are enough."),
)  # fmt: skip
_MORE_PEOPLE = "Measure more people, or the same people at more visits."
KEY_RULES = Rules[KeyFacts](
    {name: attrgetter(name) for name in KeyFacts._fields},
    kinds=(
        _NONE,
        replace(
            _NONE, when=lambda it: it.tried and not it.explained,
            headline="No subset of parameters explains these movements.",
            title="The movement is not explained",
            means="The fixed parameters are too far from those of these people, or the model is.",
            todo=("Check the model, its fixed values and the units of the recordings.",),
        ),
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
