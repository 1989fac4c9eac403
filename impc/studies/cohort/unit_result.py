"""What a study keeps of the fit of a unit: a row of its table, with words and units for pages."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from impc.assess.assessments import MethodFit, assessed
from impc.assess.covariance import TWO_SIDED
from impc.assess.printed_gain import entry_names, follows_command
from impc.model.plant import UNKNOWN, Plant, gain_unit, weight_unit
from impc.reporting.shown_units import axis_label, shown_unit, signal_name
from impc.studies.fit.facts import with_unit
from impc.studies.fit.result import FitResult
from impc.studies.fit.verdict import RULES

#: Prefix of columns of logarithms, which are compared as ratios.
LOGARITHM = "log_cost_weight."
_CENTRE = "analytic centre (no units)"


def stored_fit(result: FitResult) -> dict[str, Any]:
    """The result of a fit for the tables and pages of a study, and for its replicates."""
    estimate, verdict = result.estimate, RULES.verdict(result).data()
    row = {name: verdict[name] for name in ("level", "headline", "kind")} | _row(result)
    return {
        "verdict": verdict,
        "row": row,  # Columns of units.csv
        "shown": _shown(result.fitted.problem.plant, list(row)),
        "parameters": () if estimate.problem.family is None else estimate.problem.family.names,
        "findings": [trial.findings for trial in result.given.recordings],
        "trajectory": _trajectory(result.inverse_mpc),
        # For replicates
        "added": None if result.added is None else result.added.name,
        "K": estimate.K,
        "S": estimate.S,
        "starts": [trial.x0 for trial in estimate.problem.recordings],
        "logarithms": estimate.problem.logarithms,
        "errors": estimate.problem.errors,
    }


def _row(result: FitResult) -> dict[str, Any]:
    estimate, intent, plant = result.estimate, result.intent, result.fitted.problem.plant
    samples = sum(trial.samples for trial in result.given.recordings)
    row: dict[str, Any] = {"trials": len(result.trials), "samples": samples}
    for name, given in assessed(result.inverse_mpc).items():
        own = given.items() if isinstance(given, dict) else [("", given)]
        row |= {f"{name}.{signal}".rstrip("."): value for signal, value in own}
    row["saturated"] = result.saturated
    ends = np.array([(one.low, one.high) for one in result.gain_intervals]).T
    # An interval over several ends of the search is not symmetric: its longer side counts.
    halves = np.max(np.abs(ends - np.ravel(estimate.K)), axis=0)
    for name, values in {
        "K": estimate.K,
        "K_deviation": halves / TWO_SIDED,
        "K_low": ends[0],
        "K_high": ends[1],
        "K_identified": estimate.covariance.individually_identified,
        "K_determined": [one.determined for one in result.gain_intervals],
        "K_of_weights": result.fitted.gain,
    }.items():
        entries = zip(entry_names(plant), np.ravel(values), strict=True)
        row |= {f"{name}{entry[1:]}": value for entry, value in entries}
    reported = intent.readings[0]
    of_states = {"dominant": reported.dominant, "cost_weight": np.diag(reported.weights.Q)}
    for reading in intent.readings:
        if reading.rule == _CENTRE:
            of_states["centre_weight"] = np.diag(reading.weights.Q)
    for name, values in of_states.items():
        states = zip(plant.states, values, strict=True)
        row |= {f"{name}.{state}": float(value) for state, value in states}
    family = estimate.problem.family
    known = () if family is None else family.names
    return row | dict(zip(known, estimate.parameters, strict=True)) | _structure(result)


def _structure(result: FitResult) -> dict[str, Any]:
    """Logarithms of the cost weights of a structure, with 95 % intervals."""
    if not result.structures:
        return {}
    fit = result.structures[0]
    row: dict[str, Any] = {}
    for end, part in (("", "value"), ("_low", "low"), ("_high", "high")):
        values = [getattr(item, part) for item in fit.intervals] or [np.nan] * fit.structure.count
        names = zip(fit.structure.unknowns, values, strict=True)
        row |= {f"log_cost_weight{end}.{unknown}": value for unknown, value in names}
    p = np.nan if fit.test is None else fit.test.probability
    return row | {"structure_refused": bool(fit.refused), "structure_p": p}


def _shown(plant: Plant, columns: list[str]) -> dict[str, dict[str, Any]]:
    """Words and units of the columns that pages show; `compared` are those of comparisons.

    Compared are: logarithms of cost weights within a structure (without one: cost weights of
    recorded outputs in the analytic centre), gains on recorded outputs and their rates (if no state
    has the name of an output: all gains except on states of nerves or muscles), and VAF. More
    measures reduce the power after Holm's correction.
    """
    recorded = {*plant.outputs, *(f"{name}_rate" for name in plant.outputs)} & {*plant.states}
    own = follows_command(plant)
    inner = own if not own.all() else ~own
    found: dict[str, dict[str, Any]] = {}
    for column in columns:
        if column.startswith(LOGARITHM):
            words = signal_name(plant, column.removeprefix(LOGARITHM))
            found[column] = _entry(f"cost weight of {words}", words, "-")
    centre = [] if found else [name for name in plant.outputs if f"centre_weight.{name}" in columns]
    for control, (state, hidden) in itertools.product(
        plant.controls, zip(plant.states, inner.tolist(), strict=True)
    ):
        found[f"K.{control}.{state}"] = _gain(plant, control, state) | {
            "inner": hidden, "compared": state in recorded if recorded else not hidden,
        }  # fmt: skip
    for name in centre:
        words, unit = signal_name(plant, name), weight_unit(plant, name, name)
        found[f"centre_weight.{name}"] = _entry(f"central cost weight of {words}", words, unit)
    for name in plant.outputs:
        words = signal_name(plant, name)
        found[f"vaf.{name}"] = _entry(f"variance accounted for, {words}", words, "%")
    return found


def _entry(name: str, signal: str, unit: str) -> dict[str, Any]:
    unit = "-" if unit == "1" else unit
    return {"name": name, "signal": signal, "scale": 1.0, "unit": unit, "unit_si": unit,
            "compared": True}  # fmt: skip


def _gain(plant: Plant, control: str, state: str) -> dict[str, Any]:
    """Words of a gain: its shown unit, that of the command, and for what it is given."""
    (scale, top), (factor, of) = shown_unit(plant, control), shown_unit(plant, state)
    si, words = gain_unit(plant, control, state), signal_name(plant, state)
    effort = signal_name(plant, control)
    unit = si.replace("rad", "°") if si != UNKNOWN and (scale, factor) != (1.0, 1.0) else si
    name = f"gain on {words}" + f" ({effort})" * (plant.m > 1)
    return _entry(name, words, si) | {
        "scale": scale / factor, "unit": "-" if unit == "1" else unit, "control": effort,
        "top": top, "per": f"{with_unit('1', of)} of {words}",
    }  # fmt: skip


def _trajectory(fit: MethodFit) -> dict[str, Any]:
    """Thinned recorded and modelled outputs of the first trial, in shown units."""
    plant, first = fit.estimate.problem.plant, fit.estimate.problem.recordings[0]
    step, simulated = max(1, first.samples // 600), fit.runs[0].x @ plant.C.T
    signals = []
    for column, name in enumerate(plant.outputs):
        factor, _ = shown_unit(plant, name)
        recorded, modelled = first.corrected[::step, column], simulated[::step, column]
        signals.append({
            "label": axis_label(plant, name), "recorded": factor * recorded,
            "simulated": factor * modelled,
        })  # fmt: skip
    return {"dt": plant.dt * step, "signals": signals}
