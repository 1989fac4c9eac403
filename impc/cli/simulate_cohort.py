"""`impc simulate cohort`: two groups of simulated subjects with different cost weights."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from impc.cli.options import Number, out_option, seed_option
from impc.cli.seat import (
    HORIZON,
    SIGNALS,
    STEP,
    TORQUE,
    numbered,
    random_person,
    seat_controller,
    seat_table,
    write_study,
)

if TYPE_CHECKING:
    import numpy as np

_RATE = 100.0
# Integration steps between two samples: one step of 10 ms is inaccurate in the delay states.
_WITHIN = 10
# SD of the recorded angles, degrees: 0.1 degrees at 1000 samples/s, averaged to 100 samples/s.
_NOISE = 0.03
_STOP = 12.0  # deg
_LIMIT = f"limit = {_STOP}\n"
# SD of the logarithm of the cost weights between subjects, and between visits of one subject.
_BETWEEN, _AGAIN = 0.2, 0.05


@click.command("cohort")
@out_option("cohort-data", "the recordings, study.toml, participants.tsv and truth.json")
@click.option(
    "--subjects", type=click.IntRange(2, 9999), default=30, help="Number in both groups together."
)
@click.option("--visits", type=click.IntRange(1, 9), default=1, help="Per subject.")
@click.option("--trials", type=click.IntRange(1, 9), default=3, help="Per visit.")
@click.option("--duration", type=Number(5, 600), default=30.0, help="Of each trial, s.")
@click.option(
    "--difference",
    type=Number(min=0.05, max=20),
    default=0.4,
    help="Ratio of the cost weights of angles and rates, second group to first; 1: no difference.",
)
@click.option(
    "--torque-limit",
    type=Number(min=1, max=1e6),
    default=6.0,
    help="Largest lumbar torque of a subject, N m.",
)
@click.option(
    "--motor-noise",
    type=Number(min=0, max=1e6),
    default=0.0,
    help="Standard deviation of the noise on the torque, N m; a fit treats it as recording noise.",
)
@click.option(
    "--replicates",
    type=click.IntRange(0, 1_000_000),
    default=20,
    help="Bootstrap replicates, written to study.toml.",
)
@seed_option
def cohort(out: Path, **given: Any) -> None:
    """Simulate two groups of seated subjects, in folders with BIDS names.

    The groups differ only in the cost weights of angles and rates relative to torque. Body mass and
    height differ between subjects, cost weights between subjects and visits. 100 samples a second.
    """
    import numpy as np  # noqa: PLC0415

    from impc.reporting.writer import require_writable, write_files  # noqa: PLC0415
    from impc.studies.fit.settings import fit_settings  # noqa: PLC0415

    fit_settings({"replicates": given["replicates"]})  # fail here if `impc cohort` would
    require_writable(out)
    rng = np.random.default_rng(given["seed"])
    rows = ["participant_id\tgroup\tmass\theight\tsex"]
    truth: dict[str, Any] = {}
    for number, name in enumerate(numbered(given["subjects"])):
        group = "first" if number < (given["subjects"] + 1) // 2 else "second"
        person = random_person(rng)
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
    write_study(out, "cohort", _study(given), everything, participants_tsv=people)


def _visit(
    name: str,
    visit: int,
    person: dict[str, Any],
    cost_weight: float,
    given: dict[str, Any],
    rng: np.random.Generator,
) -> tuple[dict[str, bytes], list[list[float]], dict[str, float]]:
    """All trials of a visit as files, the true gain, and the times of falls by file."""
    import numpy as np  # noqa: PLC0415

    from impc.files.formats import encode_table  # noqa: PLC0415
    from impc.files.plant_sources import import_function, plant_source  # noqa: PLC0415
    from impc.studies.simulated_people import simulate_subject  # noqa: PLC0415

    controller = seat_controller(person, given["torque_limit"], cost_weight)
    step = plant_source(STEP, person | {"sample_time": 1 / (_WITHIN * _RATE)})
    make, torque = step.make(**step.arguments), import_function(TORQUE)
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
        table = seat_table(file, np.degrees(trial.outputs[::_WITHIN]), pushed, _RATE)
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

{SIGNALS.replace("LIMIT", _LIMIT)}
[fit]
horizon = {HORIZON}                     # samples of 0.01 s
u_max = {given["torque_limit"]}                      # N m
held_out = false
replicates = {given["replicates"]}
"""
