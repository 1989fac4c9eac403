"""`impc compare`: every method for the weights, on the same recordings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from impc.checking import replace
from impc.cli.options import out_option, solver_option, subject_arguments, yes_option
from impc.cli.output import print_files
from impc.cli.progress import progress

if TYPE_CHECKING:
    from pathlib import Path


@click.command("compare")
@subject_arguments("What the columns mean, and settings, as for `impc fit`.")
@out_option("compare", "report.html, result.json, tables and the figure")
@solver_option
@yes_option
def command(
    files: tuple[Path, ...],
    plant_name: str,
    config: Path,
    out: Path,
    solver: str | None,
    yes: bool,
) -> None:
    """Compare feedback gain, inverse LQR and inverse MPC, one file a trial.

    Each method is fitted to all trials and to all but each one. What is done when you interrupt it
    is kept in the folder: the same command goes on from there.
    """
    # Imported here: the libraries take seconds to load, and --help needs none.
    from impc.cli.consent import require_consent  # noqa: PLC0415
    from impc.cli.subject import read_subject  # noqa: PLC0415
    from impc.reporting.shown_units import angles_in  # noqa: PLC0415
    from impc.reporting.writer import require_writable, write_files  # noqa: PLC0415
    from impc.studies.compare.report import compare_report  # noqa: PLC0415
    from impc.studies.compare.subject import compare_recordings, stages  # noqa: PLC0415
    from impc.studies.effort import fit_effort  # noqa: PLC0415
    from impc.studies.fit.memory import open_memory  # noqa: PLC0415
    from impc.studies.fit.settings import require_used  # noqa: PLC0415
    from impc.studies.methods_table import methods_finding  # noqa: PLC0415

    require_writable(out)
    subject = read_subject("compare", files, plant_name, config, solver)
    problem, settings = subject.problem, subject.settings
    require_used(settings, (), "compare")
    require_consent(fit_effort(problem, settings), yes)
    memory = open_memory(out, problem, settings, "compare", subject.inputs.digest)
    held_out = settings.held_out
    count = stages(len(problem.recordings), held_out=held_out)
    with progress(count, "estimate", lambda _: memory.kept()) as done:
        remember = replace(memory, done=done).estimate
        compared = compare_recordings(problem, settings.settle, remember, held_out=held_out)
    with angles_in(subject.angles):
        content = compare_report(problem, compared, subject.provenance).files()
    written = write_files(out, content)
    memory.cache.forget()
    click.echo(methods_finding(compared).text())
    print_files(out, written)
