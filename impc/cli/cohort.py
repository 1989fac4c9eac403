"""`impc cohort`, `impc reliability` and `impc results`: many subjects."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from impc.checking import replace
from impc.cli.console import print_files, progress
from impc.cli.ending import ExitStatus
from impc.cli.options import (
    code_options,
    out_option,
    page_options,
    scheduler_options,
    yes_option,
)
from impc.cli.plant import named_plant

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.files.configuration import Configuration
    from impc.files.plant_sources import PlantSource
    from impc.studies.cohort.study import Study, Unit
    from impc.studies.cohort.tasks import Failures, FitTask, Store
    from impc.studies.reliability.analysis import Trials
    from impc.studies.scheduler import Cluster

# Settings with extra computations that a worker supports.
_USED = ("replicates", "structure")


@click.command("cohort")
@click.argument("study_file", metavar="STUDY", type=click.Path(path_type=Path))
@code_options("plant")
@out_option("cohort", "results, tables and report; give the same folder again to continue")
@page_options
@scheduler_options
@yes_option
@click.pass_context
def command(
    context: click.Context,
    study_file: Path,
    plant_name: str | None,
    allowed: bool,
    out: Path,
    cluster: Cluster,
    yes: bool,
    pdf: bool,
    open_page: bool,
) -> None:
    """Fit every subject, visit and condition of a study, with bootstrap replicates.

    Ends with status 1 if a subject could not be fitted, and names the reason. If you interrupt it,
    the same command continues from the last finished task.
    """
    # Imported here: the libraries take seconds to load, and --help needs none.
    from impc.studies.cohort.report import write_report  # noqa: PLC0415
    from impc.studies.cohort.study import read_study  # noqa: PLC0415
    from impc.studies.cohort.tasks import (  # noqa: PLC0415
        open_store,
        study_tasks,
        unused_columns,
    )
    from impc.studies.fit.settings import fit_settings, require_used  # noqa: PLC0415

    study = read_study(study_file)
    require_used(fit_settings(study.configuration.fit), _USED, "cohort")
    source = named_plant(study_file, study, plant_name, allowed)
    unused = unused_columns(study, source)
    if unused:
        click.echo(f"columns that the plant has no argument for: {', '.join(unused)} (not used)")
    tasks, unreadable = study_tasks(study, source)
    store = open_store(out, tasks)
    failures = _run(study, tasks, store, cluster, yes)
    failures.units |= unreadable
    report = write_report(study, store, failures, f"impc cohort {study_file.name}", pdf=pdf)
    click.echo(report.verdict.text())
    for line in failures.lines:
        click.echo(line, err=True)
    fitted = len(study.units) - len(failures.units)
    click.echo(f"{fitted} of {len(study.units)} fits done; {out / 'report.html'}")
    if open_page:
        click.launch(str(out / "report.html"))
    if failures:
        context.exit(ExitStatus.PARTIAL)


def _run(
    study: Study, tasks: dict[str, FitTask], store: Store, cluster: Cluster, yes: bool
) -> Failures:
    """Run the remaining tasks with a progress bar; an interruption prints what is kept."""
    from impc.cli.console import require_consent  # noqa: PLC0415
    from impc.studies.cohort.tasks import (  # noqa: PLC0415
        run_study,
        unit_effort,
        work_kept,
    )
    from impc.studies.scheduler import connected  # noqa: PLC0415

    kept, total = work_kept(study, store)

    def said(_: int) -> str:
        finished, _ = work_kept(study, store)
        return f"{finished} of {total} tasks are kept in {store.folder}; the same command continues"

    with progress(total, "task", said) as tell, connected(cluster) as pool:
        if kept < total:
            left = len(tasks) * (total - kept) / total
            effort = unit_effort(tasks.values()).shared(left, pool.threads)
            if cluster.scheduler:  # the memory of other machines is unknown
                effort = replace(effort, gigabytes=0.0)
            require_consent(effort, yes)
        return run_study(study, tasks, store, pool, tell)


@click.command("results")
@click.argument("folder", type=click.Path(path_type=Path))
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    help="Write all columns to this .xlsx file, with command, versions and SHA-256 of the inputs "
    "in a second sheet, or to this .csv file; never overwrites a file.",
)
def results_command(folder: Path, out: Path | None) -> None:
    """Show the fits in a folder and below, one row each, newest first.

    Gains that the page of a fit forbids to report are empty; the column reason says why.
    """
    from impc.errors import InputError, OutputError, one_line  # noqa: PLC0415
    from impc.files.formats import write_file  # noqa: PLC0415
    from impc.files.results import results_and_origins  # noqa: PLC0415
    from impc.files.spreadsheet import as_data, workbook_bytes  # noqa: PLC0415
    from impc.reporting.finding import Finding, csv_bytes  # noqa: PLC0415

    if out is not None and out.suffix not in (".xlsx", ".csv"):
        raise InputError("--out", f"got {out.name}", "end it in .xlsx or .csv")
    if out is not None and out.exists():
        raise OutputError(str(out), "already exists", "choose another name, or remove it")
    table, origins = results_and_origins(folder)
    if not len(table):
        raise InputError(
            str(folder), "has no result.json below it", "run impc fit, or name another"
        )
    if out is not None:
        sheets = {"fits": table, "provenance": origins}
        write_file(out, workbook_bytes(sheets) if out.suffix == ".xlsx" else csv_bytes(table))
    fits, others = (table[one] for one in (table["note"] == "", table["note"] != ""))
    # A terminal has room for the first output and the first gain.
    names = list(map(str, table))
    vaf = [name for name in names if name.startswith("vaf.")][:1]
    gain = [name for name in names if f"{name}_unit" in names][:1]
    ends = {f"{name}_{end}": end for name in gain for end in ("low", "high")}
    heads = {name: f"VAF {one_line(name[4:], 20)} (%)" for name in vaf} | ends
    heads |= {name: one_line(fits[f"{name}_unit"].iloc[0], 30) for name in gain}
    shown = fits.reindex(columns=["folder", "subject", "verdict", *vaf, *gain, *ends])
    click.echo(Finding("fits", as_data(shown), labels=heads).text())
    for place, note in zip(others["folder"], others["note"], strict=True):
        click.echo(f"{one_line(place)}: {one_line(note)}", err=True)


@click.command("reliability")
@click.argument("study_file", metavar="STUDY", type=click.Path(path_type=Path))
@code_options("plant")
@out_option("reliability", "report.html, result.json, tables and figures")
@page_options
@click.option(
    "--last",
    type=click.IntRange(min=1),
    default=3,
    help="Use the last N trials of each visit.",
)
def reliability_command(
    study_file: Path,
    plant_name: str | None,
    allowed: bool,
    out: Path,
    last: int,
    pdf: bool,
    open_page: bool,
) -> None:
    """Analyse test-retest reliability over subjects, visits, conditions and trials.

    The study file is that of `impc cohort`.
    """
    from impc.files.digests import gather_inputs  # noqa: PLC0415
    from impc.reporting.shown_units import angles_in  # noqa: PLC0415
    from impc.reporting.writer import write_files  # noqa: PLC0415
    from impc.studies.cohort.study import read_study  # noqa: PLC0415
    from impc.studies.reliability.analysis import analyse  # noqa: PLC0415
    from impc.studies.reliability.report import reliability_report  # noqa: PLC0415

    study = read_study(study_file)
    source = named_plant(study_file, study, plant_name, allowed)
    units = [replace(unit, files=unit.files[-last:]) for unit in study.units]
    with angles_in(study.configuration.report.angles):
        trials = _trials_of(units, study.configuration, source)
    inputs = gather_inputs(
        {unit.name: unit.files for unit in units}, study_file, source.name, source.arguments
    )
    result = analyse(trials)
    line = f"impc reliability {study_file.name} --plant {source.name} --last {last}"
    report = reliability_report(trials, result, line, inputs)
    written = write_files(out, report.files(pdf=pdf))
    click.echo(f"{report.verdict.text()}\n")
    for item in report.findings():
        if item.name.startswith("icc-"):
            heads = ("measure", "condition", "icc", "low", "high", "mdc", "unit")
            hidden = [name for name in item.shown if name not in heads]
            labels = {"icc": "ICC", "mdc": "smallest change", "low": "low (95 %)"}
            click.echo(replace(item, hidden=[*item.hidden, *hidden], labels=labels).text())
    print_files(out, written, open_page)


def _trials_of(units: Sequence[Unit], configuration: Configuration, source: PlantSource) -> Trials:
    from impc.files.plant_sources import make_plant  # noqa: PLC0415
    from impc.files.reading import read_recordings, require_whole  # noqa: PLC0415
    from impc.reporting.shown_units import shown_angle, signal_name  # noqa: PLC0415
    from impc.studies.reliability.analysis import Trials  # noqa: PLC0415

    cells = {}
    factor, shown = shown_angle()
    recorded = configuration.recorded
    plant = make_plant(source, recorded)
    with progress(len(units), "visit") as done:
        for unit in units:
            found = read_recordings(unit.files, configuration, plant)
            require_whole(found, "reliability")
            cells[unit.subject, unit.visit, unit.condition] = [
                (item.disturbance[:, 0], factor * item.outputs) for item in found
            ]
            done(unit.name)
    words = {name: signal_name(plant, name) for name in plant.outputs}
    return Trials(words, shown, 1 / plant.dt, cells)
