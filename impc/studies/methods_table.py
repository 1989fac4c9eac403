"""Comparison of methods: table, entries of result.json, and trajectories.

The columns are the `ASSESSMENTS` of `impc.assess.assessments` in all commands.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from impc.arrays import Array
from impc.assess.assessments import ASSESSMENTS, MethodFit, assessed
from impc.control.named_solver import described
from impc.control.simulation import Simulation
from impc.inverse.methods import METHODS
from impc.inverse.problem import Problem
from impc.model.plant import Plant, gain_unit, weight_unit
from impc.model.weights import Weights
from impc.reporting.document import Fold, Section, Terms
from impc.reporting.estimate_text import gain_table
from impc.reporting.exchange import entries, long_rows
from impc.reporting.finding import Finding
from impc.reporting.provenance import Provenance
from impc.reporting.shown_units import body_sentence, shown_unit, signal_name

# Column headings by assessment; default: the name with spaces.
_HEADS = {
    "vaf": "VAF, {} (%)",
    "held_out_vaf": "VAF, {} (%)",
    "largest_input": "Largest command ({})",
    "first_fall": "Stops at (s)",
}
_AFTER_A_FALL = ("largest_input", "beyond_bound")  # Not shown if a simulation stops early


def method_label(name: str) -> str:
    """Label of a method with a capital first letter."""
    label = METHODS[name].label
    return label[:1].upper() + label[1:]


def methods_fold(names: Iterable[str]) -> Fold:
    """Folded section that explains the methods."""
    terms = [(method_label(name), METHODS[name].sentence) for name in names]
    return Fold("What each method does", [Terms(terms)])


def provenance_section(problem: Problem, provenance: Provenance) -> Section:
    """Section on provenance, simulated body and solver."""
    solver = f"Solved by {described(problem.solver)}."
    own = [("Body", body_sentence(problem.plant)), ("Quadratic programs", solver)]
    return Section("Provenance", [Terms([*provenance.terms, *own])])


def methods_finding(fits: Sequence[MethodFit]) -> Finding:
    """Table of all methods on the same recordings, without empty columns."""
    plant, rows = fits[0].estimate.problem.plant, []
    labels, hidden = {}, ["beyond_bound", "condition_number", "seconds", "name", "note"]
    held = all(len(fit.held_out) for fit in fits if fit.estimate.K is not None)
    for fit in fits:
        row: dict[str, Any] = {"method": method_label(fit.name)}
        fallen = any(time is not None for time in fit.fell)
        for item in ASSESSMENTS.values():
            unsaid = fallen and item.name in _AFTER_A_FALL
            values = [math.nan if unsaid else float(value) for value in item.find(fit)]
            row |= dict(zip(item.keys(plant), values, strict=True))
        ended = {"seconds": fit.estimate.seconds, "name": fit.name, "note": fit.estimate.reason}
        rows.append(row | ended)
    for item in ASSESSMENTS.values():
        for key, name in zip(item.keys(plant), item.signals(plant), strict=True):
            of_input = item.name == "largest_input"
            words = shown_unit(plant, name)[1] if of_input else signal_name(plant, name)
            labels[key] = _HEADS.get(item.name, key.replace("_", " ")).format(words)
        hidden += item.keys(plant) if item.name == ("vaf" if held else "held_out_vaf") else []
    table = pd.DataFrame(rows).dropna(axis="columns", how="all")
    if not any(table["note"]):
        table = table.drop(columns="note")
    where = "left-out trials" if held else "all trials"
    caption = f"Variance accounted for in {where}, and the largest command of all trials."
    return Finding("methods", table, caption, labels=labels, hidden=hidden)


def methods_data(fits: Sequence[MethodFit]) -> dict[str, Any]:
    """`methods` in result.json (docs/ref/results.md)."""
    return {fit.name: _data(fit) for fit in fits}


def problem_data(problem: Problem, fits: Sequence[MethodFit]) -> dict[str, Any]:
    """`methods` and the fitted problem in result.json."""
    plant = problem.plant
    return {
        "methods": methods_data(fits),
        **{name: getattr(plant, name) for name in ("states", "controls", "outputs")},
        "units": dict(plant.units),
        "horizon": problem.horizon,
        "body": plant.moves,
        "solver": problem.solver,
    }


def _data(fit: MethodFit) -> dict[str, Any]:
    found = fit.estimate
    named = ("K", "S", "misfit", "evaluations", "seconds", "reason")
    return {
        **{name: getattr(found, name) for name in named},
        "Q": None if found.weights is None else found.weights.Q,
        "R": None if found.weights is None else found.weights.R,
        "status": found.status.value,
        **assessed(fit),
        "trial_vaf": fit.trial_vaf,
        "held_out_trial_vaf": fit.held_out,
        "fell": fit.fell,
    }


def controller_findings(fit: MethodFit) -> list[Finding]:
    """Tables of gain and cost weights of a method with a gain, in units of the plant."""
    plant, weights = fit.estimate.problem.plant, fit.estimate.weights
    gains = [
        (signal_name(plant, state), f"K.{control}.{state}", unit, value)
        for control, state, unit, value in gain_table(plant, fit.estimate.gain).to_numpy().tolist()
    ]
    costs = [] if weights is None else weight_entries(plant, weights)
    gain = "Gain: opposing command per unit of each state, in units of the plant, no intervals."
    cost = "Cost weights, scaled to 1 for the first command, without intervals."
    tables = (
        pd.DataFrame(gains, columns=["gain_on", "number", "unit", "value"]),
        pd.DataFrame(costs, columns=["matrix", "first", "second", "unit", "value"]),
    )
    return [
        Finding("gain", tables[0], gain, hidden=["number"]),
        Finding("weights", tables[1], cost),
    ]


def methods_long(fits: Sequence[MethodFit], **words: str) -> list[dict[str, Any]]:
    """Rows of the long table: gain, metric, cost weights and measures of every method."""
    problem, rows = fits[0].estimate.problem, list[dict[str, Any]]()
    plant, label = problem.plant, problem.recordings[0].label
    words = {name: getattr(label, name) for name in ("subject", "visit", "condition")} | words
    for fit in fits:
        found, values, units = fit.estimate, dict[str, Any](), dict[str, str]()
        if found.K is not None:
            values = entries("K", plant.controls, plant.states, found.gain)
            values |= entries("S", plant.controls, plant.controls, found.metric)
        for which, one, other, unit, value in (
            [] if found.weights is None else weight_entries(plant, found.weights)
        ):
            values[f"{which}.{one}.{other}"], units[f"{which}.{one}.{other}"] = value, unit
        for name, measure in assessed(fit).items():
            own = measure if isinstance(measure, dict) else {"": measure}
            values |= {f"{name}.{signal}".rstrip("."): value for signal, value in own.items()}
        units |= {name: "%" for name in values if "vaf." in name} | gain_units(plant)
        rows += long_rows(values, units, {**words, "method": fit.name})
    return rows


def gain_units(plant: Plant) -> dict[str, str]:
    """Units of the entries of the gain by name: K.<control>.<state>."""
    return {
        f"K.{control}.{state}": gain_unit(plant, control, state)
        for control in plant.controls
        for state in plant.states
    }


def weight_entries(plant: Plant, weights: Weights) -> list[tuple[str, str, str, str, float]]:
    """Lower triangles of Q and R, one row per entry: matrix, two names, unit, value."""
    return [
        (which, one, other, weight_unit(plant, one, other), float(matrix[i, j]))
        for which, names, matrix in (
            ("Q", plant.states, weights.Q),
            ("R", plant.controls, weights.R),
        )
        for i, one in enumerate(names)
        for j, other in enumerate(names[: i + 1])
    ]


def trajectory_table(
    problem: Problem,
    trials: Mapping[int, str],
    runs: Mapping[str, Sequence[Simulation]],
) -> pd.DataFrame:
    """Recorded signals and `runs` of `trials`, one row per sample; angles in the shown unit."""
    plant, blocks = problem.plant, []
    for index in trials:
        trial = problem.recordings[index]
        parts = [np.asarray(trial.corrected), np.asarray(trial.disturbance)]
        for each in runs.values():
            parts += until_its_end(plant, each[index])
        blocks.append(np.hstack([plant.dt * np.arange(trial.samples)[:, None], *parts]))
    signals = [(name, "_recorded") for name in plant.outputs]
    signals += [(name, "") for name in plant.disturbances]
    for ending in runs:
        signals += [(name, f"_{ending}") for name in (*plant.outputs, *plant.controls)]
    factors, heads = [1.0], ["time"]
    for name, ending in signals:
        factor, unit = shown_unit(plant, name)
        angle = unit.startswith(("°", "rad"))
        words = unit.replace("°", "deg").replace("/", "_per_").replace("²", "2").replace("^", "")
        factors.append(factor)
        heads.append(f"{name}{ending}_{words}" if angle else f"{name}{ending}")
    table = pd.DataFrame(np.vstack(blocks) * factors, columns=heads)
    lengths = [problem.recordings[index].samples for index in trials]
    table.insert(0, "trial", np.repeat(list(trials.values()), lengths))
    return table


def until_its_end(plant: Plant, run: Simulation) -> tuple[Array, Array]:
    """Outputs and commands (steps + 1, p or m) of a run, NaN after it stops; no last command."""
    y, u = np.array(run.x @ plant.C.T), np.full((len(run.x), plant.m), np.nan)
    y[run.reached + 1 :] = np.nan
    u[: run.reached] = run.u[: run.reached]
    return y, u
