"""Settings of a plan, as the [plan] table of a configuration gives them (docs/planning.md)."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from msgspec import Meta

from impc.errors import InputError, brief
from impc.files.units import si_unit
from impc.model.plant import UNKNOWN
from impc.model.structure import Structure
from impc.studies.fit.settings import read_settings

if TYPE_CHECKING:
    from collections.abc import Mapping

    from impc.arrays import Array
    from impc.files.configuration import SignalTable
    from impc.model.plant import Plant
    from impc.studies.fit.settings import FitSettings

# The most is far beyond any use.
Amplitude = Annotated[float, Meta(ge=1e-100, le=1e100)]
Dwell = Annotated[float, Meta(ge=1e-4, le=1e4)]
Persons = Annotated[int, Meta(ge=2, le=100_000)]
Some = Meta(min_length=1)
_FEWEST_FITS = 20
_NUMBER = re.compile(r"\s*([0-9.eE+-]+)\s*(.*\S)\s*")


@dataclass(frozen=True)
class PlanSettings:
    """The presumed person, the experiments to choose from, and what is asked of them."""

    # Presumed cost weight of each feature of the structure, with the first input's at one; without
    # [fit.structure] its keys are the features
    cost_weights: dict[str, float]
    # Standard deviation of the noise in the recorder, for each output: in the plant's unit, or with
    # one, as in "0.1 deg"
    noise: dict[str, float | str]
    # Time in s over which this noise falls to 1/e of its correlation; 0 for white noise
    correlation: Annotated[float, Meta(ge=0, le=100)] = 0.0
    # Largest magnitude of outputs beyond which a person falls, written as `noise` is; by default
    # the limits of [signals]
    stops: dict[str, float | str] = field(default_factory=dict)
    # Inputs of the plant that perturb the person; by default those that [signals] names
    perturbed: list[str] = field(default_factory=list)
    # Of the perturbation, in the disturbance's unit; with `files` a factor
    amplitude: Annotated[list[Amplitude], Some] = field(default_factory=lambda: [2.5, 5.0, 10.0])
    # For how long the ternary perturbation keeps each value, s
    dwell: Annotated[list[Dwell], Some] = field(default_factory=lambda: [0.125, 0.25, 0.5])
    duration: Annotated[float, Meta(ge=0.1, le=1e4)] = 30.0  # Of a trial, s
    trials: Annotated[int, Meta(ge=1, le=100)] = 3  # Of a person
    # Recordings of perturbations in the place of the ternary one, beside the configuration
    files: list[str] = field(default_factory=list)
    # Trials that are simulated of each experiment to see how often the person falls
    draws: Annotated[int, Meta(ge=1, le=1000)] = 20
    # Largest share of them that may end in a fall, %
    falls: Annotated[float, Meta(ge=0, le=100)] = 5.0
    # Persons in each of two groups that are to be distinguished
    groups: Annotated[list[Persons], Some] = field(default_factory=lambda: [10, 20])
    # By which a cost weight differs between the groups, %
    difference: Annotated[float, Meta(ge=0.1, le=1e4)] = 50.0
    # Standard deviation of the logarithm of a cost weight within a group, %
    between: Annotated[float, Meta(ge=0, le=1000)] = 30.0
    # Fits of simulated recordings of the best experiment, to compare with; 0 for none
    fits: Annotated[int, Meta(ge=0, le=10_000)] = 0
    seed: Annotated[int, Meta(ge=0, le=2**31)] = 0  # All that is drawn follows from it


def plan_settings(table: Mapping[str, Any]) -> PlanSettings:
    """Read the [plan] table of a configuration."""
    settings = read_settings("plan", PlanSettings, table)
    if 0 < settings.fits < _FEWEST_FITS:
        raise InputError("[plan] fits", f"got {settings.fits}", f"give 0 or {_FEWEST_FITS} or more")
    return settings


def assumed_cost_weights(
    plant: Plant, settings: PlanSettings, fit: FitSettings
) -> tuple[Structure, Array]:
    """The structure of the presumed person, and its unknowns (count,)."""
    given = settings.cost_weights
    item = fit.structure
    if item is None:
        structure = Structure(plant, list(given))
    else:
        structure = Structure(plant, item.Q, item.R, over=item.over, name=item.name)
    if structure.coupled or structure.input_coupled:
        raise InputError(
            "[fit.structure]", "cost weights products too", "plan with a diagonal structure"
        )
    for name in structure.unknowns:
        if name not in given:
            raise InputError(
                "[plan] cost_weights", f"lacks {name!r}", "presume a cost weight for each feature"
            )
    for name, cost_weight in given.items():
        if name not in structure.unknowns:
            known = ", ".join(structure.unknowns)
            raise InputError(f"[plan] cost_weights {name}", "is not a feature", f"known: {known}")
        if not 1e-100 < cost_weight < 1e100:
            raise InputError(
                f"[plan] cost_weights {name}", f"got {cost_weight:g}", "give a positive number"
            )
    return structure, np.log([given[name] for name in structure.unknowns])


def noise_deviations(plant: Plant, settings: PlanSettings) -> Array:
    """Standard deviation of the noise of each output (p,), in the plant's units."""
    found = _of_outputs(plant, "noise", settings.noise)
    for name in plant.outputs:
        if name not in found:
            raise InputError("[plan] noise", f"lacks {name}", "give one for each output")
    return np.array([found[name] for name in plant.outputs])


def mechanical_stops(
    plant: Plant, settings: PlanSettings, signals: Mapping[str, SignalTable]
) -> Array:
    """Largest magnitude of each output (p,), in the plant's units; infinite without a stop."""
    stops = {
        name: entry.limit * si_unit(entry.unit).factor
        for name, entry in signals.items()
        if entry.limit is not None
    }
    stops |= _of_outputs(plant, "stops", settings.stops)
    return np.array([stops.get(name, np.inf) for name in plant.outputs])


def _of_outputs(plant: Plant, key: str, given: Mapping[str, float | str]) -> dict[str, float]:
    found = {}
    for name, written in given.items():
        if name not in plant.outputs:
            known = ", ".join(plant.outputs)
            raise InputError(f"[plan] {key} {name}", "is not an output", f"known: {known}")
        found[name] = _in_units(f"[plan] {key} {name}", plant.unit(name), written)
        if not 1e-100 < found[name] < 1e100:
            raise InputError(f"[plan] {key} {name}", f"got {written}", "give a positive number")
    return found


def _in_units(place: str, expected: str, given: float | str) -> float:
    if not isinstance(given, str):
        return given
    parts = _NUMBER.fullmatch(given)
    try:
        size = float(parts[1]) if parts else None
    except ValueError:
        size = None
    if parts is None or size is None:
        raise InputError(place, f"got {brief(given)}", 'write as in "0.1 deg"')
    unit = si_unit(parts[2])
    if expected != UNKNOWN and si_unit(expected).base not in (unit.base, "dimensionless"):
        raise InputError(place, f"is in {parts[2]}, the plant's in {expected}", "correct it")
    return size * unit.factor
