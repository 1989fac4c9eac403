"""Find a plant by name and read the recordings of a subject."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

from impc.checking import replace
from impc.errors import DataError, InputError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from impc.files.configuration import Configuration
    from impc.files.digests import Inputs
    from impc.files.plant_sources import PlantSource
    from impc.inverse.problem import Problem
    from impc.reporting.provenance import Provenance
    from impc.studies.cohort.study import Study
    from impc.studies.fit.settings import FitSettings

#: Short name -> import path of a plant; the package `impc` itself contains no plants.
KNOWN = {"seated-balance": "plants:seated_balance_for", "cursor": "plants:cursor_plant"}
#: Copy of the configuration among the results of `impc fit`.
CONFIGURATION = "configuration.toml"


def find_plant(name: str, arguments: Mapping[str, Any]) -> PlantSource:
    """The plant of a short name, an import path ``module:function`` or a file."""
    from impc.files.plant_sources import plant_source  # noqa: PLC0415

    for key, value in arguments.items():
        if not _kept(value):
            kind = type(value).__name__
            raise InputError(
                f"[plant] {key}",
                f"is a {kind} that result.json cannot hold",
                "use numbers below 2^63, texts, lists or tables",
            ).at("", "plant", key)
    return plant_source(KNOWN.get(name, name), arguments)


def _kept(value: object) -> bool:
    """Whether result.json can hold it: no date and no integer beyond 64 bits at any depth."""
    if isinstance(value, dict):
        return all(map(_kept, value.values()))
    if isinstance(value, list):
        return all(map(_kept, value))
    if isinstance(value, int):
        return value.bit_length() < 64
    return isinstance(value, (float, str))


def named_plant(study_file: Path, study: Study, given: str | None, allowed: bool) -> PlantSource:
    """The plant of a study, if the command line consents to running it."""
    from impc.files.plant_sources import consented_name  # noqa: PLC0415

    where = f"{study_file}: study.plant"
    name = consented_name(where, study.plant, given, allowed, "plant", tuple(KNOWN))
    return find_plant(name, study.configuration.plant)


class AllFellError(DataError):
    """All trials ended in a fall: nothing is left to fit."""

    def __init__(self, falls: tuple[str, ...], provenance: Provenance) -> None:
        super().__init__("recordings", f"end in a fall: {'; '.join(falls)}", "add one without")
        self.falls, self.provenance = falls, provenance


@dataclass(frozen=True)
class Asked:
    """What `impc fit` or `impc compare` is to fit: by the command line, else by [subject]."""

    files: tuple[Path, ...]
    plant: str
    config: Path
    configuration: Configuration
    solver: str | None
    line: str  # The command line, without folders

    def inputs(self, source: PlantSource) -> Inputs:
        """Digests of all input files."""
        from impc.files.digests import gather_inputs  # noqa: PLC0415

        return gather_inputs(self.files, self.config, source.name, source.arguments)

    def provenance(self, source: PlantSource, inputs: Inputs) -> Provenance:
        """Provenance of a result that is made now."""
        from impc.reporting.provenance import Provenance  # noqa: PLC0415

        names = tuple(path.name for path in self.files)
        return Provenance(source.name, self.line, dict(source.arguments), names, inputs)


def subject_plant(config: Path, named: str, given: str | None, allowed: bool) -> str:
    """Plant that the user gave, or with consent that of [subject], relative to its file."""
    from impc.files.configuration import require_inside  # noqa: PLC0415
    from impc.files.plant_sources import consented_name  # noqa: PLC0415
    from impc.files.saved_plant import SAVED  # noqa: PLC0415

    where = f"{config}: subject.plant"
    plant = consented_name(where, named, given, allowed, "plant", tuple(KNOWN))
    if given is not None or PurePath(plant).suffix not in SAVED:
        return plant
    require_inside(where, plant)
    return str(config.parent / plant)


def asked_subject(
    command: str,
    files: Sequence[Path],
    given: str | None,
    config: Path,
    solver: str | None = None,
    allowed: bool = False,
) -> Asked:
    """What to fit, if the command line consents to running the plant (`consented_name`)."""
    from impc.files.configuration import read_configuration  # noqa: PLC0415

    configuration = read_configuration(config)
    named, where = configuration.subject, f"{config}: subject"
    plant = subject_plant(config, named.plant, given, allowed)
    found = tuple(files) or tuple(config.parent / name for name in named.files)
    if not found:
        raise InputError(f"{where}.files", "names no recording", "name them, or pass FILES")
    options = {"--plant": given, "--config": config.name, "--solver": solver}
    words = [word for pair in options.items() if pair[1] is not None for word in pair]
    words += ["--allow-plant"] if allowed else []
    line = shlex.join(["impc", command, *(path.name for path in files), *map(str, words)])
    return Asked(found, plant, config, configuration, solver, line)


@dataclass(frozen=True)
class Subject:
    """The recordings of a subject as an inverse problem."""

    problem: Problem
    settings: FitSettings
    source: PlantSource
    inputs: Inputs  # Digests of all input files
    asked: Asked
    falls: tuple[str, ...] = ()  # Trials that ended in a fall, with the time

    @property
    def angles(self) -> str:
        """Unit of angles on pages."""
        return self.asked.configuration.report.angles

    @property
    def provenance(self) -> Provenance:
        """Provenance of a result that is made now."""
        return self.asked.provenance(self.source, self.inputs)


def read_subject(asked: Asked) -> Subject:
    """Read the trials that did not end in a fall; AllFellError if there are none."""
    from impc.control.named_solver import require_solver  # noqa: PLC0415
    from impc.files.reading import read_unit  # noqa: PLC0415
    from impc.studies.fit.asked import asked_plant, fit_problem  # noqa: PLC0415
    from impc.studies.fit.settings import fit_settings  # noqa: PLC0415

    configuration = asked.configuration
    settings = fit_settings(configuration.fit)
    if asked.solver is not None:
        settings = replace(settings, solver=require_solver(asked.solver))
    source = find_plant(asked.plant, configuration.plant)
    plant, family = asked_plant(source, configuration.recorded, settings, configuration.aimed)
    recordings, fallen = read_unit(asked.files, configuration, plant)
    falls = tuple(f"{one.subject.partition(':')[0]}: {one.problem}" for one in fallen)
    inputs = asked.inputs(source)
    if not recordings:
        raise AllFellError(falls, asked.provenance(source, inputs))
    problem = fit_problem(plant, recordings, settings, family)
    return Subject(problem, settings, source, inputs, asked, falls)
