"""`impc simulate seated-balance`: recordings of a simulated subject whose controller is known."""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from impc.arrays import frozen
from impc.checking import replace
from impc.cli import seat
from impc.cli.console import print_files, print_next
from impc.control.controller import Controller
from impc.extras import installed
from impc.files.formats import encode_table
from impc.files.plant_sources import import_function, plant_source
from impc.reporting.writer import write_files
from impc.studies.simulated_people import SubjectTrial, simulate_subject

if TYPE_CHECKING:
    from impc.output_feedback.observer import Observer

_FORMATS = ("csv", "tsv", "xlsx", "mat", "tdms", "c3d")
# Formats that need an optional library.
_LIBRARIES = {"tdms": "nptdms", "c3d": "c3d"}
_RATE = 1000.0
#: Signals that the simulated subject senses.
_SENSED = ("theta1", "theta2", "theta1_rate", "theta2_rate")
_STOP = "limit = 12.0                 # mechanical stop, in this unit\n"


def run_seated_balance(out: Path, formats: str | None, **given: Any) -> None:
    """Simulate a subject and write all files."""
    wanted = _wanted(formats)
    if given["motor_noise"] is None:
        given["motor_noise"] = 0.3 if given["observer"] else 0.0
    person = {key: given[key] for key in ("mass", "height", "sex")}
    controller = seat.seat_controller(person, given["torque_limit"])
    trials = _trials(controller, person, given)
    # One format: the trials are the same in all.
    names = [f"trial_{number}.{wanted[0]}" for number in range(1, len(trials) + 1)]
    files: dict[str, bytes] = {"subject.toml": _configuration(person, given, names).encode()}
    files["truth.json"] = (json.dumps(_truth(controller, given), indent=1) + "\n").encode()
    for number, trial in enumerate(trials, 1):
        files |= _encoded(f"trial_{number}", trial, wanted)
    written = write_files(out, files)
    for number, trial in enumerate(trials, 1):
        fell = "" if trial.fell is None else f", falls at {trial.fell:.2f} s"
        share = 100 * trial.saturated
        click.echo(f"trial {number}: at the torque limit for {share:.1f} % of the time{fell}")
    print_files(out, written)
    print_next("impc fit --config {}", out, "subject.toml")


def _wanted(formats: str | None) -> tuple[str, ...]:
    if formats is None:
        absent = {name for name, library in _LIBRARIES.items() if not installed(library)}
        if absent:
            remedy = "to write them too: pip install 'impc[formats]'"
            click.echo(f"without {', '.join(sorted(absent))}; {remedy}")
        return tuple(name for name in _FORMATS if name not in absent)
    wanted = tuple(part.strip() for part in formats.split(",") if part.strip())
    for name in wanted or ("",):
        if name not in _FORMATS:
            raise click.BadParameter(f"{name!r} is not one of {', '.join(_FORMATS)}")
    return wanted


def _trials(
    controller: Controller, person: dict[str, Any], given: dict[str, Any]
) -> list[SubjectTrial]:
    torque, step = import_function(seat.TORQUE), plant_source(seat.STEP, person).make(**person)
    seeds = np.random.SeedSequence(given["seed"]).spawn(given["trials"])
    length = {"amplitude": given["amplitude"], "duration": given["duration"], "rate": _RATE}
    recorded = [
        torque(**length, seed=given["seed"] * 100 + number) for number in range(1, 1 + len(seeds))
    ]
    trials = [
        simulate_subject(
            controller,
            step,
            seat.between_samples(pushed),
            rate=_RATE,
            motor=given["motor_noise"],
            sensor=np.radians(given["sensor_noise"]),
            person=_observer(controller, given),
            seed=seed,
        )
        for pushed, seed in zip(recorded, seeds, strict=True)
    ]
    return [
        replace(trial, disturbance=frozen(pushed[:, None]))
        for trial, pushed in zip(trials, recorded, strict=True)
    ]


def _observer(controller: Controller, given: dict[str, Any]) -> Observer | None:
    """The subject's observer, if --observer is given."""
    from impc.output_feedback.observer import Observer  # noqa: PLC0415  # optional

    if not given["observer"]:
        return None
    look = np.radians(given["sensory_noise"])
    walk = given["amplitude"] if given["unknown_perturbation"] else None
    return Observer(
        controller.plant,
        _SENSED,
        motor=given["motor_noise"],
        sensory=look * np.array([1.0, 1.0, 10.0, 10.0]),
        walk=walk,
    )


def _encoded(name: str, trial: SubjectTrial, wanted: Sequence[str]) -> dict[str, bytes]:
    """Encode one trial in every wanted format, in degrees and newton metres."""
    table = seat.seat_table(name, np.degrees(trial.outputs), trial.disturbance[:, 0], _RATE)
    return {f"{name}.{ending}": encode_table(f".{ending}", table) for ending in wanted}


def _truth(controller: Controller, given: dict[str, Any]) -> dict[str, Any]:
    """True values, for truth.json."""
    weights = seat.seat_weights(controller.plant)
    return {
        "impc": importlib.metadata.version("impc"),
        "states": list(controller.plant.states),
        "K": controller.K.tolist(),
        "Q": weights.Q.tolist(),
        "R": weights.R.tolist(),
        "horizon": controller.horizon,
        "settings": given,
    }


def _configuration(person: dict[str, Any], given: dict[str, Any], files: list[str]) -> str:
    """Text of subject.toml, which `impc fit` reads."""
    return f"""\
# A simulated subject: meaning of the columns of its recordings. truth.json holds the true values.
[subject]
plant = "seated-balance"
files = {json.dumps(files)}

[recording]
time = "time"
subject = "simulated"
pattern = "trial_(?P<trial>[0-9]+)"

{seat.SIGNALS.replace("LIMIT", _STOP)}
[plant]
mass = {person["mass"]}
height = {person["height"]}
sex = "{person["sex"]}"

[fit]
horizon = {seat.HORIZON}                 # samples of 0.01 s
u_max = {given["torque_limit"]}                  # N m
{_observer_table(given)}"""


def _observer_table(given: dict[str, Any]) -> str:
    if not given["observer"]:
        return ""
    return f"""
[fit.observer]
sensed = {json.dumps(_SENSED)}
known = {json.dumps(not given["unknown_perturbation"])}

[fit.structure]              # no cost weights for the states of delay and muscle
Q = "full"
over = {json.dumps(_SENSED)}
name = "posture"
"""
