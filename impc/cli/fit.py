"""`impc fit` and `impc compare`: the controller of a subject, by one method or by all."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from textwrap import fill

import click

from impc.arrays import Array
from impc.checking import replace
from impc.cli.console import progress, publish, require_consent
from impc.cli.options import Page
from impc.cli.plant import CONFIGURATION, KNOWN, AllFellError, Asked, find_plant, read_subject
from impc.extras import installed
from impc.files.plant_sources import made_by
from impc.reporting.shown_units import angles_in
from impc.reporting.verdict import WIDTH
from impc.studies.compare import subject as comparison
from impc.studies.compare.report import compare_report
from impc.studies.effort import fit_effort
from impc.studies.fit.findings import per_unit_finding, read_truth, truth_found
from impc.studies.fit.memory import open_memory
from impc.studies.fit.report import fallen_report, fit_report
from impc.studies.fit.result import FitResult
from impc.studies.fit.settings import missing, require_used
from impc.studies.fit.subject import fit_recordings, stages
from impc.studies.fit.verdict import GAIN, RULES
from impc.studies.methods_table import methods_finding

# Title of the last stage.
_PAGE = "report and figures"


def run_fit(asked: Asked, out: Path, yes: bool, page: Page) -> None:
    """Fit a subject, or the parameters of an optimal control problem."""
    # No known plant is an optimal control problem.
    if asked.plant not in KNOWN and installed("impc.nonlinear") and _own_problem(asked, out, page):
        return
    try:
        subject = read_subject(asked)
    except AllFellError as fallen:
        publish(fallen_report(fallen.falls, fallen.provenance), out, page)
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
    with angles_in(subject.angles):
        with progress(count, "stage", lambda _: memory.kept()) as done:
            result = fit_recordings(problem, settings, memory.progress(done))
            result = replace(result, falls=subject.falls)
            report = fit_report(result, subject.provenance, truth, unknown)
            files = report.files(pdf=page.pdf) | used
            done(_PAGE)
        publish(report, out, page, *_texts(result, truth), kept=memory.cache, files=files)


def _own_problem(asked: Asked, out: Path, page: Page) -> bool:
    """Fit, write and print if the plant is an optimal control problem; return whether it is."""
    from impc.nonlinear.files import fit_files  # noqa: PLC0415  # optional
    from impc.nonlinear.page import optimal_report  # noqa: PLC0415
    from impc.nonlinear.problem import OptimalControlProblem  # noqa: PLC0415

    configuration = asked.configuration
    source = find_plant(asked.plant, configuration.plant)
    problem = made_by(source) if ":" in source.name else None  # files hold matrices only
    if not isinstance(problem, OptimalControlProblem):
        return False
    with progress(2, "stage") as done, angles_in(configuration.report.angles):
        fit = fit_files(problem, asked.files, configuration, asked.solver)
        done("search")
        report = optimal_report(fit, asked.provenance(source, asked.inputs(source)))
        files = report.files(pdf=page.pdf) | {CONFIGURATION: asked.config.read_bytes()}
        done(_PAGE)
    publish(report, out, page, files=files)
    return True


def _texts(result: FitResult, truth: Array | None) -> Iterator[str]:
    """Gain, methods and, for simulated recordings, the true gain, for the terminal."""
    if GAIN not in RULES.forbidden(result):
        yield f"\n{per_unit_finding(result).text()}"
    yield f"\n{methods_finding(result.methods[::-1]).text()}\n"
    if truth is not None:
        yield fill(truth_found(result, truth)[1], WIDTH)


def run_compare(asked: Asked, out: Path, yes: bool, page: Page) -> None:
    """Fit all methods to the recordings of a subject."""
    subject = read_subject(asked)
    problem, settings = subject.problem, subject.settings
    require_used(settings, (), "compare")
    require_consent(fit_effort(problem, settings), yes)
    memory = open_memory(out, problem, settings, "compare", subject.inputs.digest)
    held_out = settings.held_out
    count = len(comparison.stages(len(problem.recordings), held_out=held_out))
    with progress(count, "estimate", lambda _: memory.kept()) as done:
        remember = replace(memory, done=done).estimate
        compared = comparison.compare_recordings(
            problem, settings.settle, remember, held_out=held_out
        )
    with angles_in(subject.angles):
        report = compare_report(problem, compared, subject.provenance)
        publish(report, out, page, methods_finding(compared).text(), kept=memory.cache)
