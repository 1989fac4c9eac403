"""`impc select` and `impc key-parameters`: model parameters that recordings can identify."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from impc.checking import replace
from impc.cli.console import FEWER_STARTS, progress, publish, require_consent
from impc.cli.options import Page
from impc.files.digests import Inputs, gather_inputs
from impc.files.plant_sources import consented_name
from impc.reporting.document import Report
from impc.studies.cache import Cache
from impc.studies.cohort.study import Study, read_study
from impc.studies.effort import key_evaluations, select_evaluations, selection_effort
from impc.studies.fit.settings import read_settings
from impc.studies.pool import Result
from impc.studies.reliability.icc import GOOD
from impc.studies.scheduler import Cluster, connected
from impc.studies.selection.analysis import key_parameters, select_study
from impc.studies.selection.key_report import key_report
from impc.studies.selection.model import Trial
from impc.studies.selection.model_source import (
    ModelSource,
    Runner,
    model_source,
    on_pool,
    read_trials,
)
from impc.studies.selection.report import read_truths, selection_report
from impc.studies.selection.settings import SelectSettings


def run_select(
    study_file: Path,
    given: str | None,
    allowed: bool,
    out: Path,
    cluster: Cluster,
    yes: bool,
    page: Page,
) -> None:
    """Select the parameters that can be estimated."""
    study, source, recorded, inputs = read_model_study(study_file, given, allowed)
    settings = read_settings("select", SelectSettings, study.configuration.select)
    named = {" visit ".join(part for part in key if part): item for key, item in recorded.items()}
    effort = selection_effort(source.model, named.values(), select_evaluations(settings))
    with study_runner(source, out, cluster, 2 * len(named)) as (run, threads):
        require_consent(effort.shared(len(named), threads), yes, FEWER_STARTS)
        found = select_study(named, settings, run)
    line = f"impc select {study_file.name} --model {source.name}"
    truths = read_truths(study_file.absolute().parent, source.model)
    people, visits = (len(set(names)) for names in zip(*recorded, strict=True))
    report = selection_report(source.model, found, line, inputs, truths, (people, visits))
    texts = _texts(report, "unit", "value", "low", "high")
    publish(report, out, page, *texts, kept=kept_results(out))


def run_key_parameters(
    study_file: Path,
    given: str | None,
    allowed: bool,
    out: Path,
    bound: float,
    vaf: float,
    icc: float | None,
    cluster: Cluster,
    yes: bool,
    page: Page,
) -> None:
    """Find the parameters that are repeatable between visits."""
    icc = GOOD if icc is None else icc
    study, source, recorded, inputs = read_model_study(study_file, given, allowed)
    settings = read_settings("select", SelectSettings, study.configuration.select)
    effort = selection_effort(source.model, recorded.values(), key_evaluations(settings))
    with study_runner(source, out, cluster, 2 * len(recorded)) as (run, threads):
        require_consent(effort.shared(len(recorded), threads), yes, FEWER_STARTS)
        found = key_parameters(
            source.model, recorded, settings, run,
            bound=bound, least_vaf=vaf, least_reliability=icc,
        )  # fmt: skip
    options = f"--model {source.name} --bound {bound:g} --vaf {vaf:g} --icc {icc:g}"
    line = f"impc key-parameters {study_file.name} {options}"
    report = key_report(source.model, found, line, inputs)
    texts = _texts(report, "free", "mean", "sd", "icc", "icc_low", "icc_high")
    publish(report, out, page, *texts, kept=kept_results(out))


def _texts(page: Report, *columns: str) -> Iterator[str]:
    """Table of estimates with these `columns`, for the terminal."""
    for table in page.findings():
        if {*columns} <= {*table.shown}:
            shown = ("subject", "parameter", *columns)
            hidden = [name for name in table.shown if name not in shown]
            labels = {**table.labels, "low": "low (95 %)", "high": "high (95 %)"}
            shorter = replace(table, hidden=[*table.hidden, *hidden], labels=labels)
            yield f"\n{shorter.text()}\n"


def kept_results(out: Path) -> Cache:
    """Cache in the folder `out` of the results of single tasks, until the study is complete."""
    return Cache(out / "in-progress")


@contextmanager
def study_runner(
    source: ModelSource, out: Path, cluster: Cluster, tasks: int
) -> Iterator[tuple[Runner, int]]:
    """Yield a runner with a progress bar, and its number of workers."""
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
    study, where = read_study(path), f"{path}: study.model"
    name = consented_name(where, study.model, given, allowed, "model", ())
    arguments: dict[str, Any] = dict(study.configuration.model)
    source = model_source(name, arguments)
    recorded = read_trials(study, source)
    files = {unit.name: unit.files for unit in study.units}
    return study, source, recorded, gather_inputs(files, path, name, arguments, "model")
