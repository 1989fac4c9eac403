"""`impc fit`: the control intent of a subject from recordings in files."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click
from tqdm import tqdm

from impc.cli.options import out_option, yes_option
from impc.cli.output import print_files
from impc.cli.plant import KNOWN

if TYPE_CHECKING:
    from impc.studies.fit.result import FitResult

__all__ = ["command"]


@click.command("fit")
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
    help="What the columns mean, and settings; `impc inspect FILE` writes one.",
)
@out_option("fit", "report.html, result.json and the figures")
@yes_option
def command(files: tuple[Path, ...], plant_name: str, config: Path, out: Path, yes: bool) -> None:
    """Fit the controller behind the trials of one subject, one file a trial.

    What is done when you interrupt it is kept in the folder: the same command goes on from there.
    """
    # Imported here: the libraries take seconds to load, and --help needs none.
    from impc.cli.consent import require_consent  # noqa: PLC0415
    from impc.cli.subject import read_subject  # noqa: PLC0415
    from impc.reporting.provenance import fit_provenance  # noqa: PLC0415
    from impc.reporting.writer import require_writable, write_files  # noqa: PLC0415
    from impc.studies.effort import fit_effort  # noqa: PLC0415
    from impc.studies.fit.memory import open_memory  # noqa: PLC0415
    from impc.studies.fit.report import fit_files  # noqa: PLC0415
    from impc.studies.fit.subject import (  # noqa: PLC0415
        FitProgress,
        fit_recordings,
        stages,
    )

    require_writable(out)
    subject = read_subject(files, plant_name, config)
    problem, settings = subject.problem, subject.settings
    require_consent(fit_effort(problem, settings), yes)
    memory = open_memory(out, problem, settings, "fit", subject.inputs.digest)
    with tqdm(
        total=stages(problem, settings),
        unit="stage",
        file=sys.stderr,
        disable=None,  # no bar where stderr is a file
        leave=False,
    ) as bar:

        def done(stage: str) -> None:
            bar.set_postfix_str(stage, refresh=False)
            bar.update()

        try:
            result = fit_recordings(
                problem, settings, FitProgress(done, memory.estimate, memory.replicate)
            )
        except KeyboardInterrupt:
            raise KeyboardInterrupt(memory.kept()) from None
    names = " ".join(path.name for path in files)
    line = f"impc fit {names} --plant {plant_name} --config {config.name}"
    provenance = fit_provenance(subject.source, subject.inputs, files, line)
    written = write_files(out, fit_files(result, provenance))
    memory.forget()
    _print(result)
    print_files(out, written)


def _print(result: FitResult) -> None:
    """The table of methods and the intent, as the page has them."""
    from impc.assess.intent_rules import dominant_sentence  # noqa: PLC0415

    for line in result.warnings:
        click.echo(line)
    plant = result.fitted.problem.plant
    heads = "".join(f"{f'VAF {name}':>16}" for name in plant.outputs)
    click.echo(f"{'method':<20}{heads}{'largest input':>16}  ")
    for method in result.methods:
        values = "".join(f"{value:16.2f}" for value in method.vaf)
        largest = " ".join(f"{value:.3g}" for value in method.largest_input)
        kept = "" if method.keeps_bounds else "  exceeds its bound"
        fell = [time for time in method.fell if time is not None]
        note = f"  falls at {min(fell):.1f} s" if fell else kept
        click.echo(f"{method.name:<20}{values}{largest:>16}{note}")
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
