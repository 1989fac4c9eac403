"""`impc simulate cohort`: two groups of simulated subjects that differ in one stated way."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from tqdm import tqdm

from impc.cli.numbers import Number
from impc.cli.options import out_option, seed_option

if TYPE_CHECKING:
    import numpy as np

__all__ = ["cohort", "random_person"]

_PLANT, _STEP = "plants:seated_balance_for", "plants:seated_balance_step_for"
_TORQUE = "plants:ternary_torque"
_RATE, _HORIZON = 100.0, 20
# Spread of the prices between subjects, and of one subject between visits: of their logarithm.
_BETWEEN, _WITHIN = 0.2, 0.05


@click.command("cohort")
@out_option("cohort-data", "the recordings, study.toml, participants.tsv and truth.json")
@click.option(
    "--subjects",
    type=click.IntRange(2, 9999),
    default=30,
    help="In both groups together.",
)
@click.option("--visits", type=click.IntRange(1, 9), default=1, help="Of each subject.")
@click.option("--trials", type=click.IntRange(1, 9), default=3, help="Of each visit.")
@click.option("--duration", type=Number(5, 600), default=30.0, help="s")
@click.option(
    "--difference",
    type=Number(min=0.05, max=20),
    default=0.4,
    help="The second group's prices of angles and rates over the first's; 1 for none.",
)
@click.option(
    "--torque-limit",
    type=Number(min=1, max=1e6),
    default=6.0,
    help="Largest lumbar torque of a subject, Nm.",
)
@click.option("--replicates", type=click.IntRange(0, 1_000_000), default=20, help="In study.toml.")
@seed_option
def cohort(out: Path, **given: Any) -> None:
    """Subjects on the seat, half of them in each of two groups, in folders named as BIDS has it.

    The groups differ in one thing: what angles and rates cost the second one, compared with its
    effort. Body mass and height differ between subjects, prices between subjects and visits. 100
    samples a second.
    """
    import numpy as np  # noqa: PLC0415

    from impc.reporting.writer import require_writable, write_files  # noqa: PLC0415

    require_writable(out)
    rng = np.random.default_rng(given["seed"])
    rows = ["participant_id\tgroup\tmass\theight\tsex"]
    truth: dict[str, Any] = {}
    width = len(str(given["subjects"]))
    numbers = range(given["subjects"])
    with tqdm(numbers, unit="subject", file=sys.stderr, disable=None, leave=False) as bar:
        for number in bar:
            name = f"{number + 1:0{max(width, 2)}d}"
            group = "first" if number < (given["subjects"] + 1) // 2 else "second"
            person = random_person(rng)
            row = (group, person["mass"], person["height"], person["sex"])
            rows.append("\t".join([f"sub-{name}", *map(str, row)]))
            factor = given["difference"] if group == "second" else 1.0
            factor *= float(np.exp(_BETWEEN * rng.standard_normal()))
            truth[name] = {"group": group, "gain": {}}
            for visit in range(1, given["visits"] + 1):
                price = factor * float(np.exp(_WITHIN * rng.standard_normal()))
                files, gain = _visit(name, visit, person, price, given, rng)
                truth[name]["gain"][str(visit)] = gain
                write_files(out / f"sub-{name}" / f"ses-{visit}", files)
    texts = {
        "participants.tsv": "\n".join(rows) + "\n",
        "study.toml": _study(given),
        "truth.json": json.dumps({"settings": given, "subjects": truth}, indent=1) + "\n",
    }
    write_files(out, {name: text.encode() for name, text in texts.items()})
    click.echo(f"{given['subjects']} subjects, {given['visits']} visits: {out / 'study.toml'}")


def random_person(rng: np.random.Generator) -> dict[str, Any]:
    """Body mass (kg), height (m) and sex of an adult, drawn from `rng`."""
    sex = "male" if rng.random() < 0.5 else "female"
    height = rng.normal(1.76 if sex == "male" else 1.63, 0.06)
    mass = rng.normal(23.0, 2.0) * height**2
    return {"mass": round(float(mass), 1), "height": round(float(height), 3), "sex": sex}


def _visit(
    name: str,
    visit: int,
    person: dict[str, Any],
    price: float,
    given: dict[str, Any],
    rng: np.random.Generator,
) -> tuple[dict[str, bytes], list[list[float]]]:
    """All trials of a visit as files, and the gain behind them."""
    import numpy as np  # noqa: PLC0415

    from impc.control.controller import Controller  # noqa: PLC0415
    from impc.files.formats import encode_table  # noqa: PLC0415
    from impc.files.plant_sources import import_function, make_plant, plant_source  # noqa: PLC0415
    from impc.files.table import make_table  # noqa: PLC0415
    from impc.model.bounds import Bounds  # noqa: PLC0415
    from impc.model.weights import Weights  # noqa: PLC0415
    from impc.studies.simulated_people import simulate_subject  # noqa: PLC0415

    plant = make_plant(plant_source(_PLANT, person), ("perturbation",))
    v = np.array([0.70, 0.65, 0.22, 0.20])
    v /= np.linalg.norm(v)
    Q = 1e-2 * np.eye(plant.n)
    Q[:4, :4] = price * (6e5 * np.outer(v, v) + np.diag([2e4, 2e4, 500, 500]))
    limit = given["torque_limit"]
    bounds = Bounds(plant, u_min=-limit, u_max=limit)
    controller = Controller(plant, Weights(Q, 1), bounds, _HORIZON, terminal_set=False)
    step = plant_source(_STEP, person | {"sample_time": 1 / _RATE})
    make, torque = step.make(**step.arguments), import_function(_TORQUE)
    files = {}
    for run in range(1, given["trials"] + 1):
        pushed = torque(duration=given["duration"], rate=_RATE, seed=int(rng.integers(2**31)))
        trial = simulate_subject(
            controller,
            make,
            pushed,
            rate=_RATE,
            motor=0.3,
            sensor=np.radians(0.1),
            seed=int(rng.integers(2**31)),
        )
        degrees = np.degrees(trial.outputs)
        columns = {
            "time": trial.time,
            "seat_angle": degrees[:, 0],
            "trunk_angle": degrees[:, 1],
            "perturbation": trial.disturbance[:, 0],
        }
        units = {"time": "s", "seat_angle": "deg", "trunk_angle": "deg", "perturbation": "Nm"}
        file = f"sub-{name}_ses-{visit}_task-seat_run-{run}_motion"
        table = make_table(file, columns, units=units, rate=_RATE)
        files[f"{file}.csv"] = encode_table(".csv", table)
    return files, np.array(controller.K).tolist()


def _study(given: dict[str, Any]) -> str:
    return f"""\
# A simulated cohort: `impc cohort study.toml --out DIR`. truth.json holds what it should find.
[study]
plant = "seated-balance"
bids = "."                       # folders and files that are named sub-, ses-, task-, run-
participants = "participants.tsv"

[recording]
time = "time"

[signals.theta1]
column = "seat_angle"
unit = "deg"
limit = 12.0

[signals.theta2]
column = "trunk_angle"
unit = "deg"

[signals.perturbation]
column = "perturbation"
unit = "N*m"

[fit]
horizon = {_HORIZON}                     # samples of 0.01 s
u_max = {given["torque_limit"]}                      # N m
held_out = false
replicates = {given["replicates"]}
"""
