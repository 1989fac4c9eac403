"""`impc key-parameters`: parameters that are sensitive, explaining and reliable (chapter 5)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from impc.cli.options import Number, code_options, out_option, scheduler_options, yes_option
from impc.cli.output import print_files
from impc.cli.select import kept_results, read_model_study, study_runner

if TYPE_CHECKING:
    from impc.studies.scheduler import Cluster


@click.command("key-parameters")
@click.argument("study_file", metavar="STUDY", type=click.Path(path_type=Path))
@code_options("model")
@out_option("key-parameters", "report.html, result.json, table and figure")
@click.option(
    "--bound",
    type=Number(min=0, max=1e6, min_open=True),
    default=0.35,
    help="Largest variance, in halves of the ranges, squared.",
)
@click.option("--vaf", type=Number(), default=69.0, help="Least mean VAF, %.")
@click.option("--icc", type=Number(), default=0.75, help="Least ICC(A,k).")
@scheduler_options
@yes_option
def command(
    study_file: Path,
    model_name: str | None,
    allowed: bool,
    out: Path,
    bound: float,
    vaf: float,
    icc: float,
    cluster: Cluster,
    yes: bool,
) -> None:
    """Key parameters of a study of several subjects and visits.

    The study file is that of `impc select`. It may be stopped at any time: the same command goes on
    from there.
    """
    from impc.cli.consent import FEWER_STARTS, require_consent  # noqa: PLC0415
    from impc.reporting.writer import write_files  # noqa: PLC0415
    from impc.studies.effort import key_evaluations, selection_effort  # noqa: PLC0415
    from impc.studies.selection.key_parameters import key_parameters  # noqa: PLC0415
    from impc.studies.selection.key_report import key_report  # noqa: PLC0415
    from impc.studies.selection.settings import select_settings  # noqa: PLC0415

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
    written = write_files(out, key_report(source.model, found, line, inputs).files())
    kept_results(out).forget()
    names = source.model.names
    chosen = ", ".join(names[index] for index in found.chosen) or "none passes all filters"
    click.echo(f"key parameters: {chosen}")
    print_files(out, written)
