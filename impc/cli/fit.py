"""`impc fit` and `impc compare`: the control intent of a subject, by one method or by all."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from impc.checking import replace
from impc.cli.console import print_files, progress
from impc.cli.options import out_option, subject_arguments

if TYPE_CHECKING:
    from pathlib import Path

    from impc.studies.fit.memory import FitMemory
    from impc.studies.fit.result import FitResult


@click.command("fit")
@subject_arguments("What the columns mean, and settings; `impc inspect FILE` writes one.")
@out_option("fit", "report.html, result.json, tables and the figures")
def command(
    files: tuple[Path, ...],
    plant_name: str,
    config: Path,
    out: Path,
    solver: str | None,
    yes: bool,
) -> None:
    """Fit the controller behind the trials of one subject, one file a trial.

    What is done when you interrupt it is kept in the folder: the same command goes on from there.
    Where the plant is an impc.OptimalControlProblem, its parameters are fitted (docs/nonlinear.md).
    """
    # Imported here: the libraries take seconds to load, and --help needs none.
    from impc.cli.console import require_consent  # noqa: PLC0415
    from impc.cli.plant import read_subject  # noqa: PLC0415
    from impc.extras import installed  # noqa: PLC0415
    from impc.reporting.shown_units import angles_in  # noqa: PLC0415
    from impc.reporting.writer import require_writable, write_files  # noqa: PLC0415
    from impc.studies.effort import fit_effort  # noqa: PLC0415
    from impc.studies.fit.gain_findings import read_truth, truth_sentence  # noqa: PLC0415
    from impc.studies.fit.memory import open_memory  # noqa: PLC0415
    from impc.studies.fit.report import fit_report  # noqa: PLC0415
    from impc.studies.fit.subject import (  # noqa: PLC0415
        FitProgress,
        fit_recordings,
        stages,
    )
    from impc.studies.fit.verdict import missing  # noqa: PLC0415

    require_writable(out)
    if installed("impc.nonlinear") and _own_problem(files, plant_name, config, out, solver):
        return
    subject = read_subject("fit", files, plant_name, config, solver)
    problem, settings = subject.problem, subject.settings
    require_consent(fit_effort(problem, settings), yes)
    unknown = missing(settings, subject.source)
    if unknown:
        click.echo(unknown, err=True)
    memory = open_memory(out, problem, settings, "fit", subject.inputs.digest)
    truth = read_truth(files, problem.plant)
    # One more: the page with its figures takes ten seconds.
    with progress(stages(problem, settings) + 1, "stage", lambda _: memory.kept()) as done:

        def remembered(memory: FitMemory) -> FitProgress:
            kept = (memory.estimate, memory.replicate, memory.part)
            return FitProgress(done, *kept, lambda further: remembered(memory.about(further)))

        result = fit_recordings(problem, settings, remembered(memory))
        with angles_in(subject.angles):
            content = fit_report(result, subject.provenance, truth, unknown).files()
        done("page")
    written = write_files(out, content)
    memory.cache.forget()
    _print(result)
    if truth is not None:
        click.echo(truth_sentence(result, truth))
    print_files(out, written)


def _own_problem(
    files: tuple[Path, ...], plant_name: str, config: Path, out: Path, solver: str | None
) -> bool:
    """Fit, write and print, if the plant is an optimal control problem; else do nothing."""
    from impc.cli.plant import find_plant  # noqa: PLC0415
    from impc.files.configuration import read_configuration  # noqa: PLC0415
    from impc.files.digests import gather_inputs  # noqa: PLC0415
    from impc.files.plant_sources import made_by  # noqa: PLC0415
    from impc.nonlinear.files import fit_files  # noqa: PLC0415
    from impc.nonlinear.page import abstract, optimal_report, verdict  # noqa: PLC0415
    from impc.nonlinear.problem import OptimalControlProblem  # noqa: PLC0415
    from impc.reporting.provenance import Provenance  # noqa: PLC0415
    from impc.reporting.shown_units import angles_in  # noqa: PLC0415
    from impc.reporting.writer import write_files  # noqa: PLC0415

    configuration = read_configuration(config)
    source = find_plant(plant_name, configuration.plant)
    problem = made_by(source) if ":" in source.name else None  # a file holds matrices
    if not isinstance(problem, OptimalControlProblem):
        return False
    with progress(2, "stage") as done:
        fit = fit_files(problem, files, configuration, solver)
        done("search")
        names = tuple(path.name for path in files)
        line = f"impc fit {' '.join(names)} --plant {plant_name} --config {config.name}"
        line += "" if solver is None else f" --solver {solver}"
        inputs = gather_inputs(files, config, source.name, source.arguments)
        provenance = Provenance(source.name, line, dict(source.arguments), names, inputs)
        with angles_in(configuration.report.angles):
            content = optimal_report(fit, provenance).files()
        done("page")
    written = write_files(out, content)
    for sentence in (verdict(fit), *abstract(fit)):
        click.echo(sentence)
    print_files(out, written)
    return True


def _print(result: FitResult) -> None:
    """The table of methods and the intent, as the page has them."""
    from impc.assess.intent_statements import dominant_sentence  # noqa: PLC0415
    from impc.studies.fit.structure_words import structure_sentences  # noqa: PLC0415
    from impc.studies.fit.verdict import verdict  # noqa: PLC0415
    from impc.studies.methods_table import methods_finding  # noqa: PLC0415

    stated = (*structure_sentences(result), *result.person_sentences, *result.warnings)
    for line in dict.fromkeys((verdict(result), *stated)):
        click.echo(line)
    plant = result.fitted.problem.plant
    click.echo(methods_finding(result.methods).text())
    if result.held_out:
        for index, name in enumerate(plant.outputs):
            each = ", ".join(f"{item.vaf[index]:.2f}" for item in result.held_out)
            click.echo(f"VAF of trials left out, {name}: {each} %")
    intent = result.intent
    click.echo(dominant_sentence(intent.reported, plant, intent.sizes))
    click.echo(
        f"Other weights that explain the recordings equally well turn that direction by up to "
        f"{result.widest_angle:.0f} degrees: so far it is not the subject's."
    )


@click.command("compare")
@subject_arguments("What the columns mean, and settings, as for `impc fit`.")
@out_option("compare", "report.html, result.json, tables and the figure")
def compare_command(
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
