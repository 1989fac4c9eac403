"""`impc example`: the simulation example of the dissertation, and a sweep over its limit."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from impc.cli.console import print_files, progress
from impc.cli.options import out_option, page_options, solver_option
from impc.cli.plant import load_plant
from impc.cli.seat import HORIZON, PLANT, seat_weights

if TYPE_CHECKING:
    from impc.reporting.document import Report
    from impc.studies.example.sweep import Setup

# impc does not import `plants`: the plant is named by its import path, ``module:function``.
_EXAMPLE_PLANT = "plants:yalmip_example"
_SEEDS = 7


@click.command("example")
@click.option(
    "--case",
    type=click.Choice(["A", "B", "C", "all"]),
    default="all",
    help="Initial state: A (1, 3), B (2, 3), C (2, 1).",
)
@click.option(
    "--sweep",
    type=click.Choice(["example", "seat"]),
    help="Instead of the cases: inverse MPC against inverse LQR over 0 to 60 % of samples at the "
    "limit, exact, with noise, a wrong limit and a wrong plant, on the example's plant "
    "(minutes) or the seat (longer).",
)
@click.option("--seeds", type=click.IntRange(1, 1000), default=_SEEDS, help="Seeds of --sweep.")
@out_option("example", "report.html, result.json, tables and the figures")
@page_options
@solver_option
def command(
    case: str,
    sweep: str | None,
    seeds: int,
    out: Path,
    solver: str | None,
    pdf: bool,
    open_page: bool,
) -> None:
    """Run the simulation example of the dissertation with all methods.

    The dissertation does not give matrices, initial state and bound; a plant with the properties
    that its text describes replaces them. If you interrupt a sweep, the same command continues it.
    """
    # Imported here: the libraries take seconds to load, and --help and --version need none.
    from impc.reporting.writer import require_writable, write_files  # noqa: PLC0415
    from impc.studies.example.cases import LOST  # noqa: PLC0415

    require_writable(out)
    if sweep is not None and (case != "all" or solver is not None):
        raise click.UsageError("--sweep has no cases and its own solver: remove --case, --solver.")
    if sweep is None and seeds != _SEEDS:
        raise click.UsageError("--seeds is for --sweep: give both, or remove it.")
    report = _cases(case, solver) if sweep is None else _swept(sweep, seeds, out)
    written = write_files(out, report.files(pdf=pdf))
    click.echo(report.verdict.text())
    if sweep is None:
        click.echo(click.wrap_text(LOST, width=100))
    for finding in report.findings():
        click.echo(f"\n{finding.name}\n{finding.text()}")
    print_files(out, written, open_page)


def _cases(case: str, solver: str | None) -> Report:
    from impc.control.named_solver import COMPILED, require_solver  # noqa: PLC0415
    from impc.reporting.provenance import Provenance  # noqa: PLC0415
    from impc.studies.example.cases import CASES, EXAMPLE, run_case  # noqa: PLC0415
    from impc.studies.example.report import example_report  # noqa: PLC0415

    chosen = require_solver(COMPILED if solver is None else solver)
    plant = load_plant(_EXAMPLE_PLANT)
    names = tuple(CASES) if case == "all" else (case,)
    with progress(len(names) * len(EXAMPLE), "method") as step:
        cases = [run_case(plant, name, solver=chosen, progress=step) for name in names]
    return example_report(cases, Provenance(_EXAMPLE_PLANT, f"impc example --case {case}"))


def _swept(name: str, seeds: int, out: Path) -> Report:
    from impc.reporting.provenance import Provenance  # noqa: PLC0415
    from impc.studies.cache import Cache  # noqa: PLC0415
    from impc.studies.example.sweep import CONDITIONS, LEVELS, run_sweep  # noqa: PLC0415
    from impc.studies.example.sweep_report import sweep_report  # noqa: PLC0415
    from impc.studies.pool import processes  # noqa: PLC0415

    count, cache = seeds * len(LEVELS) * len(CONDITIONS), Cache(out / "sweep-in-progress")
    kept = f"finished recordings are kept in {cache.folder}; the same command continues from there"
    with progress(count, "recording", lambda _: kept) as done, processes(None) as pool:
        sweep = run_sweep(_setup(name), seeds, pool, cache, done)
    cache.forget()
    line = f"impc example --sweep {name} --seeds {seeds}"
    place = {"example": ("plant of the example", _EXAMPLE_PLANT), "seat": ("seat", PLANT)}[name]
    return sweep_report(sweep, place[0], Provenance(place[1], line))


def _setup(name: str) -> Setup:
    """The simulated loop: trials of 60 s at 1 Hz, or of 10 s at 100 Hz on the seat."""
    import numpy as np  # noqa: PLC0415

    from impc.files.plant_sources import make_plant, plant_source  # noqa: PLC0415
    from impc.model.weights import Weights  # noqa: PLC0415
    from impc.studies.example.sweep import Setup, pushed  # noqa: PLC0415

    if name == "example":
        plant = pushed(load_plant(_EXAMPLE_PLANT))
        return Setup(plant, Weights(np.eye(plant.n), np.eye(plant.m)), 5, 60, 1, 1.0)
    plant = make_plant(plant_source(PLANT, {}), ("perturbation",))
    return Setup(plant, seat_weights(plant), HORIZON, 1000, 12, 5.0)
