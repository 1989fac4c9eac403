"""`impc key-parameters`: parameters that are sensitive, explaining and reliable (chapter 5)."""

from __future__ import annotations

import sys
from pathlib import Path

import click
from tqdm import tqdm

from impc.commands.output import print_files
from impc.commands.select import read_model_study

__all__ = ["command"]


@click.command("key-parameters")
@click.argument("study_file", metavar="STUDY", type=click.Path(path_type=Path))
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("results", "key-parameters"),
    show_default=True,
    help="Folder for report.html, result.json, table and figure.",
)
@click.option(
    "--bound",
    type=click.FloatRange(min=0, min_open=True),
    default=0.35,
    show_default=True,
    help="Largest variance, in halves of the ranges, squared.",
)
@click.option("--vaf", type=float, default=69.0, show_default=True, help="Least mean VAF, %.")
@click.option("--icc", type=float, default=0.75, show_default=True, help="Least ICC(A,k).")
def command(study_file: Path, out: Path, bound: float, vaf: float, icc: float) -> None:
    """Key parameters of a study of several subjects and visits.

    The study file is that of `impc select`.
    """
    import numpy as np  # noqa: PLC0415

    from impc.report.write import require_writable, write_files  # noqa: PLC0415
    from impc.selection.estimation import multi_start  # noqa: PLC0415
    from impc.selection.key_parameters import key_parameters  # noqa: PLC0415
    from impc.selection.report import key_files  # noqa: PLC0415

    require_writable(out)
    _, source, recorded = read_model_study(study_file)
    model = source.model
    nominal = {}
    with tqdm(total=len(recorded), unit="fit", file=sys.stderr, disable=None, leave=False) as bar:
        for key, trials in recorded.items():
            nominal[key] = np.array(multi_start(model, trials, range(model.size), 2, 0)[0].theta)
            bar.update()
    found = key_parameters(
        model, recorded, nominal, bound=bound, least_vaf=vaf, least_reliability=icc
    )
    line = f"impc key-parameters {study_file.name} --bound {bound:g} --vaf {vaf:g} --icc {icc:g}"
    written = write_files(out, key_files(model, found, line))
    chosen = ", ".join(model.names[index] for index in found.chosen) or "none passes all filters"
    click.echo(f"key parameters: {chosen}")
    print_files(out, written)
