"""`impc example`: the simulation example of the dissertation, and a sweep over its limit."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from impc.cli.commands import SEEDS
from impc.cli.console import progress, publish
from impc.cli.options import Page
from impc.cli.seat import HORIZON, PLANT, seat_weights
from impc.control.named_solver import COMPILED, require_solver
from impc.files.plant_sources import make_plant, plant_source
from impc.model.weights import Weights
from impc.reporting.document import Report
from impc.reporting.provenance import Provenance
from impc.studies.cache import Cache
from impc.studies.example.cases import CASES, EXAMPLE, LOST, run_case
from impc.studies.example.report import example_report
from impc.studies.example.sweep import CONDITIONS, LEVELS, Setup, pushed, run_sweep
from impc.studies.example.sweep_report import sweep_report
from impc.studies.pool import processes

# impc does not import `plants`: the plant is named by its import path, ``module:function``.
_EXAMPLE_PLANT = "plants:yalmip_example"


def run_example(
    case: str, sweep: str | None, seeds: int, out: Path, solver: str | None, page: Page
) -> None:
    """Run the cases, or a sweep."""
    if sweep is not None and (case != "all" or solver is not None):
        raise click.UsageError("--sweep has no cases and its own solver: remove --case, --solver.")
    if sweep is None and seeds != SEEDS:
        raise click.UsageError("--seeds is for --sweep: give both, or remove it.")
    report = _cases(case, solver) if sweep is None else _swept(sweep, seeds, out)
    texts = [f"\n{finding.name}\n{finding.text()}" for finding in report.findings()]
    if sweep is None:
        texts.insert(0, click.wrap_text(LOST, width=100))
    publish(report, out, page, *texts)


def _cases(case: str, solver: str | None) -> Report:
    chosen = require_solver(COMPILED if solver is None else solver)
    plant = make_plant(plant_source(_EXAMPLE_PLANT, {}), ())
    names = tuple(CASES) if case == "all" else (case,)
    with progress(len(names) * len(EXAMPLE), "method") as step:
        cases = [run_case(plant, name, solver=chosen, progress=step) for name in names]
    return example_report(cases, Provenance(_EXAMPLE_PLANT, f"impc example --case {case}"))


def _swept(name: str, seeds: int, out: Path) -> Report:
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
    if name == "example":
        plant = pushed(make_plant(plant_source(_EXAMPLE_PLANT, {}), ()))
        return Setup(plant, Weights(np.eye(plant.n), np.eye(plant.m)), 5, 60, 1, 1.0)
    plant = make_plant(plant_source(PLANT, {}), ("perturbation",))
    return Setup(plant, seat_weights(plant), HORIZON, 1000, 12, 5.0)
