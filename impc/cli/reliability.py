"""`impc reliability`: how repeatable the measures of a test are."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click
from tqdm import tqdm

from impc.checking import replace
from impc.cli.options import code_options, out_option
from impc.cli.output import print_files
from impc.cli.plant import named_plant

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.files.configuration import Configuration
    from impc.files.plant_sources import PlantSource
    from impc.studies.cohort.study import Unit
    from impc.studies.reliability.analysis import Trials


@click.command("reliability")
@click.argument("study_file", metavar="STUDY", type=click.Path(path_type=Path))
@code_options("plant")
@out_option("reliability", "report.html, result.json, tables and figures")
@click.option(
    "--last",
    type=click.IntRange(min=1),
    default=3,
    help="How many of a visit's trials count, the last ones.",
)
def command(study_file: Path, plant_name: str | None, allowed: bool, out: Path, last: int) -> None:
    """Reliability of a study of several subjects, visits, conditions and trials.

    The study file is that of `impc cohort`.
    """
    from impc.files.inputs import study_inputs  # noqa: PLC0415
    from impc.files.reading import require_distinct  # noqa: PLC0415
    from impc.reporting.shown_units import angles_in  # noqa: PLC0415
    from impc.reporting.writer import write_files  # noqa: PLC0415
    from impc.studies.cohort.study import read_study  # noqa: PLC0415
    from impc.studies.reliability.analysis import analyse  # noqa: PLC0415
    from impc.studies.reliability.report import reliability_report  # noqa: PLC0415
    from impc.studies.reliability.verdict import findings  # noqa: PLC0415

    study = read_study(study_file)
    require_distinct([file for unit in study.units for file in unit.files])
    source = named_plant(study_file, study, plant_name, allowed)
    units = [replace(unit, files=unit.files[-last:]) for unit in study.units]
    trials = _trials(units, study.configuration, source)
    inputs = study_inputs(units, study_file, "plant", source.name, source.arguments)
    result = analyse(trials)
    line = f"impc reliability {study_file.name} --plant {source.name} --last {last}"
    with angles_in(study.configuration.report.angles):
        content = reliability_report(trials, result, line, inputs).files()
    written = write_files(out, content)
    for item in findings(result):
        click.echo(f"{'found' if item.found else 'not found'}: {item.statement} ({item.numbers})")
    for line in result.notes:
        click.echo(line)
    print_files(out, written)


def _trials(units: Sequence[Unit], configuration: Configuration, source: PlantSource) -> Trials:
    from impc.files.plant_sources import make_plant  # noqa: PLC0415
    from impc.files.reading import read_recordings  # noqa: PLC0415
    from impc.studies.reliability.analysis import Trials  # noqa: PLC0415

    cells = {}
    recorded = configuration.recorded
    plant = make_plant(source, recorded)
    for unit in tqdm(units, unit="visit", file=sys.stderr, disable=None, leave=False):
        found = read_recordings(unit.files, configuration, plant)
        cells[unit.subject, unit.visit, unit.condition] = found
    return Trials(tuple(plant.outputs), 1 / plant.dt, cells)
