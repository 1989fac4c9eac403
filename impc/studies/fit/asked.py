"""The problem of a fit from settings and recordings: plant, bounds, structures, unknowns."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from impc.arrays import Array, frozen
from impc.checking import checked, replace
from impc.errors import DataError, InputError
from impc.files.configuration import require_known
from impc.files.plant_sources import PlantSource, make_plant, plant_family_of
from impc.inverse.problem import Problem
from impc.inverse.search import with_jumps
from impc.model.bounds import Bounds
from impc.model.foresight import physical_states, with_observer, with_preview
from impc.model.plant import Plant
from impc.model.plant_family import PlantFamily
from impc.model.rates import with_rates
from impc.model.recordings import Recording
from impc.model.structure import Structure
from impc.studies.fit.settings import FitSettings


def output_feedback() -> Any:
    """The optional subpackage of subjects with sensory and motor noise."""
    try:
        return importlib.import_module("impc.output_feedback.models")
    except ModuleNotFoundError as error:
        if not str(error.name).startswith("impc.output_feedback"):
            raise
        remedy = "install the complete package, or remove the table"
        raise InputError(
            "[fit.observer]", "needs impc.output_feedback, which is not installed", remedy
        ) from None


def fit_structures(plant: Plant, settings: FitSettings) -> tuple[Structure, ...]:
    """Structures of the weights named in the settings, [fit.structure] first."""
    first = [] if settings.structure is None else [settings.structure]
    found: list[Structure] = []
    for item in (*first, *settings.structures):
        one = Structure(plant, item.Q, item.R, over=item.over, name=item.name)
        if one.name in [other.name for other in found]:
            raise InputError("[fit] structures", f"has {one.name!r} twice", "set unique names")
        found.append(one)
    return tuple(found)


#: Name of the setting and, in `free`, of the fitted observer rates.
OBSERVER = "observer_rate"


def asked_plant(
    source: PlantSource, recorded: Sequence[str], settings: FitSettings, aimed: Sequence[str] = ()
) -> tuple[Plant, PlantFamily | None]:
    """Plant with disturbances `recorded` and targets of `aimed`, dressed; and its family."""
    rates = _observer_rates(settings)
    learned = [name for name in settings.free if name in rates]
    unrated = [name for name in settings.free if name.partition(".")[0] == OBSERVER]
    own = [name for name in settings.free if name not in unrated]
    family = plant_family_of(source, recorded, own)
    plain = make_plant(source, recorded) if family is None else family.make(family.nominal)
    plant = _dressed(plain, settings, aimed, rates)
    for name in unrated:
        if name not in rates:
            raise InputError(f"[fit] free {name}", "has no nominal value", f"give {name} in [fit]")
    if family is None and not learned:
        return plant, None

    def dress(one: Plant, values: Array) -> Plant:
        moved = dict(zip(learned, map(float, values), strict=True))
        return _dressed(one, settings, aimed, rates | moved)

    nominal, free = [rates[name] for name in learned], [np.inf] * len(learned)
    bare = family or PlantFamily(lambda _: plain, [], [])
    return plant, bare.wider(learned, nominal, free, None if plant is plain else dress)


def _observer_rates(settings: FitSettings) -> dict[str, float]:
    """Observer rates by their names in `free`."""
    given = settings.observer_rate
    if isinstance(given, dict):
        return {f"{OBSERVER}.{name}": rate for name, rate in given.items()}
    return {} if given is None else {OBSERVER: given}


def _dressed(
    plant: Plant, settings: FitSettings, aimed: Sequence[str], rates: Mapping[str, float]
) -> Plant:
    """Extend the plant by command changes, then an observer with these rates, then a preview."""
    plant = plant.linear() if settings.body == "linear" else plant
    if settings.rates:
        plant = with_rates(plant)
    if rates:
        names = [f"{OBSERVER}.{name}" for name in plant.disturbances]
        unknown = [name for name in rates if name not in (OBSERVER, *names)]
        if unknown:
            has = ", ".join(plant.disturbances) or "none"
            raise InputError(f"[fit] {unknown[0]}", "is not a disturbance", f"the plant has {has}")
        if not names:
            remedy = "remove the line, or add [signals.NAME] of a disturbance"
            raise InputError(f"[fit] {OBSERVER}", "needs a recorded disturbance", remedy)
        plant = with_observer(plant, [rates.get(OBSERVER, rates.get(name, 0.0)) for name in names])
    aimed = [name for name in aimed if name in plant.outputs]
    if settings.preview and not aimed:
        remedy = "set target in the [signals.NAME] table of an output"
        raise InputError("[fit] preview", "needs an output with a target", remedy)
    return with_preview(plant, aimed, settings.preview) if settings.preview else plant


def require_dressed(plant: Plant, settings: FitSettings) -> None:
    """Raise InputError if a plant from Python lacks an extension that the settings name."""
    for name, asked, there, function in (
        ("rates", settings.rates, plant.commands, "with_rates"),
        (OBSERVER, settings.observer_rate, np.any(plant.observer), "with_observer"),
        ("preview", settings.preview, plant.ahead, "with_preview"),
    ):
        if asked and not there:
            remedy = f"pass impc.{function}(plant), and recordings of that plant"
            raise InputError(f"[fit] {name}", "is set, but the plant was made without it", remedy)


def fit_bounds(plant: Plant, settings: FitSettings, recordings: Sequence[Recording]) -> Bounds:
    """Bounds of the controller: inputs from the settings, states from settings or data (3.22)."""
    x_max = np.full(plant.n, np.inf)
    for name, value in settings.bounded_states.items():
        if name not in plant.states:
            raise InputError(
                f"[fit] bounded_states {name}", "is not a state", f"use one of {list(plant.states)}"
            )
        limit = value
        if isinstance(value, str):
            limit = settings.margin * _recorded_maximum(plant, name, value, recordings)
        x_max[plant.states.index(name)] = limit
    u_max = None if settings.u_max is None else np.asarray(settings.u_max, dtype=np.float64)
    if u_max is not None and u_max.shape not in ((), (plant.m,)):
        raise InputError(
            "[fit] u_max", f"has {len(u_max)} numbers", f"give 1, or {plant.m}, one per input"
        )
    if settings.rates:  # the commands are states, the inputs their changes
        limits = settings.rates if isinstance(settings.rates, dict) else {}
        require_known("[fit] rates {}".format, limits, plant.commands, "is not a command")
        if u_max is not None:
            x_max[np.isin(plant.states, plant.commands)] = u_max
        u_max = np.array([limits.get(name, np.inf) for name in plant.commands])
    u_min = None if u_max is None else -u_max
    return Bounds(plant, x_min=-x_max, x_max=x_max, u_min=u_min, u_max=u_max)


def _recorded_maximum(plant: Plant, name: str, word: str, recordings: Sequence[Recording]) -> float:
    if word != "data":
        raise InputError(f"[fit] bounded_states {name}", f"got {word!r}", 'give a number or "data"')
    if name in plant.outputs:
        column = plant.outputs.index(name)
        return max(float(np.nanmax(np.abs(trial.outputs[:, column]))) for trial in recordings)
    raise InputError(f"[fit] bounded_states {name}", "is not an output", "give a number")


@checked
def fit_problem(
    plant: Plant,
    recordings: Sequence[Recording],
    settings: FitSettings,
    family: PlantFamily | None = None,
) -> Problem:
    """Pose the inverse problem of a subject with scaled outputs and unknown initial states.

    Parameters
    ----------
    plant : Plant
        Plant; its disturbances are the recorded perturbations.
    recordings : sequence of Recording
        Trials of one subject.
    settings : FitSettings
        Horizon, bounds and options.
    family : PlantFamily, optional
        Plant as a function of the physical parameters that are fitted with the gain.

    Returns
    -------
    Problem
        Each output is scaled by its root mean square over all trials.

    Raises
    ------
    DataError, InputError, BoundsError
        If there is no recording, a trial is too short, an output is zero in all trials, or a bound
        cannot be set.

    Examples
    --------
    >>> import control
    >>> import impc
    >>> plant = impc.Plant(control.ss([[1.1]], [[1]], [[1]], 0, 1))
    >>> law = impc.Controller(plant, impc.Weights(1, 1), impc.Bounds(plant), horizon=3)
    >>> trial = impc.Recording(plant, law.simulate([1.0], steps=30).x)
    >>> problem = impc.fit_problem(plant, [trial], impc.FitSettings(horizon=3, u_max=0.5))
    >>> problem.unknown_start, problem.bounds.u_max
    (True, array([0.5]))
    """
    if not recordings:
        raise DataError("recordings", "the list is empty", "pass at least one trial")
    outputs = np.concatenate([trial.outputs for trial in recordings])
    scale = np.sqrt(np.nanmean(outputs**2, axis=0))
    for name, size in zip(plant.outputs, scale, strict=True):
        if size == 0:
            raise DataError(f"output {name}", "is zero in every trial", "check its column")
    shortest = min(trial.samples for trial in recordings)
    least = round(settings.settle / plant.dt) + physical_states(plant)
    if shortest <= least:
        raise DataError(
            "recordings",
            f"the shortest trial has {shortest} samples, but its initial state needs {least}",
            "use longer trials, or lower [fit] settle",
        )
    require_dressed(plant, settings)
    if settings.body == "linear":
        plant, family = plant.linear(), None if family is None else family.linear()
    posed = Problem(
        plant,
        fit_bounds(plant, settings, recordings),
        settings.horizon,
        tuple(_first_guess(plant, trial) for trial in recordings),
        terminal_set=None if settings.terminal_set == "auto" else settings.terminal_set,
        output_scale=scale,
        offsets=settings.offsets,
        signal_errors=settings.signal_errors,
        unknown_start=True,
        family=family,
        structure=next(iter(fit_structures(plant, settings)), None),
        feedback_states=settings.feedback_states,
        solver=settings.solver,
    )
    return with_jumps(posed)


def _first_guess(plant: Plant, trial: Recording) -> Recording:
    """Start of the search for x0: rest, or the first output if there is no disturbance."""
    if np.any(trial.disturbance) or np.any(trial.x0):
        return trial
    return replace(trial, x0=frozen(np.linalg.pinv(plant.C) @ np.nan_to_num(trial.outputs[0])))
