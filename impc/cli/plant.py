"""A plant by name, and a subject: the one place where the library meets plants."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from impc.checking import replace

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from impc.files.digests import Inputs
    from impc.files.plant_sources import PlantSource
    from impc.inverse.problem import Problem
    from impc.model.plant import Plant
    from impc.reporting.provenance import Provenance
    from impc.studies.cohort.study import Study
    from impc.studies.fit.settings import FitSettings

#: Short names of plants, by their import paths: the library itself knows no plant.
KNOWN = {"seated-balance": "plants:seated_balance_for", "cursor": "plants:cursor_plant"}


def find_plant(name: str, arguments: Mapping[str, Any]) -> PlantSource:
    """The plant of a short name, an import path ``module:function`` or a file.

    `arguments` are those of its function.
    """
    from impc.errors import InputError  # noqa: PLC0415
    from impc.files.plant_sources import plant_source  # noqa: PLC0415

    for key, value in arguments.items():
        if not _kept(value):
            kind = type(value).__name__
            raise InputError(f"[plant] {key}", f"is a {kind} that no result can keep", "see docs")
    return plant_source(KNOWN.get(name, name), arguments)


def _kept(value: object) -> bool:
    """Whether result.json can hold it: no date, no integer beyond 64 bits, at no depth."""
    if isinstance(value, dict):
        return all(map(_kept, value.values()))
    if isinstance(value, list):
        return all(map(_kept, value))
    if isinstance(value, int):
        return value.bit_length() < 64
    return isinstance(value, (float, str))


def load_plant(path: str) -> Plant:
    """Make the plant of an import path ``module:function`` without arguments."""
    from impc.files.plant_sources import make_plant, plant_source  # noqa: PLC0415

    return make_plant(plant_source(path, {}), ())


def named_plant(study_file: Path, study: Study, given: str | None, allowed: bool) -> PlantSource:
    """The plant of a study, when the command line consents to it."""
    from impc.files.plant_sources import consented_name  # noqa: PLC0415

    where = f"{study_file}: study.plant"
    name = consented_name(where, study.plant, given, allowed, "plant", tuple(KNOWN))
    return find_plant(name, study.configuration.plant)


class AllFellError(Exception):
    """Nothing is left to fit: the falls, and where a page on them comes from."""

    def __init__(self, falls: tuple[str, ...], provenance: Provenance) -> None:
        super().__init__("; ".join(falls))
        self.falls, self.provenance = falls, provenance


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
    falls: tuple[str, ...] = ()  # Trials that ended in a fall, and when

    @property
    def provenance(self) -> Provenance:
        """Where what is made of it now comes from."""
        from impc.reporting.provenance import Provenance  # noqa: PLC0415

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
    """Read recordings, one file a trial; those that end in a fall are left out.

    Raises AllFellError where none is left.
    """
    from impc.control.named_solver import require_solver  # noqa: PLC0415
    from impc.files.configuration import read_configuration  # noqa: PLC0415
    from impc.files.digests import gather_inputs  # noqa: PLC0415
    from impc.files.reading import read_unit  # noqa: PLC0415
    from impc.reporting.provenance import Provenance  # noqa: PLC0415
    from impc.studies.fit.asked import asked_plant  # noqa: PLC0415
    from impc.studies.fit.settings import fit_settings  # noqa: PLC0415
    from impc.studies.fit.subject import fit_problem  # noqa: PLC0415

    configuration = read_configuration(config)
    settings = fit_settings(configuration.fit)
    if solver is not None:
        settings = replace(settings, solver=require_solver(solver))
    source = find_plant(plant_name, configuration.plant)
    plant, family = asked_plant(source, configuration.recorded, settings, configuration.aimed)
    recordings, fallen = read_unit(files, configuration, plant)
    falls = tuple(f"{one.subject.partition(':')[0]}: {one.problem}" for one in fallen)
    inputs = gather_inputs(files, config, source.name, source.arguments)
    names = tuple(path.name for path in files)
    line = f"impc {command} {' '.join(names)} --plant {plant_name} --config {config.name}"
    line += "" if solver is None else f" --solver {solver}"
    if not recordings:
        arguments = dict(source.arguments)
        raise AllFellError(falls, Provenance(source.name, line, arguments, names, inputs))
    problem = fit_problem(plant, recordings, settings, family)
    angles = configuration.report.angles
    return Subject(problem, settings, source, inputs, line, names, angles, falls)
