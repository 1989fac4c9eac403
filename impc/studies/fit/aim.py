"""Targets, learned disturbances, errors of signals and recorded commands of a fit."""

from __future__ import annotations

from typing import Any

import numpy as np

from impc.model.foresight import physical_disturbances
from impc.model.signal_errors import KINDS
from impc.reporting.rendering import number
from impc.reporting.shown_units import error_unit, signal_name
from impc.studies.fit.asked import OBSERVER
from impc.studies.fit.result import FitResult


def aim_data(result: FitResult) -> dict[str, Any]:
    """`aim` in result.json: targets, observer rates (1/s), errors of signals, recorded commands."""
    problem = result.fitted.problem
    plant, trials = problem.plant, problem.recordings
    count = physical_disturbances(plant)
    learned = zip(plant.disturbances[:count], plant.observer[:count], strict=True)
    controls = plant.commands or plant.controls
    recorded = [np.any(np.isfinite(trial.commands), axis=0) for trial in trials]
    return {
        "targets": tuple(dict.fromkeys(name for trial in trials for name in trial.signals)),
        "ahead": plant.ahead,
        "observer_rate": {name: float(rate) for name, rate in learned if rate > 0},
        "errors": [
            {"kind": kind, "signal": name, "values": [float(one) for one in values]}
            for kind, name, values in problem.fitted_errors
        ],
        "commands": tuple(np.array(controls)[np.any(recorded, axis=0)].tolist()),
    }


def aim_sentences(result: FitResult) -> list[str]:
    """The contents of `aim_data` as a sentence; empty if the controller regulates to rest."""
    aim, plant = aim_data(result), result.fitted.problem.plant
    said = []
    if aim["targets"]:
        ahead = f", known {plant.ahead * plant.dt:.3g} s ahead" if plant.ahead else ""
        targets = " and ".join(signal_name(plant, name) for name in aim["targets"])
        said.append(f"the controller regulates to the target of {targets}{ahead}")
    for name, rate in aim["observer_rate"].items():
        how = "knows it at once"
        if np.isfinite(rate):
            fitted = (result.preferred.get(key) for key in (f"{OBSERVER}.{name}", OBSERVER))
            interval = next((item for item in fitted if item is not None), None)
            between = (
                f" (fitted, 95 %: {number(interval.low, 3)} to {number(interval.high, 3)})"
                if interval is not None
                else ""
            )
            how = f"learns it at a rate of {number(rate, 3)} 1/s{between}"
        said.append(f"it assumes that the {signal_name(plant, name)} persists and {how}")
    for kind, name, values in result.fitted.problem.fitted_errors:
        if kind == "shift":  # `shift_words`, with its interval
            continue
        factor, unit = error_unit(plant, kind, name)
        ends = f"{number(factor * min(values), 3)} to {number(factor * max(values), 3)} {unit}"
        said.append(f"the {signal_name(plant, name)} has {KINDS[kind][0]} in each trial, {ends}")
    if aim["commands"]:
        names = ", ".join(signal_name(plant, name) for name in aim["commands"])
        said.append(f"recorded commands ({names}) are fitted in addition to the outputs")
    text = "; ".join(said)
    return [f"{text[0].upper()}{text[1:]}."] if said else []
