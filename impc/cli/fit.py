"""`impc fit` and `impc compare`: the controller of a subject, by one method or by all."""

from __future__ import annotations

from textwrap import fill
from typing import TYPE_CHECKING

import click

from impc.checking import replace
from impc.cli.console import print_files, progress
from impc.cli.options import out_option, page_options, subject_arguments
from impc.cli.plant import KNOWN

if TYPE_CHECKING:
    from pathlib import Path

    from impc.arrays import Array
    from impc.cli.plant import Asked
    from impc.reporting.verdict import Verdict
    from impc.studies.fit.result import FitResult

# Title of the last stage.
_PAGE = "report and figures"
#: Copy of the configuration among the results of `impc fit`.
CONFIGURATION = "configuration.toml"


@click.command("fit")
@subject_arguments("Meaning of the columns, and settings; `impc inspect FILE` drafts this file.")
@out_option("fit", "report.html, result.json, tables and the figures")
@page_options
def command(asked: Asked, out: Path, yes: bool, pdf: bool, open_page: bool) -> None:
    """Fit the controller behind the trials of one subject, one file a trial.

    If you interrupt it, the same command continues from the last finished step. If the plant is an
    impc.OptimalControlProblem, its parameters are fitted (docs/howto/nonlinear.md).
    """
    # Imported here: the libraries take seconds to load, and --help needs none.
    from impc.cli.console import require_consent  # noqa: PLC0415
    from impc.cli.plant import AllFellError, read_subject  # noqa: PLC0415
    from impc.extras import installed  # noqa: PLC0415
    from impc.reporting.shown_units import angles_in  # noqa: PLC0415
    from impc.reporting.writer import require_writable, write_files  # noqa: PLC0415
    from impc.studies.effort import fit_effort  # noqa: PLC0415
    from impc.studies.fit.findings import read_truth  # noqa: PLC0415
    from impc.studies.fit.memory import open_memory  # noqa: PLC0415
    from impc.studies.fit.report import fallen_report, fit_report  # noqa: PLC0415
    from impc.studies.fit.settings import missing  # noqa: PLC0415
    from impc.studies.fit.subject import fit_recordings, stages  # noqa: PLC0415

    require_writable(out)
    # No known plant is an optimal control problem.
    if asked.plant not in KNOWN and installed("impc.nonlinear") and _own_problem(asked, out):
        return
    try:
        subject = read_subject(asked)
    except AllFellError as fallen:
        report = fallen_report(fallen.falls, fallen.provenance)
        click.echo(report.verdict.text())
        print_files(out, write_files(out, report.files()), open_page)
        return
    problem, settings = subject.problem, subject.settings
    used = {CONFIGURATION: asked.config.read_bytes()}  # it may change during the fit
    require_consent(fit_effort(problem, settings), yes)
    unknown = missing(settings, subject.source)
    if unknown:
        click.echo(unknown, err=True)
    memory = open_memory(out, problem, settings, "fit", subject.inputs.digest)
    truth = read_truth(asked.files, problem.plant)
    # One more stage: the report with its figures takes ten seconds.
    count = len(stages(problem, settings)) + 1
    with progress(count, "stage", lambda _: memory.kept()) as done:
        result = fit_recordings(problem, settings, memory.progress(done))
        result = replace(result, falls=subject.falls)
        with angles_in(subject.angles):
            report = fit_report(result, subject.provenance, truth, unknown)
            content = report.files(pdf=pdf) | used
        done(_PAGE)
    written = write_files(out, content)
    memory.cache.forget()
    with angles_in(subject.angles):
        _print(result, report.verdict, truth)
    print_files(out, written, open_page)


def _own_problem(asked: Asked, out: Path) -> bool:
    """Fit, write and print if the plant is an optimal control problem; return whether it is."""
    from impc.cli.plant import find_plant  # noqa: PLC0415
    from impc.files.plant_sources import made_by  # noqa: PLC0415
    from impc.nonlinear.files import fit_files  # noqa: PLC0415
    from impc.nonlinear.page import optimal_report  # noqa: PLC0415
    from impc.nonlinear.problem import OptimalControlProblem  # noqa: PLC0415
    from impc.reporting.shown_units import angles_in  # noqa: PLC0415
    from impc.reporting.writer import write_files  # noqa: PLC0415

    configuration = asked.configuration
    source = find_plant(asked.plant, configuration.plant)
    problem = made_by(source) if ":" in source.name else None  # files hold matrices only
    if not isinstance(problem, OptimalControlProblem):
        return False
    with progress(2, "stage") as done:
        fit = fit_files(problem, asked.files, configuration, asked.solver)
        done("search")
        provenance = asked.provenance(source, asked.inputs(source))
        with angles_in(configuration.report.angles):
            report = optimal_report(fit, provenance)
            content = report.files() | {CONFIGURATION: asked.config.read_bytes()}
        done(_PAGE)
    written = write_files(out, content)
    click.echo(report.verdict.text())
    print_files(out, written)
    return True


def _print(result: FitResult, verdict: Verdict, truth: Array | None) -> None:
    """Print verdict, gain, methods and, for simulated recordings, the true gain."""
    from impc.reporting.verdict import WIDTH  # noqa: PLC0415
    from impc.studies.fit.findings import per_unit_finding, truth_found  # noqa: PLC0415
    from impc.studies.fit.verdict import GAIN, forbidden  # noqa: PLC0415
    from impc.studies.methods_table import methods_finding  # noqa: PLC0415

    click.echo(verdict.text())
    if GAIN not in forbidden(result):
        click.echo(f"\n{per_unit_finding(result).text()}")
    click.echo(f"\n{methods_finding(result.methods[::-1]).text()}\n")
    if truth is not None:
        click.echo(fill(truth_found(result, truth)[1], WIDTH))


@click.command("compare")
@subject_arguments("Meaning of the columns, and settings, as for `impc fit`.")
@out_option("compare", "report.html, result.json, tables and the figure")
@page_options
def compare_command(asked: Asked, out: Path, yes: bool, pdf: bool, open_page: bool) -> None:
    """Compare feedback gain, inverse LQR and inverse MPC, one file a trial.

    Each method is fitted to all trials, and once without each trial. If you interrupt it, the same
    command continues from the last finished fit.
    """
    # Imported here: the libraries take seconds to load, and --help needs none.
    from impc.cli.console import require_consent  # noqa: PLC0415
    from impc.cli.plant import read_subject  # noqa: PLC0415
    from impc.reporting.shown_units import angles_in  # noqa: PLC0415
    from impc.reporting.writer import require_writable, write_files  # noqa: PLC0415
    from impc.studies.compare.report import compare_report  # noqa: PLC0415
    from impc.studies.compare.subject import compare_recordings, stages  # noqa: PLC0415
    from impc.studies.effort import fit_effort  # noqa: PLC0415
    from impc.studies.fit.memory import open_memory  # noqa: PLC0415
    from impc.studies.fit.settings import require_used  # noqa: PLC0415
    from impc.studies.methods_table import methods_finding  # noqa: PLC0415

    require_writable(out)
    subject = read_subject(asked)
    problem, settings = subject.problem, subject.settings
    require_used(settings, (), "compare")
    require_consent(fit_effort(problem, settings), yes)
    memory = open_memory(out, problem, settings, "compare", subject.inputs.digest)
    held_out = settings.held_out
    count = len(stages(len(problem.recordings), held_out=held_out))
    with progress(count, "estimate", lambda _: memory.kept()) as done:
        remember = replace(memory, done=done).estimate
        compared = compare_recordings(problem, settings.settle, remember, held_out=held_out)
    with angles_in(subject.angles):
        report = compare_report(problem, compared, subject.provenance)
        content = report.files(pdf=pdf)
    written = write_files(out, content)
    memory.cache.forget()
    click.echo(report.verdict.text())
    click.echo(methods_finding(compared).text())
    print_files(out, written, open_page)
