"""`impc simulate reliability-study` and `impc simulate head-tracking`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import scipy.signal

from impc.arrays import Array
from impc.cli import seat
from impc.files.formats import encode_table
from impc.files.plant_sources import import_function, make_plant, plant_source
from impc.files.table import make_table
from impc.model.plant import Plant
from impc.model.riccati import solve_lqr
from impc.reporting.writer import write_files
from impc.studies.selection.model_source import model_source

_RATE = 100.0
# 242 steps of 0.12 s are one period of the ternary sequence: a line spectrum without leakage.
_DWELL, _DURATION = 0.12, 242 * 0.12
# Factor of the cost weights of angles and rates, SD of the torque noise (N m), SD of the recording
# noise of both angles (degrees): eyes open, eyes closed, vibration of the trunk muscles.
_CONDITIONS = {
    "EO": (1.0, 4.0, (0.10, 0.30)),
    "EC": (0.6, 6.0, (0.12, 0.40)),
    "VIB": (0.75, 7.0, (0.15, 0.60)),
}
# SD of logarithms: of cost weights and of sway between subjects, of both between visits, of sway
# between trials; change of the log sway at each visit (learning).
_COST_WEIGHT, _SWAY, _AT_A_VISIT, _TRIAL, _LEARNING = 0.8, 0.4, 0.25, 0.10, -0.03
# SD of the mean lean of seat and trunk at a visit, degrees; RMS about upright includes it.
_LEAN = (0.1, 0.8)


def run_reliability_study(out: Path, **given: Any) -> None:
    """Simulate a reliability study and write all files."""
    rng = np.random.default_rng(given["seed"])
    torque = np.asarray(
        import_function(seat.TORQUE)(dwell=_DWELL, duration=_DURATION, rate=_RATE), dtype=np.float64
    )
    truth: dict[str, Any] = {}
    for name in seat.numbered(given["subjects"]):
        plant = make_plant(plant_source(seat.PLANT, seat.random_person(rng)), ("perturbation",))
        cost_weight, sway = np.exp(np.array([_COST_WEIGHT, _SWAY]) * rng.standard_normal(2))
        truth[name] = {"cost_weight": float(cost_weight), "sway": float(sway)}
        for visit in range(given["visits"]):
            files: dict[str, bytes] = {}
            lean = np.array(_LEAN) * rng.standard_normal(2)
            for condition in _CONDITIONS:
                here, level = np.exp(_AT_A_VISIT * rng.standard_normal(2)) * (cost_weight, sway)
                level *= float(np.exp(_LEARNING * visit))
                cell = _cell(plant, torque, condition, (float(here), level), lean, given, rng)
                stem = f"sub-{name}_ses-{visit + 1}_task-{condition}"
                for run, content in enumerate(cell, 1):
                    files[f"{stem}_run-{run}_motion.csv"] = content
            write_files(out / f"sub-{name}" / f"ses-{visit + 1}", files)
    settings = {
        "cost_weight": _COST_WEIGHT, "sway": _SWAY, "visit": _AT_A_VISIT, "trial": _TRIAL,
        "learning": _LEARNING, "lean": _LEAN, "conditions": _CONDITIONS, **given,
    }  # fmt: skip
    study = _SEAT_STUDY + seat.SIGNALS.replace("LIMIT", "")
    seat.write_study(out, "reliability", study, {"settings": settings, "subjects": truth})


def _cell(
    plant: Plant,
    torque: Array,
    condition: str,
    size: tuple[float, float],
    lean: Array,
    given: dict[str, Any],
    rng: np.random.Generator,
) -> list[bytes]:
    """Files of all trials of one subject, visit and condition."""
    (cost_weight, sway), (factor, own, noise) = size, _CONDITIONS[condition]
    K = solve_lqr(plant, seat.seat_weights(plant, factor * cost_weight)).K
    files = []
    for _ in range(given["trials"]):
        here = own * sway * float(np.exp(_TRIAL * rng.standard_normal()))
        outputs = lean + np.degrees(_simulated(plant, K, torque, here, rng))
        outputs += np.array(noise) * rng.standard_normal(outputs.shape)
        table = seat.seat_table("trial", outputs, torque, _RATE)
        files.append(encode_table(".csv", table))
    return files


def _simulated(
    plant: Plant, K: Array, torque: Array, sway: float, rng: np.random.Generator
) -> Array:
    """Outputs of x+ = (A - BK) x + E d + B w in the second period of the torque."""
    driven = np.concatenate([torque, torque])
    # Sway: noise on the torque with a time constant of 0.5 s.
    white = rng.standard_normal((len(driven), plant.m))
    root = np.exp(-1 / (0.5 * _RATE))
    own = sway * scipy.signal.lfilter([np.sqrt(1 - root**2)], [1.0, -root], white, axis=0)
    F, drive = plant.A - plant.B @ K, driven[:, None] @ plant.E.T + own @ plant.B.T
    x, states = np.zeros(plant.n), np.empty((len(driven), plant.n))
    for k in range(len(driven)):
        states[k] = x
        x = F @ x + drive[k]
    return np.asarray(states[len(torque) :] @ plant.C.T)


_SEAT_STUDY = """\
# A simulated reliability study: `impc reliability study.toml --out DIR`.
[study]
plant = "seated-balance"
bids = "."                       # folders and files that are named sub-, ses-, task-, run-

[recording]
time = "time"

"""


_MODEL, _STEPS = "plants:head_neck_model", "plants:step_reference"
_HEAD_RATE = 60.0
# SD of the logarithm of a parameter between subjects, and between visits of one subject; mean and
# SD of the VAF, % (table 4.3: 82.3 +- 7.7).
_SPREAD, _VISIT, _VAF = 0.25, 0.05, (82.3, 7.7)


def run_head_tracking(out: Path, **given: Any) -> None:
    """Simulate head tracking and write all files."""
    rng = np.random.default_rng(given["seed"])
    source = model_source(_MODEL, {"axis": given["axis"]})
    model, steps = source.model, import_function(_STEPS)
    low, high, typical = (np.array(item) for item in (model.low, model.high, model.typical))
    inside = (low + 1e-3 * (high - low), high - 1e-3 * (high - low))

    def drawn(about: Any, spread: float) -> Any:
        """Draw parameters around `about` until 30 s of tracking stay below 20 degrees."""
        while True:
            theta = np.clip(about * np.exp(spread * rng.standard_normal(model.size)), *inside)
            probe = model.simulate(theta, steps(30.0, _HEAD_RATE, seed=0)[:, None])
            if np.all(np.isfinite(probe)) and np.max(np.abs(probe)) < 20:
                return theta

    truth: dict[str, Any] = {}
    recordings: dict[str, Any] = {}
    for name in seat.numbered(given["subjects"]):
        own = drawn(typical, _SPREAD)
        truth[name] = dict(zip(model.names, own.tolist(), strict=True))
        for visit in range(1, given["visits"] + 1):
            theta = drawn(own, _VISIT) if given["visits"] > 1 else own
            here = dict(zip(model.names, theta.tolist(), strict=True))
            recordings[f"{name} visit {visit}"] = here
            vaf = float(np.clip(rng.normal(*_VAF), 60, 95)) / 100
            files = {}
            for run in range(1, given["trials"] + 1):
                reference = steps(given["duration"], _HEAD_RATE, seed=int(rng.integers(2**31)))
                head = model.simulate(theta, reference[:, None])[:, 0]
                noise = np.sqrt((1 / vaf - 1) * np.mean(head**2))
                columns = {
                    "time": np.arange(len(head)) / _HEAD_RATE,
                    "target": reference,
                    "head": head + noise * rng.standard_normal(len(head)),
                }
                units = {"time": "s", "target": "deg", "head": "deg"}
                table = make_table("trial", columns, units=units, rate=_HEAD_RATE)
                stem = f"sub-{name}_ses-{visit}_task-{given['axis']}_run-{run}_motion"
                files[f"{stem}.csv"] = encode_table(".csv", table)
            write_files(out / f"sub-{name}" / f"ses-{visit}", files)
    study = _HEAD_STUDY.replace("AXIS", given["axis"])
    found = {"settings": given, "subjects": truth, "recordings": recordings}
    seat.write_study(out, "select", study, found)


_HEAD_STUDY = """\
# Simulated head tracking: `impc select study.toml`, `impc key-parameters study.toml`.
[study]
model = "plants:head_neck_model"
bids = "."                       # folders and files that are named sub-, ses-, task-, run-

[model]
axis = "AXIS"

[recording]
time = "time"

[signals.reference]
column = "target"
unit = "deg"

[signals.head]
column = "head"
unit = "deg"

[select]
bound = 0.05
size = 5
replicates = 200
draw = "single"
"""
