"""`impc select`: which parameters of a model recordings can tell."""

from __future__ import annotations

import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from tqdm import tqdm

from impc.commands.options import out_option, scheduler_options
from impc.commands.output import print_files

if TYPE_CHECKING:
    from collections.abc import Iterator

    from impc.cohort.study import Study
    from impc.selection.model import Trial
    from impc.selection.running import Kept, Runner
    from impc.selection.source import ModelSource

__all__ = ["command", "kept_results", "read_model_study", "study_runner"]


@click.command("select")
@click.argument("study_file", metavar="STUDY", type=click.Path(path_type=Path))
@out_option("select", "report.html, result.json, tables and figure")
@scheduler_options
def command(study_file: Path, out: Path, scheduler: str | None, workers: int | None) -> None:
    """Sensitive parameters of a simulation model (chapter 4), subject by subject and in common.

    [study] model names the model by import path, [model] its arguments, [select] the settings. It
    may be stopped at any time: the same command goes on from there.
    """
    from impc.report.write import require_writable, write_files  # noqa: PLC0415
    from impc.selection.analysis import select_study  # noqa: PLC0415
    from impc.selection.report import selection_files  # noqa: PLC0415
    from impc.selection.settings import select_settings  # noqa: PLC0415

    require_writable(out)
    study, source, recorded = read_model_study(study_file)
    settings = select_settings(study.configuration.select)
    named = {" visit ".join(part for part in key if part): item for key, item in recorded.items()}
    with study_runner(source, out, scheduler, workers, 2 * len(named) + 1) as run:
        found = select_study(named, settings, run)
    written = write_files(
        out, selection_files(source.model, found, f"impc select {study_file.name}")
    )
    kept_results(out).forget()
    names = source.model.names
    click.echo(f"information: {', '.join(names[index] for index in found.free)}")
    click.echo(f"LASSO:       {', '.join(names[index] for index in found.lasso)}")
    print_files(out, written)


def kept_results(out: Path) -> Kept:
    """Where results of single tasks wait in the folder `out` until the whole is done."""
    from impc.selection.running import Kept  # noqa: PLC0415

    return Kept(out / "in-progress")


@contextmanager
def study_runner(
    source: ModelSource, out: Path, scheduler: str | None, workers: int | None, tasks: int
) -> Iterator[Runner]:
    """Workers with a progress bar; a message about what is kept when it is interrupted.

    Parameters
    ----------
    out : Path
        Folder in which results wait, see `kept_results`.
    scheduler : str or None
        Address of a running scheduler; None for workers on this machine.
    workers : int or None
        How many; None for as many as there are processors.
    tasks : int
        Of the progress bar.

    Raises
    ------
    KeyboardInterrupt
        When it is interrupted, after the message.
    """
    from impc.cohort.cluster import connected  # noqa: PLC0415
    from impc.selection.running import on_workers  # noqa: PLC0415

    kept = kept_results(out)
    with tqdm(total=tasks, unit="task", file=sys.stderr, disable=None, leave=False) as bar:

        def done(name: str) -> None:
            bar.set_postfix_str(name, refresh=False)
            bar.update()

        try:
            with connected(scheduler, workers) as client:
                yield on_workers(client, source, kept, done)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"{bar.n} of {tasks} tasks are kept in {kept.folder}; the same command goes on"
            ) from None


def read_model_study(
    path: Path,
) -> tuple[Study, ModelSource, dict[tuple[str, str], tuple[Trial, ...]]]:
    """The study at `path`, its model and all recordings.

    Raises
    ------
    InputError, DataError
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
