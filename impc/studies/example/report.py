"""Report of the example, and its result.json."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from markupsafe import Markup

from impc.levels import Level
from impc.model.weights import condition_number
from impc.reporting.document import Block, Draw, Fold, Lines, Report, Section
from impc.reporting.exchange import long_finding
from impc.reporting.finding import Picture
from impc.reporting.provenance import Provenance
from impc.reporting.rules import Kind, Line, Rules, always
from impc.reporting.verdict import Key
from impc.studies.example.cases import BOUND, EXAMPLE, LOST, CaseResult, distance, true_weights
from impc.studies.fit.figures import movement_figure
from impc.studies.methods_figure import methods_figure
from impc.studies.methods_table import (
    method_label,
    methods_data,
    methods_finding,
    methods_fold,
    methods_long,
    provenance_section,
)

# Largest distance to the true weights that counts as found; typical 1e-14.
_FOUND = 1e-6
# Methods whose states and commands are drawn.
_DRAWN = ("feedback_gain", "inverse_mpc", "inverse_lqr_output")
_COUNTS = ("None", "One", "Two", "Three", "Four", "Five", "Six", "Seven")
_SETTING = (
    "A model predictive controller (MPC) drives an unstable system to rest without exceeding a "
    "limit of its command. Its cost weights Q and R define the cost of a deviation of each state "
    "relative to the cost of the command. The methods receive only the states, as in a recorded "
    "movement, and estimate these weights. It is the simulation example of A. Ramadan's "
    "dissertation (Michigan State University, 2018)."
)
_GAIN = (
    "With one command, the movement depends on Q and R only through the gain: the command per unit "
    "of each state. No recording distinguishes two pairs of cost weights with the same gain. impc "
    "prints the pair whose costs differ least between directions (smallest condition number). "
    "Interpret the gain and the limit, and treat Q as one of many equivalent choices. Here the "
    "rule happens to choose the true weights."
)
_CODE = Markup("<code>{}</code>")
_YOURS = (
    Markup("{} drafts a file with the meaning of the columns of your recording.").format(
        _CODE.format("impc inspect trial_1.csv --plant seated-balance --out subject.toml")
    ),
    Markup("{} fits the controller and writes a page like this one.").format(
        _CODE.format("impc fit trial_*.csv --plant seated-balance --config subject.toml")
    ),
)


def example_report(cases: Sequence[CaseResult], provenance: Provenance) -> Report:
    """Report of `impc example`."""
    first = cases[0]
    figures: dict[str, Draw] = {}
    for case in cases:
        figures[_name(case)] = partial(methods_figure, case.methods)
        figures |= {_name(case, one): partial(movement_figure, case.method(one), 0)
                    for one in _DRAWN}  # fmt: skip
    return Report(
        "impc example",
        "example",
        RULES.verdict(Facts(cases)),
        [
            *(_case_section(case, hero=case is first) for case in cases),
            Section("What the example shows", [_SETTING, _GAIN, LOST, methods_fold(EXAMPLE)]),
            Section("Your own recordings", [Lines(_YOURS)]),
            provenance_section(first.methods[0].estimate.problem, provenance),
        ],
        meta=(
            "Simulation",
            "1 start" if len(cases) == 1 else f"{len(cases)} starts",
            f"{len(first.truth.u)} samples each",
        ),
        hero=_picture(first),
        keys=_keys(cases),
        figures=figures,
        beside=[
            long_finding(
                [row for case in cases for row in methods_long(case.methods, condition=case.name)]
            )
        ],
        data=example_data(cases, provenance),
        provenance=provenance,
    )


class Facts:
    """Methods that stay within the limit in every case, and those that find the true weights."""

    def __init__(self, cases: Sequence[CaseResult]) -> None:
        each = {name: [case.method(name) for case in cases] for name in EXAMPLE}
        self.within = [name for name, own in each.items() if all(one.keeps_bounds for one in own)]
        self.found = [
            name for name in self.within
            if all(distance(one) <= _FOUND for one in each[name])
        ]  # fmt: skip
        self.largest = max(
            (float(one.largest_input[0]) for name, own in each.items() for one in own
             if name not in self.within and one.runs), default=0.0,
        )  # fmt: skip
        names = " and ".join(f"“{method_label(name)}”" for name in self.found) or "No method"
        self.finds, self.others = f"{names} find{'s' * (len(self.found) < 2)}", ""
        if self.largest:
            self.others = f" The others need a command of up to {self.largest:.3g}; the limit is "
            self.others += f"{BOUND:g}."


_SHOWN = Kind[Facts](
    Level.GREEN, always,
    "{all} methods were tried on the same movement; {few} {need} no more than the limit.",
    "{finds} the true cost weights.{others}", badge="As expected",
)  # fmt: skip
RULES = Rules[Facts](
    {
        "all": lambda _: _COUNTS[len(EXAMPLE)],
        "few": lambda it: _COUNTS[len(it.within)].lower(),
        "need": lambda it: "needs" if len(it.within) == 1 else "need",
    },
    kinds=(
        replace(
            _SHOWN, level=Level.AMBER, when=lambda it: not it.found, badge="Not as expected",
            title="No method found the cost weights of the simulation",
            found="{finds} the true cost weights and stays within the limit.",
            means="On this computer the example does not show what it should.",
            todo=("Compare result.json with that of another computer.",),
        ),
        _SHOWN,
    ),
    may=(Line(lambda it: it.found and it.largest, "The limit must be part of the model.",
              "Methods that ignore it need a command that was not available."),),
    may_not=(
        Line(always, "Anything about a person.", "The movement is simulated."),
        Line(always, "That these cost weights are the only ones.",
             "Others lead to the same movement; here a rule happens to choose the true ones."),
    ),
)  # fmt: skip


def _keys(cases: Sequence[CaseResult]) -> list[Key]:
    within, found = len(Facts(cases).within), cases[0].identifiability
    fixed = "numbers of the cost determined by the movement"
    return [
        Key(str(len(EXAMPLE)), "methods", "tried", "on the same recordings"),
        Key(str(within), f"of {len(EXAMPLE)}", "stay within the limit", "in every case"),
        Key(str(found.rank), f"of {found.free}", fixed, f"impc chooses the other {found.chosen}"),
    ]


def _case_section(case: CaseResult, *, hero: bool) -> Section:
    start = ", ".join(f"{value:g}" for value in case.truth.x[0])
    words = "Grey: recorded; blue: model; orange: at the limit, or beyond it."
    drawn = [
        Picture(_name(case, one), "States and command over time", f"{method_label(one)}. {words}")
        for one in _DRAWN
    ]
    table = replace(methods_finding(case.methods), name=f"methods-{case.name}")
    blocks: list[Block] = [table, Fold("States and command of three methods", drawn)]
    blocks = blocks if hero else [_picture(case), *blocks]
    return Section(f"Case {case.name}: start at ({start})", blocks, f"Case {case.name}")


def _picture(case: CaseResult) -> Picture:
    return Picture(
        _name(case),
        "Variance that each method leaves unexplained, and the largest command it needs",
        f"Case {case.name}. Left: unexplained variance; farther left is better (logarithmic axis). "
        "Blue: stays within the limit. Shaded: beyond it.",
    )


def _name(case: CaseResult, method: str = "comparison") -> str:
    return f"{method}-case-{case.name}"


def example_data(cases: Sequence[CaseResult], provenance: Provenance) -> dict[str, Any]:
    """Content of result.json."""
    plant = cases[0].controller.plant
    return {
        "plant": {"name": provenance.plant_name, "A": plant.A, "B": plant.B, "dt": plant.dt},
        "solver": cases[0].controller.solver,
        "cases": {case.name: _case(case) for case in cases},
    }


def _case(case: CaseResult) -> dict[str, Any]:
    found, true = case.identifiability, true_weights(case.controller.plant)
    named = ("free", "rank", "chosen", "singular_values", "tolerance")
    return {
        "x0": case.truth.x[0],
        "branch": case.branch,
        "truth": {"Q": true.Q, "R": true.R, "condition_number": condition_number(true),
                  "K": case.controller.K, "x": case.truth.x, "u": case.truth.u},
        "methods": {
            fit.name: {
                **methods_data([fit])[fit.name],
                "distance": distance(fit),
                **({"x": fit.runs[0].x, "u": fit.runs[0].u} if fit.runs else {}),
            }
            for fit in case.methods
        },
        "identifiability": {name: getattr(found, name) for name in named},
    }  # fmt: skip
