"""The report of the fit of an optimal control problem: page, tables, result.json, figures.

See docs/nonlinear.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from impc.assess.covariance import TWO_SIDED
from impc.nonlinear.figures import interval_rows, optimal_figures
from impc.nonlinear.result import MOST_TRIALS, reached, row_name, signal_vaf
from impc.nonlinear.sentences import abstract, verdict
from impc.reporting.document import (
    Block,
    Details,
    Lines,
    Picture,
    Report,
    Section,
    Terms,
    TextTable,
    Verdict,
)
from impc.reporting.rendering import number

if TYPE_CHECKING:
    from impc.nonlinear.combinations import Combination
    from impc.nonlinear.result import OptimalFit
    from impc.reporting.provenance import Provenance

#: Under which name its numbers stand among the methods of result.json.
METHOD = "nonlinear_inverse_mpc"
_LEVEL = 0.95
_INTERVALS = Picture(
    "parameters",
    "Intervals of the parameters and products of parameters that the recordings tell",
    "Parameters, and products of them, that the recordings tell: 95 % intervals over the value. "
    "An arrow: it goes on.",
    narrow=True,
)
_VALUES = Picture(
    "singular-values",
    "Singular values of the derivative of the recordings by the parameters, told and not told",
    "Singular values: how strongly the recordings move along each direction of the parameters. "
    "Round: told. Square, on grey: not told, because nothing that was measured moves.",
    narrow=True,
)
_WORDS = {"known": "known", "yes": "by itself", "roughly": "roughly", "no": "not by itself"}
_TOLD = (
    "A product that is told has one value whatever the others have. Along a direction that is not "
    "told the parameters may change together, by any factor a, and the recordings stay what they "
    "are. This is said of the neighbourhood of the answer."
)


def optimal_report(fit: OptimalFit, provenance: Provenance) -> Report:
    """Page, result.json, parameters.csv, combinations.csv, trajectories.csv and figures."""
    told: list[Block] = [_TOLD, _combinations(fit), _VALUES]
    return Report(
        f"impc fit: {provenance.plant_name}",
        "The optimal control problem behind the recordings",
        (Verdict(verdict(fit)), Lines(abstract(fit))),
        [
            Section("1. The parameters", _parameters(fit), "Parameters", together=True),
            Section("2. What is told", told, "What is told"),
            Section("3. Recorded and simulated", _trajectories(fit), "Trajectories"),
            Section("4. Checks of the recordings", (_checks(fit),), "Checks", folded=True),
            Section("5. Settings and versions", _made(fit, provenance), "Settings", folded=True),
        ],
        figures=optimal_figures(fit),
        tables={
            "parameters": parameters_table(fit),
            "combinations": _combination_numbers(fit),
            "trajectories": _samples(fit),
        },
        data=_data(fit, provenance),
        provenance=provenance,
    )


def _rows(fit: OptimalFit) -> list[dict[str, Any]]:
    """What is known of each parameter, in the order of the problem's."""
    estimate, problem = fit.estimate, fit.estimate.problem
    ends = estimate.intervals(_LEVEL)
    apart = {name for one in estimate.combinations.untold for name in one.exponents}
    roughly = {one.name for one in estimate.combinations.told if one.rough}
    rows = [
        {
            "parameter": name,
            "unit": unit,
            "value": value,
            "low": ends[name][0],
            "high": ends[name][1],
            "level": _LEVEL,
            "told": "no" if name in apart else "roughly" if name in roughly else "yes",
            "start": estimate.start[name],
        }
        for (name, value), unit in zip(estimate.theta.items(), problem.units, strict=True)
    ]
    for name, (value, unit) in fit.known.items():
        row = dict.fromkeys(("low", "high", "level", "start"), np.nan)
        rows.append({"parameter": name, "unit": unit, "value": value, **row, "told": "known"})
    return rows


def parameters_table(fit: OptimalFit) -> TextTable:
    """A row a parameter: unit, value, both ends, level, whether it is told, first value."""
    heads = ("parameter", "unit", "value", "low", "high", "level", "told", "start")
    return TextTable("", heads, [tuple(row[head] for head in heads) for row in _rows(fit)])


def _parameters(fit: OptimalFit) -> list[Block]:
    rows = []
    for row in _rows(fit):
        known, told = row["told"] == "known", row["told"] != "no"
        ends = f"{number(row['low'], 4)} to {number(row['high'], 4)}" if told else "any"
        rows.append(
            (
                row["parameter"],
                number(row["value"], 5) + (f" {row['unit']}" if row["unit"] else ""),
                "-" if known else ends,
                _WORDS[row["told"]],
                number(row["start"], 4),
            )
        )
    table = TextTable(
        "Value with its 95 % interval, and where the search began. One that is not told by itself "
        "stays near its start; section 2 says what of it is told.",
        ("parameter", "value", "interval", "told", "start"),
        rows,
    )
    return [*([_INTERVALS] if interval_rows(fit) else []), table]


def _combination_numbers(fit: OptimalFit) -> TextTable:
    found = fit.estimate.combinations
    rows = []
    for one in (*found.told, *found.untold):
        low, high = _ends(one)
        told = "no" if one in found.untold else "roughly" if one.rough else "yes"
        rows.append((one.name, one.value, low, high, _LEVEL, told))
    return TextTable("", ("product", "value", "low", "high", "level", "told"), rows)


def _ends(one: Combination) -> tuple[float, float]:
    """Both ends of a told product; any positive number for one that is not."""
    if one.difference:
        return one.value - TWO_SIDED * one.deviation, one.value + TWO_SIDED * one.deviation
    with np.errstate(over="ignore"):
        factor = float(np.exp(TWO_SIDED * one.deviation))
    return one.value / factor, one.value * factor


def _combinations(fit: OptimalFit) -> TextTable:
    found = fit.estimate.combinations
    rows = []
    for one in filter(lambda one: one.printable, found.told):
        low, high = _ends(one)
        rows.append((one.name, number(one.value, 5), f"{number(low, 4)} to {number(high, 4)}"))
    for one in found.untold:
        powers = [
            name if item == 1 else f"{name}^{item:.3g}" for name, item in one.exponents.items()
        ]
        moved = ", ".join(powers if one.scaling else one.exponents)
        said = "any factor a of these together" if one.scaling else "near these values"
        rows.append((moved, "not identified", said))
    return TextTable(
        "Products of parameters with their 95 % intervals, in the problem's units.",
        ("product", "value", "interval"),
        rows,
    )


def _trajectories(fit: OptimalFit) -> list[Block]:
    vaf = signal_vaf(fit.estimate)
    table = TextTable(
        "Variance accounted for (3.24), over all recordings.",
        ("signal", "VAF %"),
        [(name, number(value, 6)) for name, value in vaf.items()],
    )
    limits = TextTable(
        "At how many samples each constraint is at its limit.",
        ("constraint", "at its limit", "samples"),
        [(one.name, str(one.samples), str(one.of)) for one in reached(fit.estimate)],
    )
    pictures = [
        Picture(
            f"trajectories-{index + 1}",
            f"Recorded and simulated states and inputs over time, {fit.trials[index]}",
            f"{fit.trials[index]}. Rings: recorded. Dashed: simulated from the first state alone. "
            "Dotted: limits of the signal at the estimate.",
        )
        for index in range(min(len(fit.trials), MOST_TRIALS))
    ]
    others = [Details("The other recordings", pictures[1:])] if len(pictures) > 1 else []
    return [table, *([limits] if limits.rows else []), pictures[0], *others]


def _checks(fit: OptimalFit) -> Terms:
    return Terms(
        [
            (name, found or ("Nothing found.",))
            for name, found in zip(fit.trials, fit.findings, strict=True)
        ]
    )


def _made(fit: OptimalFit, provenance: Provenance) -> list[Block]:
    problem, estimate = fit.estimate.problem, fit.estimate
    arguments = "; ".join(f"{key} = {value}" for key, value in provenance.plant_arguments.items())
    settings = "; ".join(f"{key} = {value}" for key, value in fit.settings.items())
    constraints = ", ".join(dict.fromkeys(map(row_name, problem.rows))) or "none"
    sample = "not said" if fit.dt is None else f"{fit.dt:.6g} s"
    return [
        Markup("<code>{}</code>").format(provenance.command),
        Terms(
            [
                ("Made", (f"{provenance.made}, in {estimate.seconds:.1f} s of search",)),
                ("Problem", (Markup("<code>{}</code> <code>{}</code>").format(
                    provenance.plant_name, arguments),)),
                ("States, inputs", (f"{', '.join(problem.state_names)}; "
                                    f"{', '.join(problem.input_names)}",)),
                ("Constraints", (constraints,)),
                ("Sample time, horizon", (f"{sample}, {problem.horizon} samples",)),
                ("Search", (f"{estimate.evaluations} evaluations; {fit.status.value}",)),
                ("Settings", (Markup("<code>{}</code>").format(settings),)),
                ("Recordings", (", ".join(provenance.files),)),
                ("Versions", (provenance.all_versions,)),
            ]
        ),
    ]  # fmt: skip


def _samples(fit: OptimalFit) -> TextTable:
    """A row a sample: recorded and simulated signals, and disturbances."""
    problem, step, blocks = fit.estimate.problem, 1.0 if fit.dt is None else fit.dt, []
    for index in range(min(len(fit.trials), MOST_TRIALS)):
        one, (x, u) = fit.estimate.recordings[index], fit.estimate.runs[index]
        behind = np.full((1, problem.m), np.nan)
        last = np.full((1, problem.disturbance_count), np.nan)
        time = step * np.arange(len(x))[:, None]
        blocks.append(np.hstack([
            np.full_like(time, index + 1.0), time, one.x, x, np.vstack([one.u, behind]),
            np.vstack([u, behind]), np.vstack([one.d, last]),
        ]))  # fmt: skip
    heads = ["trial", "sample" if fit.dt is None else "time"]
    for names in (problem.state_names, problem.input_names):
        heads += [f"{name}_recorded" for name in names] + [f"{name}_simulated" for name in names]
    return TextTable("", [*heads, *problem.disturbance_names], np.vstack(blocks).tolist())


def _data(fit: OptimalFit, provenance: Provenance) -> dict[str, Any]:
    estimate, problem, found = fit.estimate, fit.estimate.problem, fit.estimate.combinations
    return {
        "verdict": verdict(fit),
        "sentences": abstract(fit),
        "parameters": {
            row["parameter"]: {key: value for key, value in row.items() if key != "parameter"}
            for row in _rows(fit)
        },
        "combinations": {
            kind: [
                {"name": one.name, "exponents": one.exponents, "value": one.value,
                 "deviation": one.deviation}
                for one in items
            ]
            for kind, items in (("told", found.told), ("untold", found.untold))
        },
        "singular_values": found.singular_values,
        "reached": {one.name: one.samples for one in reached(estimate)},
        "loss": estimate.loss,
        "x0": estimate.x0,
        "trials": [
            {"trial": name, "samples": len(one.u), "closed_loop": one.closed_loop, "findings": told}
            for name, one, told in zip(
                fit.trials, estimate.recordings, fit.findings, strict=True
            )
        ],
        "methods": {
            METHOD: {
                "status": fit.status.value,
                "misfit": float(np.linalg.norm(estimate.residual)),
                "evaluations": estimate.evaluations,
                "seconds": estimate.seconds,
                "vaf": signal_vaf(estimate),
            }
        },
        "problem": {
            "name": provenance.plant_name,
            "arguments": dict(provenance.plant_arguments),
            "states": problem.state_names,
            "inputs": problem.input_names,
            "disturbances": problem.disturbance_names,
            "constraints": [*dict.fromkeys(map(row_name, problem.rows))],
            "horizon": problem.horizon,
            "dt": fit.dt,
        },
        "settings": dict(fit.settings),
    }  # fmt: skip
