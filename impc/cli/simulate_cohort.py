"""`impc simulate cohort`: two groups of simulated subjects with different cost weights."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np

from impc.cli import seat
from impc.files.formats import encode_table
from impc.files.plant_sources import import_function, plant_source
from impc.reporting.writer import write_files
from impc.studies.fit.settings import fit_settings
from impc.studies.simulated_people import simulate_subject

_RATE = 100.0
# Integration steps between two samples: one step of 10 ms is inaccurate in the delay states.
_WITHIN = 10
# SD of the recorded angles, degrees: 0.1 degrees at 1000 samples/s, averaged to 100 samples/s.
_NOISE = 0.03
_STOP = 12.0  # deg
_LIMIT = f"limit = {_STOP}\n"
# SD of the logarithm of the cost weights between subjects, and between visits of one subject.
_BETWEEN, _AGAIN = 0.2, 0.05


def run_cohort(out: Path, **given: Any) -> None:
    """Simulate a cohort and write all files."""
    fit_settings({"replicates": given["replicates"]})  # fail here if `impc cohort` would
    rng = np.random.default_rng(given["seed"])
    rows = ["participant_id\tgroup\tmass\theight\tsex"]
    truth: dict[str, Any] = {}
    for number, name in enumerate(seat.numbered(given["subjects"])):
        group = "first" if number < (given["subjects"] + 1) // 2 else "second"
        person = seat.random_person(rng)
        row = (group, person["mass"], person["height"], person["sex"])
        rows.append("\t".join([f"sub-{name}", *map(str, row)]))
        factor = given["difference"] if group == "second" else 1.0
        factor *= float(np.exp(_BETWEEN * rng.standard_normal()))
        truth[name] = {"group": group, "gain": {}}
        for visit in range(1, given["visits"] + 1):
            cost_weight = factor * float(np.exp(_AGAIN * rng.standard_normal()))
            files, gain, falls = _visit(name, visit, person, cost_weight, given, rng)
            truth[name]["gain"][str(visit)] = gain
            truth[name].setdefault("fell", {}).update(falls)
            for file, when in falls.items():
                click.echo(f"{file}: the subject fell at {when:.2f} s")
            write_files(out / f"sub-{name}" / f"ses-{visit}", files)
    everything = {"settings": given, "subjects": truth}
    people = "\n".join(rows) + "\n"
    seat.write_study(out, "cohort", _study(given), everything, participants_tsv=people)


def _visit(
    name: str,
    visit: int,
    person: dict[str, Any],
    cost_weight: float,
    given: dict[str, Any],
    rng: np.random.Generator,
) -> tuple[dict[str, bytes], list[list[float]], dict[str, float]]:
    """All trials of a visit as files, the true gain, and the times of falls by file."""
    controller = seat.seat_controller(person, given["torque_limit"], cost_weight)
    step = plant_source(seat.STEP, person | {"sample_time": 1 / (_WITHIN * _RATE)})
    make, torque = step.make(**step.arguments), import_function(seat.TORQUE)
    files, falls = {}, {}
    for run in range(1, given["trials"] + 1):
        pushed = torque(duration=given["duration"], rate=_RATE, seed=int(rng.integers(2**31)))
        # Held over each sample: recordings at the controller's rate are read without interpolation.
        trial = simulate_subject(
            controller,
            make,
            np.repeat(pushed, _WITHIN),
            rate=_WITHIN * _RATE,
            motor=given["motor_noise"],
            sensor=np.radians(_NOISE),
            seed=int(rng.integers(2**31)),
        )
        file = f"sub-{name}_ses-{visit}_task-seat_run-{run}_motion"
        table = seat.seat_table(file, np.degrees(trial.outputs[::_WITHIN]), pushed, _RATE)
        files[f"{file}.csv"] = encode_table(".csv", table)
        beyond = np.abs(trial.outputs[:, 0]) > np.radians(_STOP)
        if beyond.any():  # beyond the mechanical stop that study.toml names
            falls[file] = float(trial.time[np.argmax(beyond)])
    return files, np.array(controller.K).tolist(), falls


def _study(given: dict[str, Any]) -> str:
    return f"""\
# A simulated cohort: `impc cohort study.toml --out DIR`. truth.json holds the true values.
[study]
plant = "seated-balance"
bids = "."                       # folders and files that are named sub-, ses-, task-, run-
participants = "participants.tsv"

[recording]
time = "time"

{seat.SIGNALS.replace("LIMIT", _LIMIT)}
[fit]
horizon = {seat.HORIZON}                     # samples of 0.01 s
u_max = {given["torque_limit"]}                      # N m
held_out = false
replicates = {given["replicates"]}
"""
