"""Report of the example, and its result.json."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from impc.control.named_solver import described
from impc.model.weights import condition_number, normalised
from impc.reporting.document import Block, Lines, Report, Section, Terms
from impc.reporting.finding import Finding, Level, Picture
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
    "With one command, the controller depends on Q and R only through its gain, so no recording "
    "distinguishes two pairs of cost weights with the same gain. The printed pair is set by "
    "convention: the smallest condition number. Interpret the gain and the limit, and treat Q as "
    "one of many equivalent choices. Here the convention happens to give the true weights."
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


def _within(cases: Sequence[CaseResult]) -> list[str]:
    """Methods that stay within the limit in every case."""
    return [name for name in EXAMPLE if all(one.method(name).bound_kept for one in cases)]


def example_verdict(cases: Sequence[CaseResult]) -> Verdict:
    """Verdict: methods that stay within the limit and methods that find the true weights."""
    within, found, others = _within(cases), [], [0.0]
    for name in EXAMPLE:
        results = [case.method(name) for case in cases]
        if name not in within:
            others += [one.max_abs_u for one in results if one.max_abs_u is not None]
        elif all(one.residual is not None and one.residual <= _FOUND for one in results):
            found.append(f"“{method_label(name)}”")
    verb = "needs" if len(within) == 1 else "need"
    finds = f"{' and '.join(found) or 'No method'} find{'s' * (len(found) < 2)}"
    rest = f" The others need a command of up to {max(others):.3g}; the limit is {BOUND:g}."
    return Verdict(
        Level.NOTE,
        f"{_COUNTS[len(EXAMPLE)]} methods were fitted to the same movement; "
        f"{_COUNTS[len(within)].lower()} {verb} no more than the limit.",
        f"{finds} the true cost weights.{rest if any(others) else ''}",
    )


def _keys(cases: Sequence[CaseResult]) -> list[Key]:
    within, found = len(_within(cases)), cases[0].identifiability
    fixed = "directions of the cost weights identified"
    return [
        Key(str(len(EXAMPLE)), "methods", "compared", "on the same recordings"),
        Key(str(within), f"of {len(EXAMPLE)}", "stay within the limit", "in every case"),
        Key(str(found.rank), f"of {found.free}", fixed, f"{found.chosen} set by convention"),
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
        f"Case {case.name}: cost weights Q at R = 1, gain K, misfit of the states (2-norm), and "
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
