"""Settings of a plan: the [plan] table of a configuration (docs/ref/settings.md)."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from msgspec import Meta

from impc.errors import InputError, brief
from impc.files.units import si_unit
from impc.model.plant import UNKNOWN
from impc.model.riccati import stabilises
from impc.studies.fit.settings import read_settings

if TYPE_CHECKING:
    from collections.abc import Mapping

    from impc.arrays import Array
    from impc.files.configuration import SignalTable
    from impc.model.plant import Plant

# Wide limits that only exclude numerical overflow.
Amplitude = Annotated[float, Meta(ge=1e-100, le=1e100)]
Dwell = Annotated[float, Meta(ge=1e-4, le=1e4)]
Persons = Annotated[int, Meta(ge=2, le=100_000)]
Some = Meta(min_length=1)
_FEWEST_FITS = 20
_NUMBER = re.compile(r"\s*([0-9.eE+-]+)\s*(.*\S)\s*")


@dataclass(frozen=True)
class PlanSettings:
    """Settings of a plan: assumed subject, candidate experiments, and required precision.

    Attributes
    ----------
    gain : list of list of float
        Gain K of the assumed subject, u = -K x, in the units of the plant: a row for each input, in
        it a number for each state. `--like` takes it from a fit or a simulated subject.
    noise : dict of str to float or str
        Standard deviation of the recording noise of each output: a number in the plant's unit, or a
        text with a unit such as "0.1 deg".
    correlation : float
        Correlation time of this noise in s (decay to 1/e); 0: white noise.
    stops : dict of str to float or str
        Largest magnitude of outputs beyond which the subject falls, written like `noise`. Not
        given: the limits in [signals].
    perturbed : list of str
        Inputs of the plant that perturb the subject. Empty: those named in [signals].
    amplitude : list of float
        Amplitudes of the perturbation to try, in the unit of the disturbance; with `files` factors.
    dwell : list of float
        Hold times of the values of the ternary perturbation to try, s.
    duration : float
        Duration of a trial, s.
    trials : int
        Number of trials per subject.
    files : list of str
        Files of recorded perturbations, relative to the configuration; they replace the ternary
        perturbation.
    draws : int
        Number of simulated trials per experiment for the share of falls.
    falls : float
        Largest allowed share of simulated trials with a fall, %.
    groups : list of int
        Numbers of subjects per group for which the power of a comparison is computed.
    difference : float
        Difference of a gain, between groups or in one subject, that is to be detected, %.
    between : float
        Standard deviation of a gain within a group, %.
    fits : int
        Number of fits to simulated recordings of the best experiment, to check the expected
        intervals: 0 (none) or at least 20.
    seed : int
        Seed of all random numbers.
    """

    gain: list[list[float]]
    noise: dict[str, float | str]
    correlation: Annotated[float, Meta(ge=0, le=100)] = 0.0
    stops: dict[str, float | str] = field(default_factory=dict)
    perturbed: list[str] = field(default_factory=list)
    amplitude: Annotated[list[Amplitude], Some] = field(default_factory=lambda: [2.5, 5.0, 10.0])
    dwell: Annotated[list[Dwell], Some] = field(default_factory=lambda: [0.125, 0.25, 0.5])
    duration: Annotated[float, Meta(ge=0.1, le=1e4)] = 30.0
    trials: Annotated[int, Meta(ge=1, le=100)] = 3
    files: list[str] = field(default_factory=list)
    draws: Annotated[int, Meta(ge=1, le=1000)] = 20
    falls: Annotated[float, Meta(ge=0, le=100)] = 5.0
    groups: Annotated[list[Persons], Some] = field(default_factory=lambda: [10, 20])
    difference: Annotated[float, Meta(ge=0.1, le=1e4)] = 50.0
    between: Annotated[float, Meta(ge=0, le=1000)] = 30.0
    fits: Annotated[int, Meta(ge=0, le=10_000)] = 0
    seed: Annotated[int, Meta(ge=0, le=2**31)] = 0


def plan_settings(table: Mapping[str, Any]) -> PlanSettings:
    """Read the [plan] table of a configuration."""
    settings = read_settings("plan", PlanSettings, table)
    if 0 < settings.fits < _FEWEST_FITS:
        raise InputError("[plan] fits", f"got {settings.fits}", f"give 0 or {_FEWEST_FITS} or more")
    return settings


def assumed_gain(plant: Plant, settings: PlanSettings) -> Array:
    """Gain (m, n) of the assumed subject, checked against the plant."""
    rows = list(map(len, settings.gain))
    if rows != [plant.n] * plant.m:
        raise InputError(
            "[plan] gain",
            f"has rows of {', '.join(map(str, rows)) or 'no'} numbers",
            f"give {plant.m} of {plant.n}, for {', '.join(plant.states)}",
        )
    K = np.array(settings.gain)
    if not stabilises(plant, K):
        raise InputError("[plan] gain", "does not stabilise the plant", "check signs: u = -K x")
    return K


def noise_deviations(plant: Plant, settings: PlanSettings) -> Array:
    """Standard deviation of the recording noise of each output (p,), in the plant's units."""
    found = _of_outputs(plant, "noise", settings.noise)
    for name in plant.outputs:
        if name not in found:
            raise InputError("[plan] noise", f"lacks {name}", "give a value for each output")
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
            raise InputError(f"[plan] {key} {name}", "is not an output", f"use: {known}")
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
        raise InputError(place, f"got {brief(given)}", 'write a number and a unit: "0.1 deg"')
    unit = si_unit(parts[2])
    if expected != UNKNOWN and si_unit(expected).base not in (unit.base, "dimensionless"):
        raise InputError(place, f"is in {parts[2]}", f"use a unit compatible with {expected}")
    return size * unit.factor
