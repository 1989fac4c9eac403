"""`impc simulate head-tracking`: subjects who follow steps with the head, yaw or pitch."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from impc.cli.options import Number, out_option, seed_option
from impc.cli.output import print_next
from impc.cli.seat import numbered

_MODEL, _STEPS = "plants:head_neck_model", "plants:step_reference"
_RATE = 60.0
# SD over subjects, of a parameter over its typical value; of one subject between visits; and of
# the VAF that the noise leaves, % (table 4.3: 82.3 +- 7.7).
_SPREAD, _VISIT, _VAF = 0.25, 0.05, (82.3, 7.7)


@click.command("head-tracking")
@out_option("head-data", "the recordings, study.toml and truth.json")
@click.option(
    "--axis", type=click.Choice(["yaw", "pitch"]), default="yaw", help="Of the head's rotation."
)
@click.option("--subjects", type=click.IntRange(1, 999), default=10, help="How many.")
@click.option("--visits", type=click.IntRange(1, 9), default=1, help="Of each subject.")
@click.option("--trials", type=click.IntRange(1, 9), default=3, help="Of each visit.")
@click.option("--duration", type=Number(5, 300), default=30.0, help="Of a trial, s.")
@seed_option
def head_tracking(out: Path, **given: Any) -> None:
    """Ten subjects of chapter 4; --subjects 40 --visits 2 for chapter 5.

    Subjects differ in all twelve parameters, drawn about the nominal column of table 4.3 until the
    loop is stable, and in the noise.
    """
    import numpy as np  # noqa: PLC0415

    from impc.files.formats import encode_table  # noqa: PLC0415
    from impc.files.plant_sources import import_function  # noqa: PLC0415
    from impc.files.table import make_table  # noqa: PLC0415
    from impc.reporting.writer import require_writable, write_files  # noqa: PLC0415
    from impc.studies.selection.model_source import model_source  # noqa: PLC0415

    require_writable(out)
    rng = np.random.default_rng(given["seed"])
    source = model_source(_MODEL, {"axis": given["axis"]})
    model, steps = source.model, import_function(_STEPS)
    low, high, typical = (np.array(item) for item in (model.low, model.high, model.typical))
    inside = (low + 1e-3 * (high - low), high - 1e-3 * (high - low))

    def drawn(about: Any, spread: float) -> Any:
        """Parameters about others, such that 30 s of tracking stay within reason."""
        while True:
            theta = np.clip(about * np.exp(spread * rng.standard_normal(model.size)), *inside)
            probe = model.simulate(theta, steps(30.0, _RATE, seed=0)[:, None])
            if np.all(np.isfinite(probe)) and np.max(np.abs(probe)) < 20:
                return theta

    truth: dict[str, Any] = {}
    for name in numbered(given["subjects"]):
        own = drawn(typical, _SPREAD)
        truth[name] = dict(zip(model.names, own.tolist(), strict=True))
        for visit in range(1, given["visits"] + 1):
            theta = drawn(own, _VISIT) if given["visits"] > 1 else own
            vaf = float(np.clip(rng.normal(*_VAF), 60, 95)) / 100
            files = {}
            for run in range(1, given["trials"] + 1):
                reference = steps(given["duration"], _RATE, seed=int(rng.integers(2**31)))
                head = model.simulate(theta, reference[:, None])[:, 0]
                noise = np.sqrt((1 / vaf - 1) * np.mean(head**2))
                columns = {
                    "time": np.arange(len(head)) / _RATE,
                    "target": reference,
                    "head": head + noise * rng.standard_normal(len(head)),
                }
                units = {"time": "s", "target": "deg", "head": "deg"}
                table = make_table("trial", columns, units=units, rate=_RATE)
                stem = f"sub-{name}_ses-{visit}_task-{given['axis']}_run-{run}_motion"
                files[f"{stem}.csv"] = encode_table(".csv", table)
            write_files(out / f"sub-{name}" / f"ses-{visit}", files)
    text = json.dumps({"settings": given, "subjects": truth}, indent=1) + "\n"
    study = _STUDY.replace("AXIS", given["axis"])
    write_files(out, {"study.toml": study.encode(), "truth.json": text.encode()})
    click.echo(f"{given['subjects']} subjects, {given['visits']} visits: {out / 'study.toml'}")
    print_next("impc select {}", out, "study.toml")


_STUDY = """\
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
