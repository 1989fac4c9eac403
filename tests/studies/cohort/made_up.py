"""Made-up study and results without recordings, for tests of folders and pages."""

from __future__ import annotations

from typing import Any

import control
import numpy as np

from impc.assess.assessments import ASSESSMENTS, Assessment
from impc.files.configuration import Configuration, RecordingTable
from impc.model.plant import Plant
from impc.studies.cohort.study import Study, Unit
from impc.studies.cohort.tasks import FitTask

__all__ = ["fit_of", "made_up_study", "replicate_of", "tasks_of"]


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


def made_up(item: Assessment, rng: np.random.Generator) -> dict[str, float] | float:
    """A made-up VAF of about 98 %."""
    plant = Plant(
        control.ss(
            [[1, 0.1], [0, 1]],
            [[0], [0.1]],
            [[1, 0]],
            0,
            0.1,
            inputs=["force"],
            outputs=["position"],
        )
    )
    names = item.signals(plant)
    values = [98.0 + rng.random() for _ in names]
    return values[0] if names == ("",) else dict(zip(names, values, strict=True))


def fit_of(seed: int) -> dict[str, Any]:
    """Made-up return value of `impc.studies.cohort.tasks.fit_unit`."""
    rng = np.random.default_rng(seed)
    gain = [rng.standard_normal(2).tolist()]
    weights = {"Q": [[1.0, 0.0], [0.0, 2.0]], "dominant": [0.6, 0.8], "angle": 1.0}
    return {
        "states": ["position", "position_rate"], "controls": ["force"], "outputs": ["position"],
        "shown_units": [[1.0, "m"]], "words": {"position": "hand position"},
        "verdict": {"level": "green", "headline": "It fits.", "sentence": "Well.", "kind": ""},
        "added": None,
        "units": {"K.force.position": "N/m", "K.force.position_rate": "N s/m"},
        "shown_gains": {
            "K.force.position": [1.0, "N/m", "N", "1 m of hand position"],
            "K.force.position_rate": [1.0, "N s/m", "N", "1 m/s of hand velocity"],
        },
        "inner": [],
        "trials": 2, "samples": 100, "K": gain, "K_deviation": [[0.1, None]],
        "K_low": [[gain[0][0] - 0.2, None]], "K_high": [[gain[0][0] + 0.2, None]],
        "K_identified": [[True, False]], "K_determined": [[True, False]],
        "K_of_weights": gain, "S": [[1.0]],
        "Q": weights["Q"], "R": [[1.0]], "misfit": 0.1, "exact": True, "converged": True,
        **{item.name: made_up(item, rng) for item in ASSESSMENTS.values()},
        "held_out_vaf": {"position": None}, "largest_input": {"force": 1.0}, "beyond_bound": 0.0,
        "first_fall": None, "condition_number": 10.0,
        "saturated": 0.1, "state_sizes": [1.0, 1.0],
        "readings": {"least condition": weights, "analytic centre (no units)": weights},
        "parameters": {"mass": 2.0 + rng.random()}, "starts": [[0.0, 0.0]], "logarithms": [0.0],
        "errors": [[[0.0]] * 5],
        "findings": [[]],
        "trajectory": {"dt": 0.1, "recorded": [[0.0], [1.0]], "simulated": [[0.0], [0.9]]},
        "seconds": 0.1, "memory_mb": 100.0,
    }  # fmt: skip


def replicate_of(seed: int) -> dict[str, Any]:
    """Made-up return value of `impc.studies.cohort.tasks.replicate_unit`."""
    rng = np.random.default_rng([seed, 1])
    return {
        "K": [rng.standard_normal(2).tolist()], "parameters": [2.0 + rng.random()],
        "seconds": 0.1, "memory_mb": 100.0,
    }  # fmt: skip
