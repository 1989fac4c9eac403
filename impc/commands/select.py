"""`impc select`: which parameters of a model recordings can tell."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from tqdm import tqdm

from impc.commands.output import print_files

if TYPE_CHECKING:
    from impc.cohort.study import Study
    from impc.selection.model import Trial
    from impc.selection.source import ModelSource

__all__ = ["command", "read_model_study"]


@click.command("select")
@click.argument("study_file", metavar="STUDY", type=click.Path(path_type=Path))
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("results", "select"),
    show_default=True,
    help="Folder for report.html, result.json, tables and figure.",
)
def command(study_file: Path, out: Path) -> None:
    """Sensitive parameters of a simulation model (chapter 4), subject by subject and in common.

    [study] model names the model by import path, [model] its arguments, [select] the settings.
    """
    from impc.report.write import require_writable, write_files  # noqa: PLC0415
    from impc.selection.analysis import select_settings, select_study  # noqa: PLC0415
    from impc.selection.report import selection_files  # noqa: PLC0415

    require_writable(out)
    study, source, recorded = read_model_study(study_file)
    settings = select_settings(study.configuration.select)
    named = {" visit ".join(part for part in key if part): item for key, item in recorded.items()}
    steps = len(named) * (3 + settings.nelder_mead)
    with tqdm(total=steps, unit="step", file=sys.stderr, disable=None, leave=False) as bar:

        def told(step: str) -> None:
            bar.set_postfix_str(step, refresh=False)
            bar.update()

        found = select_study(source.model, named, settings, told)
    files = selection_files(source.model, found, f"impc select {study_file.name}")
    written = write_files(out, files)
    names = source.model.names
    click.echo(f"information: {', '.join(names[index] for index in found.chosen)}")
    click.echo(f"LASSO:       {', '.join(names[index] for index in found.lasso_common)}")
    print_files(out, written)


def read_model_study(
    path: Path,
) -> tuple[Study, ModelSource, dict[tuple[str, str], tuple[Trial, ...]]]:
    """A study, its model and all recordings.

    Raises
    ------
    ImpcError
        When the file, the model or a recording cannot be used.
    """
    from impc.cohort.study import read_study  # noqa: PLC0415
    from impc.errors import InputError  # noqa: PLC0415
    from impc.selection.source import model_source, read_trials  # noqa: PLC0415

    study = read_study(path)
    if not study.model:
        raise InputError(f"{path}: study.model", "is missing", 'write model = "module:function"')
    arguments: dict[str, Any] = dict(study.configuration.model)
    source = model_source(study.model, arguments)
    return study, source, read_trials(study, source)
