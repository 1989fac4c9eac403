"""`impc compare`: every method for the weights, on the same recordings."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click
from tqdm import tqdm

from impc.checking import replace
from impc.cli.options import out_option, yes_option
from impc.cli.output import print_files
from impc.cli.plant import KNOWN

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.inverse.estimate import Estimate

__all__ = ["command"]


@click.command("compare")
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--plant",
    "plant_name",
    required=True,
    help=f"{', '.join(KNOWN)}; module:function of your own; or a .mat, .npz or .json state space.",
)
@click.option(
    "--config",
    required=True,
    type=click.Path(path_type=Path),
    help="What the columns mean, and settings, as for `impc fit`.",
)
@out_option("compare", "report.html, result.json, comparison.csv and the figure")
@yes_option
def command(files: tuple[Path, ...], plant_name: str, config: Path, out: Path, yes: bool) -> None:
    """Compare feedback gain, inverse LQR, inverse KKT and inverse MPC, one file a trial.

    Each method is fitted to all trials and to all but each one. What is done when you interrupt it
    is kept in the folder: the same command goes on from there.
    """
    # Imported here: the libraries take seconds to load, and --help needs none.
    from impc.cli.consent import require_consent  # noqa: PLC0415
    from impc.cli.subject import read_subject  # noqa: PLC0415
    from impc.reporting.provenance import fit_provenance  # noqa: PLC0415
    from impc.reporting.writer import require_writable, write_files  # noqa: PLC0415
    from impc.studies.compare.report import compare_files, text_table  # noqa: PLC0415
    from impc.studies.compare.subject import compare_recordings, stages  # noqa: PLC0415
    from impc.studies.effort import fit_effort  # noqa: PLC0415
    from impc.studies.fit.memory import open_memory  # noqa: PLC0415

    require_writable(out)
    subject = read_subject(files, plant_name, config)
    problem, settings = subject.problem, subject.settings
    fits = replace(settings, replicates=0, profiles=[], horizons=[], held_out=True)
    require_consent(fit_effort(problem, fits), yes)
    memory = open_memory(out, problem, settings, "compare", subject.inputs.digest)
    with tqdm(
        total=stages(len(problem.recordings)),
        unit="estimate",
        file=sys.stderr,
        disable=None,  # no bar where stderr is a file
        leave=False,
    ) as bar:

        def remember(stage: str, compute: Callable[[], Estimate]) -> Estimate:
            found = memory.estimate(stage, compute)
            bar.set_postfix_str(stage, refresh=False)
            bar.update()
            return found

        try:
            compared = compare_recordings(problem, settings.settle, remember)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(memory.kept()) from None
    names = " ".join(path.name for path in files)
    line = f"impc compare {names} --plant {plant_name} --config {config.name}"
    provenance = fit_provenance(subject.source, subject.inputs, files, line)
    written = write_files(out, compare_files(problem, compared, provenance))
    memory.forget()
    click.echo(text_table(problem, compared))
    print_files(out, written)
