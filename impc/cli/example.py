"""`impc example`: the simulation example of the dissertation."""

from __future__ import annotations

from pathlib import Path

import click

from impc.cli.console import print_files, progress
from impc.cli.options import out_option, page_options, solver_option
from impc.cli.plant import load_plant

# impc does not import `plants`: the plant is named by its import path, ``module:function``.
_EXAMPLE_PLANT = "plants:yalmip_example"


@click.command("example")
@click.option(
    "--case",
    type=click.Choice(["A", "B", "C", "all"]),
    default="all",
    help="Initial state: A (1, 3), B (2, 3), C (2, 1).",
)
@out_option("example", "report.html, result.json and the figures")
@page_options
@solver_option
def command(case: str, out: Path, solver: str | None, pdf: bool, open_page: bool) -> None:
    """Run the simulation example of the dissertation with all methods.

    The dissertation does not give matrices, initial state and bound; a plant with the properties
    that its text describes replaces them.
    """
    # Imported here: the libraries take seconds to load, and --help and --version need none.
    from impc.control.named_solver import COMPILED, require_solver  # noqa: PLC0415
    from impc.reporting.provenance import Provenance  # noqa: PLC0415
    from impc.reporting.writer import require_writable, write_files  # noqa: PLC0415
    from impc.studies.example.cases import CASES, EXAMPLE, LOST, run_case  # noqa: PLC0415
    from impc.studies.example.report import example_report  # noqa: PLC0415

    require_writable(out)
    chosen = require_solver(COMPILED if solver is None else solver)
    plant = load_plant(_EXAMPLE_PLANT)
    names = tuple(CASES) if case == "all" else (case,)
    with progress(len(names) * len(EXAMPLE), "method") as step:
        cases = [run_case(plant, name, solver=chosen, progress=step) for name in names]
    report = example_report(cases, Provenance(_EXAMPLE_PLANT, f"impc example --case {case}"))
    written = write_files(out, report.files(pdf=pdf))
    click.echo(f"{report.verdict.text()}\n{click.wrap_text(LOST, width=100)}")
    for finding in report.findings():
        click.echo(f"\n{finding.name}\n{finding.text()}")
    print_files(out, written, open_page)
