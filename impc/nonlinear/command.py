"""`impc fit` of an optimal control problem of the user's own (docs/nonlinear.md)."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

import click

from impc.checking import replace
from impc.cli.output import print_files
from impc.cli.plant import find_plant
from impc.cli.progress import progress
from impc.files.configuration import read_configuration
from impc.files.inputs import gather_inputs
from impc.files.plant_sources import made_by
from impc.nonlinear.fit import fit_optimal_control
from impc.nonlinear.problem import OptimalControlProblem
from impc.nonlinear.reading import read_optimal_trials
from impc.nonlinear.report import optimal_report
from impc.nonlinear.result import OptimalFit
from impc.nonlinear.sentences import abstract, verdict
from impc.nonlinear.settings import optimal_fit_settings, posed, recorded
from impc.nonlinear.solvers import require_solver
from impc.reporting.provenance import Provenance
from impc.reporting.shown_units import angles_in
from impc.reporting.writer import write_files

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from impc.files.configuration import Configuration


def fit_optimal(
    files: Sequence[Path], plant_name: str, config: Path, out: Path, solver: str | None
) -> bool:
    """Read, fit, write and print, if the plant is an optimal control problem; else do nothing."""
    configuration = read_configuration(config)
    source = find_plant(plant_name, configuration.plant)
    problem = made_by(source) if ":" in source.name else None  # a file holds matrices
    if not isinstance(problem, OptimalControlProblem):
        return False
    with progress(2, "stage") as done:
        fit = _fitted(problem, files, configuration, solver)
        done("search")
        inputs = gather_inputs(files, config, source.name, source.arguments)
        names = tuple(path.name for path in files)
        line = f"impc fit {' '.join(names)} --plant {plant_name} --config {config.name}"
        line += "" if solver is None else f" --solver {solver}"
        provenance = Provenance(source.name, line, dict(source.arguments), names, inputs)
        with angles_in(configuration.report.angles):
            content = optimal_report(fit, provenance).files()
        done("page")
    written = write_files(out, content)
    for sentence in (verdict(fit), *abstract(fit)):
        click.echo(sentence)
    print_files(out, written)
    return True


def _fitted(
    problem: OptimalControlProblem,
    files: Sequence[Path],
    configuration: Configuration,
    solver: str | None,
) -> OptimalFit:
    settings = optimal_fit_settings(configuration.fit)
    if solver is not None:
        require_solver(solver)
        settings = replace(settings, solver=solver)
    units = dict(zip(problem.parameter_names, problem.units, strict=True))
    fitted, start, known = posed(problem, settings)
    trials = read_optimal_trials(files, configuration, fitted)
    recordings = [recorded(fitted, trial, settings) for trial in trials]
    estimate = fit_optimal_control(
        fitted,
        recordings,
        start,
        solver=settings.solver,
        evaluations=settings.evaluations,
        starts=settings.starts,
    )
    return OptimalFit(
        estimate,
        tuple(str(trial.label) for trial in trials),
        tuple(trial.findings for trial in trials),
        trials[0].dt,
        {name: (value, units[name]) for name, value in known.items()},
        asdict(settings),
    )
