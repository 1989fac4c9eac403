"""`impc inspect`: describe a recording and draft a configuration for it."""

from __future__ import annotations

import shlex
from pathlib import Path

import click

from impc.cli.console import print_files
from impc.cli.plant import find_plant
from impc.errors import InputError, OutputError
from impc.files.checks import fault
from impc.files.configuration import read_configuration
from impc.files.draft import Draft, drafted, summary
from impc.files.formats import read_table, write_file
from impc.files.plant_sources import make_plant
from impc.files.reading import examine, recording_of


def run_inspect(
    file: Path, plant_name: str | None, out: Path | None, config: Path | None, open_page: bool
) -> None:
    """Describe a recording, and draft or check its configuration."""
    if config is not None:
        _check(file, config, plant_name)
        return
    if out is not None and out.exists():
        raise OutputError(str(out), "already exists", "choose another name, or remove it")
    table = read_table(file)
    draft = drafted(table, None if plant_name is None else find_plant(plant_name, {}))
    click.echo(summary(table, draft.plant.dt if draft.plant else None))
    if open_page:
        _open(file, plant_name, draft)
    if out is None:
        click.echo("\n" + draft.toml(), nl=False)
    else:
        write_file(out, draft.toml().encode())
        counts = f'{draft.places} places with "?" to fill in, {draft.guesses} guesses to check'
        click.echo(f"\nWritten to {out}: {counts}; then run impc fit with it.")


def _open(file: Path, plant_name: str | None, draft: Draft) -> None:
    """Write the page of a draft to results/inspect and open it."""
    from impc.reporting.writer import owned, write_files  # noqa: PLC0415  # for a page only
    from impc.studies.inspection import inspection_report  # noqa: PLC0415

    out, plant = Path("results", "inspect"), () if plant_name is None else ("--plant", plant_name)
    line = shlex.join(["impc", "inspect", file.name, *plant, "--open"])
    with owned(out, "inspect"):
        written = write_files(out, inspection_report(draft, plant_name or "", line).files())
        print_files(out, written, open_page=True)


def _check(file: Path, config: Path, plant_name: str | None) -> None:
    """Read the file as `impc fit` does, and print what the checks found."""
    if plant_name is None:
        raise InputError("--config", "is given without --plant", "add --plant NAME")
    configuration = read_configuration(config)
    plant = make_plant(find_plant(plant_name, configuration.plant), configuration.recorded)
    plant.require_discrete()
    table = read_table(file, sheet=configuration.recording.sheet)
    try:
        trial = recording_of(table, configuration, plant)
    except InputError as error:
        for notice in examine([table], configuration, plant):
            if notice != fault(error):
                click.echo(notice)
        raise
    click.echo(f"{trial.label}: {trial.samples} samples at {1 / plant.dt:g} per second")
    for finding in trial.findings or ("The checks found no problems.",):
        click.echo(finding)
