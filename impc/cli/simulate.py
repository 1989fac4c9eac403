"""`impc simulate`: recordings of simulated subjects whose controller is known."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from impc.cli.console import print_files, print_next
from impc.cli.options import Number, out_option, seed_option
from impc.cli.seat import (
    HORIZON,
    SIGNALS,
    STEP,
    TORQUE,
    between_samples,
    seat_controller,
    seat_table,
    seat_weights,
)
from impc.cli.simulate_cohort import cohort
from impc.cli.simulate_studies import head_tracking, reliability_study
from impc.extras import installed

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.control.controller import Controller
    from impc.output_feedback.observer import Observer
    from impc.studies.simulated_people import SubjectTrial

_FORMATS = ("csv", "tsv", "xlsx", "mat", "tdms", "c3d")
# Formats that need an optional library.
_LIBRARIES = {"tdms": "nptdms", "c3d": "c3d"}
_RATE = 1000.0
#: Signals that the simulated subject senses.
_SENSED = ("theta1", "theta2", "theta1_rate", "theta2_rate")
_STOP = "limit = 12.0                 # mechanical stop, in this unit\n"


@click.group("simulate")
def command() -> None:
    """Write recordings of a simulated subject, with the true values in truth.json."""


@command.command("seated-balance")
@out_option("subject", "the recordings, subject.toml and truth.json")
@click.option(
    "--torque-limit",
    type=Number(min=0, max=1e6, min_open=True),
    default=6.0,
    help="Largest torque of the subject, N m.",
)
@click.option("--trials", type=click.IntRange(1, 99), default=3, help="Number of trials.")
@click.option("--duration", type=Number(min=2, max=600), default=30.0, help="Of each trial, s.")
@click.option(
    "--amplitude",
    type=Number(min=0, max=1e6, min_open=True),
    default=5.0,
    help="Of the ternary torque on the seat, N m.",
)
@click.option(
    "--motor-noise",
    type=Number(min=0, max=1e6),
    show_default="0, with --observer 0.3",
    help="Standard deviation of the noise on the torque, N m; a fit without [fit.observer] treats "
    "it as recording noise.",
)
@click.option(
    "--sensor-noise",
    type=Number(min=0, max=1e6),
    default=0.1,
    help="Standard deviation of the recording noise on the angles, degrees.",
)
@click.option(
    "--observer",
    is_flag=True,
    help="The subject senses angles and rates with noise, and acts on estimates of the states.",
)
@click.option(
    "--sensory-noise",
    type=Number(min=0, max=1e6, min_open=True),
    default=0.1,
    help="With --observer: standard deviation of one sensed sample (0.01 s) of an angle, degrees; "
    "of a rate, ten times that per second.",
)
@click.option(
    "--unknown-perturbation",
    is_flag=True,
    help="With --observer: the subject does not know the torque on the seat, and estimates it.",
)
@click.option("--mass", type=Number(), default=79.7, help="Body mass, kg.")
@click.option("--height", type=Number(), default=1.66, help="Body height, m.")
@click.option("--sex", type=click.Choice(["male", "female"]), default="male")
@seed_option
@click.option(
    "--formats",
    show_default="all that are installed",
    help="Comma-separated list of csv, tsv, xlsx, mat, tdms and c3d.",
)
def seated_balance(out: Path, formats: str | None, **given: Any) -> None:
    """Simulate a subject who balances on a tilting seat with a bounded controller.

    1000 samples a second; the nonlinear plant of the dissertation with parameters from body mass
    and height. truth.json holds the true gain and weights.
    """
    # Imported here: the libraries take seconds to load, and --help needs none.
    from impc.reporting.writer import require_writable, write_files  # noqa: PLC0415

    wanted = _wanted(formats)
    require_writable(out)
    if given["motor_noise"] is None:
        given["motor_noise"] = 0.3 if given["observer"] else 0.0
    person = {key: given[key] for key in ("mass", "height", "sex")}
    controller = seat_controller(person, given["torque_limit"])
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
    import numpy as np  # noqa: PLC0415

    from impc.arrays import frozen  # noqa: PLC0415
    from impc.checking import replace  # noqa: PLC0415
    from impc.files.plant_sources import import_function, plant_source  # noqa: PLC0415
    from impc.studies.simulated_people import simulate_subject  # noqa: PLC0415

    torque, step = import_function(TORQUE), plant_source(STEP, person).make(**person)
    seeds = np.random.SeedSequence(given["seed"]).spawn(given["trials"])
    length = {"amplitude": given["amplitude"], "duration": given["duration"], "rate": _RATE}
    recorded = [
        torque(**length, seed=given["seed"] * 100 + number) for number in range(1, 1 + len(seeds))
    ]
    trials = [
        simulate_subject(
            controller,
            step,
            between_samples(pushed),
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
    import numpy as np  # noqa: PLC0415

    from impc.output_feedback.observer import Observer  # noqa: PLC0415

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
    import numpy as np  # noqa: PLC0415

    from impc.files.formats import encode_table  # noqa: PLC0415

    table = seat_table(name, np.degrees(trial.outputs), trial.disturbance[:, 0], _RATE)
    return {f"{name}.{ending}": encode_table(f".{ending}", table) for ending in wanted}


def _truth(controller: Controller, given: dict[str, Any]) -> dict[str, Any]:
    """True values, for truth.json."""
    import importlib.metadata  # noqa: PLC0415

    weights = seat_weights(controller.plant)
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

{SIGNALS.replace("LIMIT", _STOP)}
[plant]
mass = {person["mass"]}
height = {person["height"]}
sex = "{person["sex"]}"

[fit]
horizon = {HORIZON}                 # samples of 0.01 s
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


command.add_command(cohort)
command.add_command(reliability_study)
command.add_command(head_tracking)
