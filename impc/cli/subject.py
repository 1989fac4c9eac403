"""What the commands for one subject do first: files and configuration to an inverse problem."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from impc.checking import replace
from impc.cli.plant import find_plant
from impc.control.named_solver import require_solver
from impc.files.configuration import read_configuration
from impc.files.inputs import gather_inputs
from impc.files.plant_sources import make_plant, plant_family_of
from impc.files.reading import read_recordings
from impc.reporting.provenance import Provenance
from impc.studies.fit.settings import fit_settings
from impc.studies.fit.subject import fit_problem

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from impc.files.inputs import Inputs
    from impc.files.plant_sources import PlantSource
    from impc.inverse.problem import Problem
    from impc.studies.fit.settings import FitSettings


@dataclass(frozen=True)
class Subject:
    """The recordings of a subject as an inverse problem."""

    problem: Problem
    settings: FitSettings
    source: PlantSource  # Of the plant
    inputs: Inputs  # Digests of all files that went in
    command: str  # The command line, without folders
    files: tuple[str, ...]  # Names of the recordings
    angles: str = "degrees"  # "degrees" or "radians", as [report] says

    @property
    def provenance(self) -> Provenance:
        """Where what is made of it now comes from."""
        source = self.source
        arguments = dict(source.arguments)
        return Provenance(source.name, self.command, arguments, self.files, self.inputs)


def read_subject(
    command: str,
    files: Sequence[Path],
    plant_name: str,
    config: Path,
    solver: str | None = None,
) -> Subject:
    """Read recordings, one file a trial."""
    configuration = read_configuration(config)
    settings = fit_settings(configuration.fit)
    if solver is not None:
        settings = replace(settings, solver=require_solver(solver))
    source = find_plant(plant_name, configuration.plant)
    recorded = configuration.recorded
    plant = make_plant(source, recorded)
    family = plant_family_of(source, recorded, settings.free)
    recordings = read_recordings(files, configuration, plant)
    inputs = gather_inputs(files, config, source.name, source.arguments)
    names = tuple(path.name for path in files)
    line = f"impc {command} {' '.join(names)} --plant {plant_name} --config {config.name}"
    line += "" if solver is None else f" --solver {solver}"
    problem = fit_problem(plant, recordings, settings, family)
    return Subject(problem, settings, source, inputs, line, names, configuration.report.angles)
