"""`impc cohort` and `impc reliability`: many subjects."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

from impc.checking import replace
from impc.cli.console import progress, publish, require_consent
from impc.cli.ending import ExitStatus
from impc.cli.options import Page
from impc.cli.plant import named_plant
from impc.files.configuration import Configuration
from impc.files.digests import gather_inputs
from impc.files.plant_sources import PlantSource, make_plant
from impc.files.reading import read_recordings, require_whole
from impc.reporting.shown_units import angles_in, shown_angle, signal_name
from impc.studies.cohort import tasks as work
from impc.studies.cohort.report import write_report
from impc.studies.cohort.study import Study, Unit, read_study
from impc.studies.fit.settings import fit_settings, require_used
from impc.studies.reliability.analysis import Trials, analyse
from impc.studies.reliability.report import reliability_report
from impc.studies.scheduler import Cluster, connected

# Settings with extra computations that a worker supports.
_USED = ("replicates", "structure")


def run_cohort(
    study_file: Path,
    given: str | None,
    allowed: bool,
    out: Path,
    cluster: Cluster,
    yes: bool,
    page: Page,
) -> None:
    """Fit a study; status 1 if a subject could not be fitted."""
    study = read_study(study_file)
    require_used(fit_settings(study.configuration.fit), _USED, "cohort")
    source = named_plant(study_file, study, given, allowed)
    unused = work.unused_columns(study, source)
    if unused:
        click.echo(f"columns that the plant has no argument for: {', '.join(unused)} (not used)")
    tasks, unreadable = work.study_tasks(study, source)
    store = work.open_store(out, tasks)
    failures = _run(study, tasks, store, cluster, yes)
    failures.units |= unreadable
    report = write_report(study, store, failures, f"impc cohort {study_file.name}", pdf=page.pdf)
    click.echo(report.verdict.text())
    for line in failures.lines:
        click.echo(line, err=True)
    fitted = len(study.units) - len(failures.units)
    click.echo(f"{fitted} of {len(study.units)} fits done; {out / 'report.html'}")
    if page.open:
        click.launch(str(out / "report.html"))
    if failures:
        click.get_current_context().exit(ExitStatus.PARTIAL)


def _run(
    study: Study, tasks: dict[str, work.FitTask], store: work.Store, cluster: Cluster, yes: bool
) -> work.Failures:
    """Run the remaining tasks with a progress bar; an interruption prints what is kept."""
    kept, total = work.work_kept(study, store)

    def said(_: int) -> str:
        finished, _ = work.work_kept(study, store)
        return f"{finished} of {total} tasks are kept in {store.folder}; the same command continues"

    with progress(total, "task", said) as tell, connected(cluster) as pool:
        if kept < total:
            left = len(tasks) * (total - kept) / total
            effort = work.unit_effort(tasks.values()).shared(left, pool.threads)
            if cluster.scheduler:  # the memory of other machines is unknown
                effort = replace(effort, gigabytes=0.0)
            require_consent(effort, yes)
        return work.run_study(study, tasks, store, pool, tell)


def run_reliability(
    study_file: Path, given: str | None, allowed: bool, out: Path, last: int, page: Page
) -> None:
    """Analyse the reliability of a study."""
    study = read_study(study_file)
    source = named_plant(study_file, study, given, allowed)
    units = [replace(unit, files=unit.files[-last:]) for unit in study.units]
    with angles_in(study.configuration.report.angles):
        trials = _trials_of(units, study.configuration, source)
    inputs = gather_inputs(
        {unit.name: unit.files for unit in units}, study_file, source.name, source.arguments
    )
    line = f"impc reliability {study_file.name} --plant {source.name} --last {last}"
    report = reliability_report(trials, analyse(trials), line, inputs)
    texts = [""]
    for item in report.findings():
        if item.name.startswith("icc-"):
            heads = ("measure", "condition", "icc", "low", "high", "mdc", "unit")
            hidden = [name for name in item.shown if name not in heads]
            labels = {"icc": "ICC", "mdc": "smallest change", "low": "low (95 %)"}
            texts.append(replace(item, hidden=[*item.hidden, *hidden], labels=labels).text())
    publish(report, out, page, *texts)


def _trials_of(units: Sequence[Unit], configuration: Configuration, source: PlantSource) -> Trials:
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
