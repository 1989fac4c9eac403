"""`impc plan`: predict which parameters a planned experiment would identify."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import msgspec
import numpy as np

from impc.arrays import Array
from impc.cli.console import progress, publish, require_consent
from impc.cli.options import Page
from impc.cli.plant import KNOWN, find_plant
from impc.cli.seat import TORQUE
from impc.control.controller import Controller
from impc.errors import InputError
from impc.files.configuration import Configuration, read_configuration
from impc.files.digests import gather_inputs
from impc.files.disk import truth_beside
from impc.files.formats import read_table
from impc.files.plant_sources import PlantSource, consented_name, import_function
from impc.files.reading import disturbances_of
from impc.files.results import read_result
from impc.model.plant import Plant
from impc.reporting.provenance import Provenance
from impc.reporting.shown_units import angles_in
from impc.studies.cache import Cache, Steps
from impc.studies.fit.asked import asked_plant, fit_bounds
from impc.studies.fit.settings import FitSettings, fit_settings
from impc.studies.plan import settings as assumed
from impc.studies.plan.designs import Person, Perturbation
from impc.studies.plan.report import plan_report
from impc.studies.plan.settings import PlanSettings
from impc.studies.plan.study import make_plan, plan_effort, steps_of

_FEWER = "lower fits, draws, amplitude or dwell in [plan]"


def run_plan(
    config: Path, plant_name: str | None, like: Path | None, out: Path, yes: bool, page: Page
) -> None:
    """Plan an experiment."""
    configuration, name = _assumed(read_configuration(config), plant_name, like)
    settings = assumed.plan_settings(configuration.plan)
    source = find_plant(name, configuration.plant)
    person = _person(configuration, settings, fit_settings(configuration.fit), source)
    recorded = [config.parent / name for name in settings.files]
    perturbation = _perturbation(person.controller.plant, configuration, settings, recorded)
    require_consent(plan_effort(person, settings), yes, _FEWER)
    of_person = [] if like is None else [like / "result.json", like / "truth.json"]
    used = [*recorded, *filter(Path.exists, of_person)]
    inputs = gather_inputs(used, config, source.name, source.arguments)
    steps = Steps(Cache(out / "plan-in-progress"), inputs.digest)

    def remember(name: str, compute: Callable[[], Array]) -> Array:
        return steps.get(name, compute, np.array, np.ndarray.tolist)

    with progress(steps_of(settings), "step", lambda _: steps.kept()) as done:
        plan = make_plan(person, settings, perturbation, done, remember)
    given = {"--plant": plant_name, "--like": None if like is None else like.name}
    line = f"impc plan {config.name}"
    line += "".join(f" {key} {value}" for key, value in given.items() if value is not None)
    names = tuple(path.name for path in recorded)
    made = Provenance(source.name, line, dict(source.arguments), names, inputs)
    with angles_in(configuration.report.angles):
        report = plan_report(plan, made)
        keys = (f"{key.label}: {key.value} {key.unit}" for key in report.keys)
        publish(report, out, page, *keys, kept=steps.cache)


def _assumed(
    configuration: Configuration, plant_name: str | None, like: Path | None
) -> tuple[Configuration, str]:
    """Configuration completed by the results of a fit (--like), and the name of the plant."""
    if like is not None:
        configuration, named = _filled(configuration, like)
        where = f"--like {like}: plant"
        if named is not None:
            known = tuple(KNOWN)
            return configuration, consented_name(where, named, plant_name, False, "plant", known)
    if plant_name is None:
        raise click.UsageError("Missing option '--plant'; or give '--like' a folder of impc fit.")
    return configuration, plant_name


def _filled(configuration: Configuration, folder: Path) -> tuple[Configuration, str | None]:
    """Configuration completed by the fit or simulated subject in `folder`, and its plant."""
    where, truth = f"--like {folder}", truth_beside(folder)
    own: dict[str, Any] = {}
    plant: str | None = None
    try:
        if truth:
            own["gain"], beside = truth["K"], read_configuration(folder / "subject.toml")
            arguments, settings = beside.plant, beside.fit
        else:
            found = read_result(folder).content
            rms = [np.square(trial["rms_residual"]) for trial in found["trials"]]
            noise = np.sqrt(np.mean(rms, axis=0)).tolist()
            own |= {"noise": dict(zip(found["outputs"], noise, strict=True)), "gain": found["K"]}
            settings = {name: one for name, one in found["settings"].items() if one is not None}
            plant, arguments = str(found["plant"]["name"]), dict(found["plant"]["arguments"])
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        remedy = "pass an output folder of impc fit, or of impc simulate seated-balance"
        raise InputError(where, f"has no subject ({error})", remedy) from None
    changed = msgspec.structs.replace(
        configuration,
        plant=configuration.plant or arguments,
        fit={**settings, **configuration.fit},
        plan={**own, **configuration.plan},
    )
    return changed, plant


def _person(
    configuration: Configuration, settings: PlanSettings, fit: FitSettings, source: PlantSource
) -> Person:
    recorded = tuple(settings.perturbed or configuration.recorded)
    plant, family = asked_plant(source, recorded, fit)
    if not plant.disturbances:
        known = ", ".join(plant.controls)
        raise InputError("[plan] perturbed", "names no input of the plant", f"choose from: {known}")
    if "data" in fit.bounded_states.values():
        raise InputError("[fit] bounded_states", 'is "data"', "give numbers: a plan has no data")
    controller = Controller.from_gain(
        plant,
        assumed.assumed_gain(plant, settings),
        fit_bounds(plant, fit, ()),
        fit.horizon,
        terminal_set=fit.terminal_set is True,
    )
    tau = settings.correlation
    return Person(
        controller,
        assumed.noise_deviations(plant, settings),
        float(np.exp(-plant.dt / tau)) if tau > 0 else 0.0,
        assumed.mechanical_stops(plant, settings, configuration.signals),
        family,
    )


def _perturbation(
    plant: Plant, configuration: Configuration, settings: PlanSettings, files: list[Path]
) -> Perturbation:
    """Ternary sequences, one for each disturbance, or the recorded `files` in turn."""
    if files:
        found = [
            disturbances_of(
                read_table(path, sheet=configuration.recording.sheet), configuration, plant
            )
            for path in files
        ]
        return lambda amplitude, _dwell, number: amplitude * found[number % len(found)]
    torque: Any = import_function(TORQUE)

    def ternary(amplitude: float, dwell: float, number: int) -> Array:
        count = len(plant.disturbances)
        return np.column_stack(
            [
                torque(
                    amplitude,
                    dwell,
                    settings.duration,
                    1 / plant.dt,
                    seed=settings.seed + number * count + index,
                )
                for index in range(count)
            ]
        )

    return ternary
