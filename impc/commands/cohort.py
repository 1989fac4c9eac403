"""`impc cohort`: a study of many subjects, on this machine or a cluster."""

from __future__ import annotations

import sys
import time
from datetime import UTC, datetime
from pathlib import Path

import click
from tqdm import tqdm

from impc.commands.options import out_option, scheduler_options

__all__ = ["command"]

_SOME_FAILED = 1


@click.command("cohort")
@click.argument("study_file", metavar="STUDY", type=click.Path(path_type=Path))
@out_option("cohort", "results, tables and report; the same folder again goes on")
@scheduler_options
@click.pass_context
def command(
    context: click.Context, study_file: Path, out: Path, scheduler: str | None, workers: int | None
) -> None:
    """Fit every subject, visit and condition of a study, with bootstrap replicates.

    Ends with status 1 when a subject could not be fitted, and names the reason. It may be stopped
    at any time: what is done is kept, and the same command goes on from there.
    """
    # Imported here: the libraries take seconds to load, and --help needs none.
    from impc.cohort.cluster import connected  # noqa: PLC0415
    from impc.cohort.engine import Progress, run_study, work_left  # noqa: PLC0415
    from impc.cohort.report import write_report  # noqa: PLC0415
    from impc.cohort.store import open_store  # noqa: PLC0415
    from impc.cohort.study import read_study  # noqa: PLC0415
    from impc.fit_settings import fit_settings  # noqa: PLC0415

    study = read_study(study_file)
    fit_settings(study.configuration.fit)
    with open_store(out) as store, (out / "cohort.log").open("a", encoding="utf-8") as stream:
        done, total = work_left(study, store)

        def log(line: str) -> None:
            now = datetime.now(UTC).isoformat(timespec="seconds")
            stream.write(f"{now} {line}\n")
            stream.flush()

        with tqdm(
            total=total, initial=done, unit="task", file=sys.stderr, disable=None, smoothing=0.05
        ) as bar:
            begun, here = time.monotonic(), 0

            def told(unit: str, what: str, _: float) -> None:
                nonlocal here
                here += 1
                bar.set_postfix_str(f"{unit} {what}", refresh=False)
                bar.update()
                left = (total - done - here) * (time.monotonic() - begun) / here
                log(f"{done + here} of {total} tasks, {left / 60:.1f} min left")

            try:
                with connected(scheduler, workers) as client:
                    failed = run_study(study, store, client, Progress(told, log))
            except KeyboardInterrupt:
                finished, _ = work_left(study, store)
                raise KeyboardInterrupt(
                    f"{finished} of {total} tasks are kept in {out}; the same command goes on"
                ) from None
        write_report(study, store, f"impc cohort {study_file.name}")
    for unit, reason in failed.items():
        click.echo(f"{unit}: {reason}", err=True)
    fitted = len(study.units) - len({unit for unit in failed if store.fit(unit) is None})
    click.echo(f"{fitted} of {len(study.units)} units fitted; {out / 'report.html'}")
    if failed:
        context.exit(_SOME_FAILED)
