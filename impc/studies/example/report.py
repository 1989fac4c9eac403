"""Report of the example, and its result.json."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from impc.control.named_solver import described
from impc.model.weights import condition_number, normalised
from impc.reporting.document import Block, Lines, Report, Section, Terms
from impc.reporting.finding import Finding, Level, Picture
from impc.reporting.rules import Kind, Line, Rules, always
from impc.reporting.style import HALF, WIDE
from impc.reporting.verdict import Key, Verdict
from impc.studies.example.cases import BOUND, EXAMPLE, LOST, SETTINGS, true_weights
from impc.studies.example.figures import comparison_figure
from impc.studies.methods_table import method_label, methods_fold

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from impc.arrays import Array
    from impc.model.weights import Weights
    from impc.reporting.provenance import Provenance
    from impc.studies.example.cases import CaseResult, MethodResult

# Largest distance to the true weights that counts as found; typical 1e-14.
_FOUND = 1e-6
# Decimal places; further ones are rounding errors of a search.
_DIGITS = 9
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
    plant, first = cases[0].controller.plant, cases[0]
    figures = {
        f"comparison-case-{case.name}": partial(
            comparison_figure, case, HALF if case is first else WIDE
        )
        for case in cases
    }
    settings = ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in SETTINGS.items())
    made = [
        ("Plant", _CODE.format(provenance.plant_name)),
        ("Matrices", f"A = {plant.A.tolist()}, B = {plant.B.tolist()}"),
        ("Settings", settings),
        ("Quadratic programs", f"Solved by {described(first.controller.solver)}."),
    ]
    return Report(
        "impc example",
        "example",
        example_verdict(cases),
        [
            *(_case_section(case, hero=case is first) for case in cases),
            Section("What the example shows", [_SETTING, _GAIN, LOST, methods_fold(EXAMPLE)]),
            Section("Your own recordings", [Lines(_YOURS)]),
            Section("Provenance", [Terms([*provenance.terms, *made])]),
        ],
        meta=(
            "Simulation",
            "1 start" if len(cases) == 1 else f"{len(cases)} starts",
            f"{len(first.truth.u)} samples each",
        ),
        hero=_picture(first),
        keys=_keys(cases),
        figures=figures,
        data=example_data(cases, provenance, SETTINGS),
        provenance=provenance,
    )


class _Facts:
    """Methods that stay within the limit in every case, and those that find the true weights."""

    def __init__(self, cases: Sequence[CaseResult]) -> None:
        each = {name: [case.method(name) for case in cases] for name in EXAMPLE}
        self.within = [name for name, own in each.items() if all(one.bound_kept for one in own)]
        self.found = [
            name for name in self.within
            if all(one.residual is not None and one.residual <= _FOUND for one in each[name])
        ]  # fmt: skip
        self.largest = max(
            (one.max_abs_u for name, own in each.items() for one in own
             if name not in self.within and one.max_abs_u is not None), default=0.0,
        )  # fmt: skip
        names = " and ".join(f"“{method_label(name)}”" for name in self.found) or "No method"
        self.finds, self.others = f"{names} find{'s' * (len(self.found) < 2)}", ""
        if self.largest:
            self.others = f" The others need a command of up to {self.largest:.3g}; the limit is "
            self.others += f"{BOUND:g}."


_SHOWN = Kind[_Facts](
    Level.GREEN, always,
    "{all} methods were tried on the same movement; {few} {need} no more than the limit.",
    "{finds} the true cost weights.{others}", badge="As expected",
)  # fmt: skip
RULES = Rules[_Facts](
    {
        "all": lambda _: _COUNTS[len(EXAMPLE)],
        "few": lambda it: _COUNTS[len(it.within)].lower(),
        "need": lambda it: "needs" if len(it.within) == 1 else "need",
    }
    | {name: attrgetter(name) for name in ("finds", "others")},
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


def example_verdict(cases: Sequence[CaseResult]) -> Verdict:
    """Verdict: methods that stay within the limit and methods that find the true weights."""
    return RULES.verdict(_Facts(cases))


def _keys(cases: Sequence[CaseResult]) -> list[Key]:
    within, found = len(_Facts(cases).within), cases[0].identifiability
    fixed = "numbers of the cost determined by the movement"
    return [
        Key(str(len(EXAMPLE)), "methods", "tried", "on the same recordings"),
        Key(str(within), f"of {len(EXAMPLE)}", "stay within the limit", "in every case"),
        Key(str(found.rank), f"of {found.free}", fixed, f"impc chooses the other {found.chosen}"),
    ]


def _case_section(case: CaseResult, *, hero: bool) -> Section:
    start = ", ".join(f"{value:g}" for value in case.x0)
    blocks: list[Block] = [methods_finding(case)]
    blocks = blocks if hero else [_picture(case), *blocks]
    return Section(f"Case {case.name}: start at ({start})", blocks, f"Case {case.name}")


def _picture(case: CaseResult) -> Picture:
    return Picture(
        f"comparison-case-{case.name}",
        "States and command over time: recorded, and modelled by three methods",
        f"Case {case.name}. Grey: recorded. Blue: model; orange: model beyond the limit.",
    )


def methods_finding(case: CaseResult) -> Finding:
    """Table of the true controller and all methods."""
    truth, K = true_weights(case.controller.plant), case.controller.K
    largest = float(np.max(np.abs(case.truth.u)))
    rows: list[dict[str, Any]] = [
        {"method": "Truth", **_entries(truth, K), "largest_u": largest, "kept": "yes",
         "name": "truth"}
    ]  # fmt: skip
    for item in case.methods:
        kept = {None: "", True: "yes", False: "no"}[item.bound_kept]
        rows.append(
            {
                "method": method_label(item.name),
                **_entries(item.weights, item.K),
                "misfit": item.state_misfit,
                "largest_u": item.max_abs_u,
                "kept": "no weights" if item.feasible is False else kept,
                "residual": item.residual,
                "seconds": item.seconds,
                "name": item.name,
            }
        )
    numeric = [*_entries(truth, K), "misfit", "largest_u", "residual", "seconds"]
    heads = ["method", *numeric[:-2], "kept", *numeric[-2:], "name"]
    table = pd.DataFrame(rows, columns=heads)
    # Adding zero turns -0 into 0.
    table[numeric] = table[numeric].astype(float).round(_DIGITS) + 0.0
    return Finding(
        f"methods-{case.name}",
        table,
        f"Case {case.name}: cost weights Q if that of the command, R, is 1; gain K (command per "
        "unit of each state); misfit (root of the summed squared differences of all states); and "
        "the largest command u.",
        digits=3,
        labels={"largest_u": "Largest u", "kept": "Limit kept"},
        hidden=["residual", "seconds", "name"],
    )


def _entries(weights: Weights | None, gain: Array | None) -> dict[str, float]:
    """Entries Q11, Q12, Q22 at R = 1, then the gain."""
    found: dict[str, float] = {}
    if weights is not None:
        Q = normalised(weights).Q
        places = np.transpose(np.triu_indices(len(Q)))
        found |= {f"Q{i + 1}{j + 1}": float(Q[i, j]) for i, j in places}
    if gain is not None:
        found |= {f"K{k + 1}": float(value) for k, value in enumerate(gain.ravel())}
    return found


def example_data(
    cases: Sequence[CaseResult], provenance: Provenance, settings: Mapping[str, float]
) -> dict[str, Any]:
    """Content of result.json, with the `settings` of the example."""
    plant = cases[0].controller.plant
    return {
        "plant": {"name": provenance.plant_name, "A": plant.A, "B": plant.B, "dt": plant.dt},
        "settings": settings,
        "solver": cases[0].controller.solver,
        "cases": {case.name: _case(case) for case in cases},
    }


def _case(case: CaseResult) -> dict[str, Any]:
    truth = {
        **_weights(true_weights(case.controller.plant)),
        "K": case.controller.K,
        "max_abs_u": float(np.max(np.abs(case.truth.u))),
        "x": case.truth.x,
        "u": case.truth.u,
    }
    found = case.identifiability
    named = ("free", "rank", "chosen", "singular_values", "tolerance")
    others = [{**_weights(item.weights), "state_misfit": item.misfit} for item in found.others]
    return {
        "x0": case.x0,
        "branch": case.branch,
        "truth": truth,
        # The truth is also listed as a method, so that programs can loop over all.
        "methods": {"truth": truth} | {item.name: _method(item) for item in case.methods},
        "identifiability": {name: getattr(found, name) for name in named} | {"others": others},
    }


def _method(method: MethodResult) -> dict[str, Any]:
    run = method.simulation
    named = ("K", "state_misfit", "max_abs_u", "bound_kept", "residual", "feasible", "seconds",
             "simulations")  # fmt: skip
    found = {name: getattr(method, name) for name in named}
    found |= {} if run is None else {"x": run.x, "u": run.u}
    found |= {} if method.weights is None else _weights(method.weights)
    return {name: value for name, value in found.items() if value is not None}


def _weights(weights: Weights) -> dict[str, Any]:
    return {"Q": weights.Q, "R": weights.R, "condition_number": condition_number(weights)}
