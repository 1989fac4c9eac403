"""Seated subject: functions shared by the commands that simulate one."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np

from impc.arrays import Array
from impc.cli.console import print_next, progress
from impc.control.controller import Controller
from impc.files.plant_sources import make_plant, plant_source
from impc.files.table import Table, make_table
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.weights import Weights
from impc.reporting.writer import write_files

#: Import paths of the linear plant, and of the time step of the nonlinear one.
PLANT, STEP = "plants:seated_balance_for", "plants:seated_balance_step_for"
#: Import path of the perturbation torque on the seat.
TORQUE = "plants:ternary_torque"
#: Horizon of the controller, in samples of 0.01 s.
HORIZON = 20
#: Configuration of the columns that `seat_table` writes.
SIGNALS = """\
[signals.theta1]
column = "seat_angle"
unit = "deg"
LIMIT
[signals.theta2]
column = "trunk_angle"
unit = "deg"

[signals.perturbation]
column = "perturbation"
unit = "N*m"
"""


def random_person(rng: np.random.Generator) -> dict[str, Any]:
    """Body mass (kg), height (m) and sex of an adult, drawn from `rng`."""
    sex = "male" if rng.random() < 0.5 else "female"
    height = rng.normal(1.76 if sex == "male" else 1.63, 0.06)
    mass = rng.normal(23.0, 2.0) * height**2
    return {"mass": round(float(mass), 1), "height": round(float(height), 3), "sex": sex}


def numbered(subjects: int) -> Iterator[str]:
    """Yield the names 01, 02, ... of the `subjects`, with a progress bar."""
    width = max(2, len(str(subjects)))
    with progress(subjects, "subject") as done:
        for number in range(1, subjects + 1):
            yield f"{number:0{width}d}"
            done("")


def seat_weights(plant: Plant, cost_weight: float = 1.0) -> Weights:
    """True weights: Q is almost one direction of angles and rates, scaled by `cost_weight`."""
    v = np.array([0.70, 0.65, 0.22, 0.20])
    v /= np.linalg.norm(v)
    Q = 1e-2 * np.eye(plant.n)
    Q[:4, :4] = cost_weight * (6e5 * np.outer(v, v) + np.diag([2e4, 2e4, 500, 500]))
    return Weights(Q, 1)


def seat_controller(person: dict[str, Any], limit: float, cost_weight: float = 1.0) -> Controller:
    """Controller of a `person`: torque `limit` (N m), `cost_weight` of angles and rates."""
    plant = make_plant(plant_source(PLANT, person), ("perturbation",))
    bounds = Bounds(plant, u_min=-limit, u_max=limit)
    return Controller(plant, seat_weights(plant, cost_weight), bounds, HORIZON, terminal_set=False)


def between_samples(torque: Array) -> Array:
    """Mean of `torque` (samples,) between neighbouring samples: linear interpolation.

    Recordings are read with the same interpolation (docs/howto/recordings.md). A torque held over
    each sample would act half a sample late and bias the fitted gain.
    """
    return np.asarray((torque + np.append(torque[1:], torque[-1])) / 2)


def seat_table(name: str, degrees: Array, torque: Array, rate: float) -> Table:
    """Table of a trial: angles in `degrees` (samples, 2), `torque` in N m, `rate` in Hz."""
    columns = {
        "time": np.arange(len(torque)) / rate,
        "seat_angle": degrees[:, 0],
        "trunk_angle": degrees[:, 1],
        "perturbation": torque,
    }
    units = {"time": "s", "seat_angle": "deg", "trunk_angle": "deg", "perturbation": "Nm"}
    return make_table(name, columns, units=units, rate=rate)


def write_study(out: Path, command: str, study: str, truth: dict[str, Any], **more: str) -> None:
    """Write study.toml, truth.json and `more` files (`stem_ending`); print the next command."""
    texts = {"study.toml": study, "truth.json": json.dumps(truth, indent=1) + "\n"}
    texts |= {name.replace("_", "."): text for name, text in more.items()}
    write_files(out, {name: text.encode() for name, text in texts.items()})
    subjects, visits = len(truth["subjects"]), truth["settings"]["visits"]
    click.echo(f"{subjects} subjects, {visits} visits: {out / 'study.toml'}")
    print_next(f"impc {command} {{}}", out, "study.toml")
