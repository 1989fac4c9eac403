"""`impc select` and `impc key-parameters`: model parameters that recordings can identify."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from impc.cli.console import print_files, progress
from impc.cli.options import (
    Number,
    code_options,
    out_option,
    page_options,
    scheduler_options,
    yes_option,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from impc.files.digests import Inputs
    from impc.reporting.document import Report
    from impc.studies.cache import Cache
    from impc.studies.cohort.study import Study
    from impc.studies.pool import Result
    from impc.studies.scheduler import Cluster
    from impc.studies.selection.model import Trial
    from impc.studies.selection.model_source import ModelSource, Runner


@click.command("select")
@click.argument("study_file", metavar="STUDY", type=click.Path(path_type=Path))
@code_options("model")
@out_option("select", "report.html, result.json, tables and figure")
@page_options
@scheduler_options
@yes_option
def command(
    study_file: Path,
    model_name: str | None,
    allowed: bool,
    out: Path,
    cluster: Cluster,
    yes: bool,
    pdf: bool,
    open_page: bool,
) -> None:
    """Select sensitive parameters of a simulation model (chapter 4), per subject and pooled.

    [study] model is the import path of the model, [model] has its arguments, [select] the settings.
    If you interrupt the command, the same command continues from the last finished task.
    """
    from impc.cli.console import FEWER_STARTS, require_consent  # noqa: PLC0415
    from impc.reporting.writer import write_files  # noqa: PLC0415
    from impc.studies.effort import select_evaluations, selection_effort  # noqa: PLC0415
    from impc.studies.selection.analysis import select_study  # noqa: PLC0415
    from impc.studies.selection.report import read_truths, selection_report  # noqa: PLC0415
    from impc.studies.selection.settings import select_settings  # noqa: PLC0415

    study, source, recorded, inputs = read_model_study(study_file, model_name, allowed)
    settings = select_settings(study.configuration.select)
    named = {" visit ".join(part for part in key if part): item for key, item in recorded.items()}
    effort = selection_effort(source.model, named.values(), select_evaluations(settings))
    with study_runner(source, out, cluster, 2 * len(named)) as (run, threads):
        require_consent(effort.shared(len(named), threads), yes, FEWER_STARTS)
        found = select_study(named, settings, run)
    line = f"impc select {study_file.name} --model {source.name}"
    truths = read_truths(study_file.absolute().parent, source.model)
    people, visits = (len(set(names)) for names in zip(*recorded, strict=True))
    page = selection_report(source.model, found, line, inputs, truths, (people, visits))
    written = write_files(out, page.files(pdf=pdf))
    kept_results(out).forget()
    _print(page, "unit", "value", "low", "high")
    print_files(out, written, open_page)


def _print(page: Report, *columns: str) -> None:
    """Print the verdict and these `columns` of the table of estimates."""
    from impc.checking import replace  # noqa: PLC0415

    click.echo(page.verdict.text())
    for table in page.findings():
        if {*columns} <= {*table.shown}:
            shown = ("subject", "parameter", *columns)
            hidden = [name for name in table.shown if name not in shown]
            labels = {**table.labels, "low": "low (95 %)", "high": "high (95 %)"}
            click.echo(
                f"\n{replace(table, hidden=[*table.hidden, *hidden], labels=labels).text()}\n"
            )


def kept_results(out: Path) -> Cache:
    """Cache in the folder `out` of the results of single tasks, until the study is complete."""
    from impc.studies.cache import Cache  # noqa: PLC0415

    return Cache(out / "in-progress")


@contextmanager
def study_runner(
    source: ModelSource, out: Path, cluster: Cluster, tasks: int
) -> Iterator[tuple[Runner, int]]:
    """Yield a runner with a progress bar, and its number of workers."""
    from impc.studies.scheduler import connected  # noqa: PLC0415
    from impc.studies.selection.model_source import on_pool  # noqa: PLC0415

    kept = kept_results(out)

    def said(count: int) -> str:
        return f"{count} of {tasks} tasks are kept in {kept.folder}; the same command continues"

    with progress(tasks, "task", said) as tell, connected(cluster) as pool:

        def done(result: Result) -> None:
            tell(result.task.name, found=result.found)

        yield on_pool(pool, source, kept, done), pool.threads


def read_model_study(
    path: Path, given: str | None, allowed: bool
) -> tuple[Study, ModelSource, dict[tuple[str, str], tuple[Trial, ...]], Inputs]:
    """The study at `path`, its model, all recordings, and the digests of its files."""
    from impc.files.digests import gather_inputs  # noqa: PLC0415
    from impc.files.plant_sources import consented_name  # noqa: PLC0415
    from impc.studies.cohort.study import read_study  # noqa: PLC0415
    from impc.studies.selection.model_source import model_source, read_trials  # noqa: PLC0415

    study, where = read_study(path), f"{path}: study.model"
    name = consented_name(where, study.model, given, allowed, "model", ())
    arguments: dict[str, Any] = dict(study.configuration.model)
    source = model_source(name, arguments)
    recorded = read_trials(study, source)
    files = {unit.name: unit.files for unit in study.units}
    return study, source, recorded, gather_inputs(files, path, name, arguments, "model")


@click.command("key-parameters")
@click.argument("study_file", metavar="STUDY", type=click.Path(path_type=Path))
@code_options("model")
@out_option("key-parameters", "report.html, result.json, table and figure")
@click.option(
    "--bound",
    type=Number(min=0, max=1e6, min_open=True),
    default=0.35,
    help="Largest allowed variance of a parameter, in squared halves of its range.",
)
@click.option("--vaf", type=Number(), default=69.0, help="Smallest allowed mean VAF, %.")
@click.option(
    "--icc",
    type=Number(),
    help="Smallest allowed lower end of the 95 % interval of ICC(A,k). Default: 0.6, good.",
)
@page_options
@scheduler_options
@yes_option
def key_command(
    study_file: Path,
    model_name: str | None,
    allowed: bool,
    out: Path,
    bound: float,
    vaf: float,
    icc: float | None,
    cluster: Cluster,
    yes: bool,
    pdf: bool,
    open_page: bool,
) -> None:
    """Find key parameters (chapter 5) in a study of several subjects and visits.

    The study file is that of `impc select`. If you interrupt the command, the same command
    continues from the last finished task.
    """
    from impc.cli.console import FEWER_STARTS, require_consent  # noqa: PLC0415
    from impc.reporting.writer import write_files  # noqa: PLC0415
    from impc.studies.effort import key_evaluations, selection_effort  # noqa: PLC0415
    from impc.studies.reliability.icc import GOOD  # noqa: PLC0415
    from impc.studies.selection.analysis import key_parameters  # noqa: PLC0415
    from impc.studies.selection.key_report import key_report  # noqa: PLC0415
    from impc.studies.selection.settings import select_settings  # noqa: PLC0415

    icc = GOOD if icc is None else icc
    study, source, recorded, inputs = read_model_study(study_file, model_name, allowed)
    settings = select_settings(study.configuration.select)
    effort = selection_effort(source.model, recorded.values(), key_evaluations(settings))
    with study_runner(source, out, cluster, 2 * len(recorded)) as (run, threads):
        require_consent(effort.shared(len(recorded), threads), yes, FEWER_STARTS)
        found = key_parameters(
            source.model, recorded, settings, run,
            bound=bound, least_vaf=vaf, least_reliability=icc,
        )  # fmt: skip
    options = f"--model {source.name} --bound {bound:g} --vaf {vaf:g} --icc {icc:g}"
    line = f"impc key-parameters {study_file.name} {options}"
    page = key_report(source.model, found, line, inputs)
    written = write_files(out, page.files(pdf=pdf))
    kept_results(out).forget()
    _print(page, "free", "mean", "sd", "icc", "icc_low", "icc_high")
    print_files(out, written, open_page)
