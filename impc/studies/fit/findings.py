"""Tables of a fit: gain, parameters, limits, trials, weights."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from impc.arrays import Array
from impc.assess.printed_gain import entry_names
from impc.files.disk import truth_beside
from impc.inverse.refit import IDENTIFIED
from impc.model.plant import UNKNOWN, Plant
from impc.reporting.exchange import long_rows
from impc.reporting.finding import Finding, table_of
from impc.reporting.shown_units import error_unit, shown_unit, signal_name
from impc.studies import methods_table
from impc.studies.fit.facts import GainRow, named_gains, shift_halves, statement_text
from impc.studies.fit.result import FitResult, shown_trials, trial_name
from impc.studies.fit.uncertainty import Alternative

# Smallest component of a direction that is printed.
_NAMED = 0.15


def per_unit_finding(result: FitResult) -> Finding:
    """Opposing command per shown unit of each state whose single gain has a meaning."""
    plant, several = result.given.plant, result.given.plant.m > 1
    gravity = dict(plant.gravity)

    def times(row: GainRow) -> float:
        """Gain over m g h, if the plant states that of the state and is in N m."""
        _, control, state = row.interval.name.split(".", 2)
        stated = state in gravity and plant.unit(control) == "N m"
        return (row.interval.value or np.nan) / gravity[state] if stated else np.nan

    table = table_of(
        [row for _, row in named_gains(result)],
        {
            "for_every": lambda row: row.per,
            **({"by": lambda row: row.control} if several else {}),
            "opposing_command": lambda row: float(row.value),
            "low": lambda row: float(row.low),
            "high": lambda row: float(row.high),
            "unit": lambda row: row.unit,
            **({"times_m_g_h": times} if gravity else {}),
            "determined": lambda row: row.determined,
        },
    )
    labels = {
        "for_every": "For every ...",
        "low": "95 % CI, low",
        "high": "95 % CI, high",
        "times_m_g_h": "Times m g h",
    }
    count = len(result.estimate.rivals)
    other = "another end" if count == 1 else f"{count} other ends"
    ends = f" Intervals include {other} of the search with an equally good fit." if count else ""
    caption = f"Determined: known to within half of its value.{ends}"
    return Finding("gain_per_unit", table, caption, labels=labels, digits=3)


def gain_finding(result: FitResult) -> Finding:
    """All fitted numbers with intervals by every method, the preferred first, in SI units."""
    plant, found = result.fitted.problem.plant, result.uncertainty.intervals
    units, several = number_units(plant), len({item.method for item in found}) > 1
    table = table_of(
        found,
        {
            "number": lambda item: number_name(plant, item.name),
            "unit": lambda item: units.get(item.name, UNKNOWN),
            **({"method": lambda item: item.method} if several else {}),
            "value": lambda item: np.nan if item.value is None else float(item.value),
            "low": lambda item: float(item.low),
            "high": lambda item: float(item.high),
            "identified": lambda item: item.identified,
            "excludes_zero": lambda item: item.excludes_zero,
        },
    )
    level = 100 * found[0].level if found else 95
    caption = (
        f"The gain K of u = -K x with {level:.0f} % intervals, which allow for autocorrelated "
        "residuals. If an entry is not identified, the recordings may still determine its "
        "combinations with others."
    )
    return Finding("gain", table, caption, labels={"number": "Gain on"})


def direction_finding(result: FitResult) -> Finding:
    """Combinations of gain entries, ordered by how well the recordings determine them."""
    plant, covariance = result.fitted.problem.plant, result.estimate.covariance
    words = [signal_name(plant, state) for state in plant.states]
    names = tuple(
        word if plant.m == 1 else f"{word} to {signal_name(plant, control)}"
        for control in plant.controls
        for word in words
    )
    back = np.kron(np.array(covariance.G), np.linalg.inv(covariance.T).T)
    moved = (covariance.directions @ back.T) * np.tile(np.array(result.intent.sizes), plant.m)
    values, deviations = covariance.singular_values, covariance.deviations

    def written(k: int) -> str:
        """A sum of terms, largest first."""
        parts = moved[k] / np.linalg.norm(moved[k])
        order = [one for one in np.argsort(-np.abs(parts)) if abs(parts[one]) >= _NAMED]
        return " ".join(f"{parts[one]:+.2f} {names[one]}" for one in order)

    table = table_of(
        range(len(values)),
        {
            "direction": written,
            "relative_singular_value": lambda k: float(values[k] / values[0]),
            "standard_error": lambda k: float(deviations[k]),
            "identified": lambda k: bool(deviations[k] < IDENTIFIED),
        },
    )
    caption = (
        "Combinations of entries of the gain, best determined first, as commands at typical "
        "states. The standard error is relative to the largest gain that can be optimal: 1 means "
        f"practically unknown, above {IDENTIFIED:g} not identified."
    )
    return Finding("directions", table, caption, digits=2)


def parameter_findings(result: FitResult) -> list[Finding]:
    """Table of the physical parameters that were fitted with the gain, if any."""
    if not result.parameters:
        return []
    table = table_of(
        result.parameters,
        {
            "parameter": lambda item: item.name,
            "nominal": lambda item: float(item.nominal),
            "fitted": lambda item: float(item.value),
            "standard_error": lambda item: float(item.deviation),
            "stated_deviation": lambda item: np.nan if item.stated is None else item.stated,
            "moved_by_deviations": lambda item: float(item.pull),
            "share_of_the_gains_variance_percent": lambda item: 100 * float(item.share),
            "identified": lambda item: item.determined,
        },
    )
    caption = (
        "Physical parameters fitted with the gain, in SI units. A stated deviation is a prior "
        "around the nominal value; a parameter without one is free. Share: reduction of the "
        "variance of the gain if the parameter were measured exactly."
    )
    return [Finding("parameters", table, caption)]


def alternative_findings(result: FitResult) -> list[Finding]:
    """Table of other horizons, and of no limit, if requested."""
    found = result.uncertainty.alternatives
    if not found:
        return []
    columns: dict[str, Callable[[Alternative], Any]] = {
        "fit": lambda item: item.name,
        "horizon": lambda item: int(item.horizon),
        "aic_above_the_least": lambda item: float(item.aic),
        "left_out_vaf": lambda item: float(item.held_out),
    }
    if any(item.reason for item in found):
        columns["note"] = lambda item: item.reason
    # Burnham and Anderson (2002, 70); all alternatives fit equally many numbers.
    caption = (
        "The same recordings with other horizons and without limit. AIC: difference to the "
        "smallest; below 2 the recordings do not distinguish two fits, above 10 they rule out the "
        "worse one. VAF (%): in left-out trials."
    )
    return [Finding("alternatives", table_of(found, columns), caption)]


def number_name(plant: Plant, name: str) -> str:
    """Name in words of a fitted number such as K.command.theta1."""
    kind, _, rest = name.partition(".")
    if name not in number_units(plant):
        return name
    if kind == "u_max":
        return f"limit of {signal_name(plant, rest)}"
    control = next(one for one in plant.controls if rest.startswith(f"{one}."))
    state = signal_name(plant, rest.removeprefix(f"{control}."))
    return state if plant.m == 1 else f"{state} to {signal_name(plant, control)}"


def number_units(plant: Plant) -> dict[str, str]:
    """Units of the fitted numbers by name: K.<control>.<state>, u_max.<control>."""
    return methods_table.gain_units(plant) | {
        f"u_max.{control}": plant.unit(control) for control in plant.controls
    }


def result_long(result: FitResult) -> list[dict[str, Any]]:
    """Rows of the long table: numbers with intervals (method "estimate"), and all methods."""
    plant, label = result.given.plant, result.given.recordings[0].label
    words = {name: getattr(label, name) for name in ("subject", "visit", "condition")}
    values: dict[str, Any] = {"saturated": result.saturated}
    for name, item in result.preferred.items():
        quantity, dot, place = name.partition(".")
        own = ("", item.value), ("_low", item.low), ("_high", item.high)
        for end, value in (*own, ("_identified", item.identified)):
            values[f"{quantity}{end}{dot}{place}"] = value
    labels = {**words, "method": "estimate"}
    return long_rows(values, number_units(plant), labels) + methods_table.methods_long(
        result.methods
    )


def read_truth(recordings: Iterable[Path], plant: Plant) -> Array | None:
    """Gain (m, n) in the truth.json next to the recordings; None if there is none."""
    folders = {path.absolute().parent for path in recordings}
    said = truth_beside(folders.pop()) if len(folders) == 1 else {}
    try:
        states, gain = tuple(said["states"]), np.array(said["K"], dtype=np.float64)
    except (ValueError, KeyError, TypeError):  # no truth.json, or not one of impc
        return None
    return gain if states == plant.states and gain.shape == (plant.m, plant.n) else None


def truth_found(result: FitResult, truth: Array) -> tuple[bool, str]:
    """Whether all gain entries of the truth (m, n) lie inside their intervals, in words too."""
    values = zip(entry_names(result.given.plant), truth.ravel(), strict=True)
    pairs = [(result.preferred[name], one) for name, one in values if name in result.preferred]
    if not pairs:
        return True, "The recordings are simulated, but there is no estimated gain to compare."
    inside = sum(item.low <= value <= item.high for item, value in pairs)
    level = 100 * pairs[0][0].level
    return inside == len(pairs), (
        f"The recordings are simulated: {inside} of the {len(pairs)} entries of their true gain "
        f"lie inside their {level:.0f} % intervals."
    )


def agreement_finding(result: FitResult) -> Finding:
    """Table of trials: length, VAF, whiteness, time at the limit."""
    plant, rows, labels = result.given.plant, [], {"length_s": "Length (s)"}
    for index, trial in enumerate(result.trials):
        row: dict[str, object] = {"trial": trial_name(result, index)}
        row["length_s"] = result.given.recordings[index].samples * plant.dt
        each = result.inverse_mpc.held_out
        held = each[index] if len(each) else np.full(len(trial.vaf), np.nan)
        for column, name in enumerate(plant.outputs):
            words = signal_name(plant, name)
            for key, label, value in (
                (f"vaf_{name}_percent", f"VAF, {words} (%)", trial.vaf[column]),
                (f"left_out_vaf_{name}_percent", f"Left-out VAF, {words} (%)", held[column]),
                (f"p_{name}", f"p, uncorrelated residual, {words}", trial.whiteness[column]),
            ):
                row[key], labels[key] = float(value), label
        rows.append(row | {"time_at_the_limit_percent": 100 * float(trial.saturated)})
    table = pd.DataFrame(rows).dropna(axis="columns", how="all")
    caption = "Variance accounted for (VAF). Left-out: predicted from the other trials."
    return Finding("agreement", table, caption, labels=labels, digits=4)


def error_findings(result: FitResult) -> list[Finding]:
    """Table of the fitted errors of signals, if requested."""
    problem, rows, found = result.estimate.problem, [], shift_halves(result)
    for kind, name, values in problem.fitted_errors:
        factor, unit = error_unit(problem.plant, kind, name)
        signal, none = signal_name(problem.plant, name), np.full(len(values), np.nan)
        halves = found.get(name, none) if kind == "shift" else none
        for index, (value, half) in enumerate(zip(values, halves, strict=True)):
            ends = factor * (value - half), factor * (value + half)
            rows.append((trial_name(result, index), signal, kind, unit, factor * value, *ends))
    heads = ["trial", "signal", "error", "unit", "value", "low", "high"]
    table = pd.DataFrame(rows, columns=heads).dropna(axis="columns", how="all")
    caption = "Errors of the recorded signals, estimated with the gain in each trial."
    return [Finding("signal_errors", table, caption, folded="Errors of signals")] if rows else []


def trajectory_finding(result: FitResult) -> Finding:
    """Recorded and modelled signals of the trials on the page, one row per sample."""
    names = {index: trial_name(result, index) for index in shown_trials(result)}
    runs = {"simulated": result.inverse_mpc.runs}
    table = methods_table.trajectory_table(result.fitted.problem, names, runs)
    return Finding("trajectories", table, "Recorded and modelled signals, one row per sample.")


def response_findings(result: FitResult) -> list[Finding]:
    """Table of the frequency response."""
    found, plant = result.response, result.given.plant
    if found is None:
        return []
    drive, rows = shown_unit(plant, found.signal)[0], []
    for column, name in enumerate(plant.outputs):
        factor = shown_unit(plant, name)[0] / drive
        for k, frequency in enumerate(found.frequencies):
            rows.append(
                (float(frequency), signal_name(plant, name),
                 factor * float(found.recorded[k, column]),
                 factor * float(found.modelled[k, column]),
                 float(found.recorded_phase[k, column]), float(found.modelled_phase[k, column]),
                 float(found.coherence[k, column]))
            )  # fmt: skip
    heads = ["frequency_hz", "output", "magnitude_recorded", "magnitude_model",
             "phase_recorded_deg", "phase_model_deg", "coherence"]  # fmt: skip
    table = pd.DataFrame(rows, columns=heads)
    caption = "Frequency response from the perturbation to the movement."
    return [Finding("frequency_response", table, caption)]


def weight_findings(result: FitResult) -> list[Finding]:
    """Tables of comparisons of cost, and of the reported weights."""
    summary, plant = result.uncertainty.weights, result.given.plant
    if summary is None:
        return [weight_finding(result)]
    table = table_of(
        sorted(summary.statements, key=lambda item: (not item.made, item.holds is None)),
        {
            "comparison": lambda item: statement_text(plant, item),
            "verdict": lambda item: (
                "undecided: weights with the fitted gain differ"
                if item.holds is None
                else "decided"
                if item.made
                else "undecided: other possible gains differ"
            ),
            "other_gains_that_agree_percent": lambda item: (
                np.nan if item.confidence is None else 100 * float(item.confidence)
            ),
            "low": lambda item: float(item.low),
            "high": lambda item: float(item.high),
        },
    )
    caption = (
        "Low and high: range of the difference in cost, or of the cross weight, relative to the "
        "cost of the state named first, at typical sizes, over all weights with the fitted gain."
    )
    if summary.drawn:
        caption += f" {summary.drawn} other gains were tried; a comparison is decided if at most "
        caption += "one of them disagrees."
    return [Finding("statements", table, caption), weight_finding(result)]


def weight_finding(result: FitResult) -> Finding:
    """Table of the reported weights, with ranges if they were computed."""
    plant, weights = result.given.plant, result.intent.reported.weights
    summary = result.uncertainty.weights
    # Ranges are at trace R = m: with one command the same scale as the entries.
    ranged = summary.entries if summary is not None and plant.m == 1 else ()
    ranges = {frozenset((item.first, item.second)): (item.low, item.high) for item in ranged}
    none = (np.nan, np.nan)
    rows = [
        (*entry, *(ranges.get(frozenset(entry[1:3]), none) if entry[0] == "Q" else none))
        for entry in methods_table.weight_entries(plant, weights)
    ]
    heads = ["matrix", "first", "second", "unit", "value", "low", "high"]
    caption = (
        f"Cost weights at R = 1, set by convention ({result.intent.reported.rule}). Low and high: "
        "over all weights with this gain."
    )
    table = pd.DataFrame(rows, columns=heads)
    pairs = zip(table["first"], table["second"], strict=True)
    words = [
        " with ".join(dict.fromkeys(signal_name(plant, one) for one in pair)) for pair in pairs
    ]
    table.insert(1, "entry", words)
    return Finding("weights", table, caption, hidden=("first", "second"))
