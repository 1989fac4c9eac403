"""`impc key-parameters`: parameters that are sensitive, explaining and reliable (chapter 5)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from impc.cli.numbers import Number
from impc.cli.options import code_options, out_option, scheduler_options
from impc.cli.output import print_files
from impc.cli.select import kept_results, read_model_study, study_runner

if TYPE_CHECKING:
    from impc.studies.cohort.cluster import Cluster

__all__ = ["command"]


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
def command(
    study_file: Path,
    model_name: str | None,
    allowed: bool,
    out: Path,
    bound: float,
    vaf: float,
    icc: float,
    cluster: Cluster,
) -> None:
    """Key parameters of a study of several subjects and visits.

    The study file is that of `impc select`. It may be stopped at any time: the same command goes on
    from there.
    """
    from impc.reporting.writer import write_files  # noqa: PLC0415
    from impc.studies.selection.key_parameters import key_parameters  # noqa: PLC0415
    from impc.studies.selection.key_report import key_report  # noqa: PLC0415
    from impc.studies.selection.settings import select_settings  # noqa: PLC0415

    study, source, recorded = read_model_study(study_file, model_name, allowed)
    settings = select_settings(study.configuration.select)
    with study_runner(source, out, cluster, 2 * len(recorded)) as run:
        found = key_parameters(
            source.model, recorded, settings, run,
            bound=bound, least_vaf=vaf, least_reliability=icc,
        )  # fmt: skip
    line = f"impc key-parameters {study_file.name} --bound {bound:g} --vaf {vaf:g} --icc {icc:g}"
    written = write_files(out, key_report(source.model, found, line).files())
    kept_results(out).forget()
    names = source.model.names
    chosen = ", ".join(names[index] for index in found.chosen) or "none passes all filters"
    click.echo(f"key parameters: {chosen}")
    print_files(out, written)
