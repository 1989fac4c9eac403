"""Made-up study and results without recordings, for tests of folders and pages."""

from __future__ import annotations

from typing import Any

import numpy as np

from impc.files.configuration import Configuration, RecordingTable
from impc.studies.cohort.study import Study, Unit
from impc.studies.cohort.tasks import FitTask

__all__ = ["column", "fit_of", "gain_column", "made_up_study", "replicate_of", "tasks_of"]


def made_up_study(subjects: int, replicates: int = 0) -> Study:
    """Subjects 1, 2, ... of one visit in two groups."""
    configuration = Configuration(RecordingTable(), {}, fit={"replicates": replicates})
    units = tuple(
        Unit(str(number + 1), "1", "", (), "ab"[number % 2]) for number in range(subjects)
    )
    return Study("plants:cursor_plant", configuration, units)


def tasks_of(study: Study) -> dict[str, FitTask]:
    """A task for each unit; its digest is the reversed name."""
    return {
        unit.name: FitTask((), study.plant, {}, study.configuration, unit.name[::-1])
        for unit in study.units
    }


def fit_of(seed: int) -> dict[str, Any]:
    """Made-up return value of `impc.studies.cohort.tasks.fit_unit`."""
    rng = np.random.default_rng(seed)
    gain, verdict = rng.standard_normal(2).tolist(), {"level": "green", "headline": "It fits."}
    row: dict[str, Any] = {
        **verdict, "kind": "", "trials": 2, "samples": 100, "vaf.position": 98.0 + rng.random(),
        "held_out_vaf.position": None, "saturated": 0.1,
    }  # fmt: skip
    rate = [gain[1], None, None, None, False, False]
    for state, values in (
        ("position", [gain[0], 0.1, gain[0] - 0.2, gain[0] + 0.2, True, True]),
        ("position_rate", rate),
    ):
        heads = ("K", "K_deviation", "K_low", "K_high", "K_identified", "K_determined")
        row |= {f"{head}.force.{state}": one for head, one in zip(heads, values, strict=True)}
    return {
        "verdict": {**verdict, "sentence": "Well."},
        "row": row | {"mass": 2.0 + rng.random()},
        "shown": {
            "K.force.position": gain_column("hand position", "force", "N/m", 1.0, "N", "1 m"),
            "K.force.position_rate": gain_column("rate", "force", "N s/m", 1.0, "N", "1 m/s"),
            "vaf.position": column("variance accounted for, hand position", "hand position", "%"),
        },
        "added": None, "K": [gain], "S": [[1.0]], "starts": [[0.0, 0.0]], "logarithms": [0.0],
        "errors": [[[0.0]] * 5], "parameters": ["mass"], "findings": [[]],
        "trajectory": {"dt": 0.1, "signals": [
            {"label": "Hand position (m)", "recorded": [0.0, 1.0], "simulated": [0.0, 0.9]},
        ]},
        "seconds": 0.1, "memory_mb": 100.0,
    }  # fmt: skip


def column(name: str, signal: str, unit: str) -> dict[str, Any]:
    """Words and units of a compared column of units.csv."""
    return {
        "name": name, "signal": signal, "scale": 1.0, "unit": unit, "unit_si": unit,
        "compared": True,
    }  # fmt: skip


def gain_column(
    signal: str, control: str, unit: str, scale: float, top: str, per: str
) -> dict[str, Any]:
    """Words and units of a gain on a state, in SI units `unit`."""
    return column(f"gain on {signal}", signal, unit) | {
        "scale": scale, "unit": unit.replace("rad", "°"), "control": control, "top": top,
        "per": f"{per} of {signal}", "inner": False,
    }  # fmt: skip


def replicate_of(seed: int) -> dict[str, Any]:
    """Made-up return value of `impc.studies.cohort.tasks.replicate_unit`."""
    rng = np.random.default_rng([seed, 1])
    return {
        "K": [rng.standard_normal(2).tolist()], "parameters": [2.0 + rng.random()],
        "seconds": 0.1, "memory_mb": 100.0,
    }  # fmt: skip
