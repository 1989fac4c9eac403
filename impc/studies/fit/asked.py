"""What the settings of a fit ask for of plant and recordings: bounds, structures."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.signal

from impc.errors import InputError
from impc.model.bounds import Bounds
from impc.model.structure import Structure

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.arrays import Array
    from impc.model.plant import Plant
    from impc.model.plant_family import PlantFamily
    from impc.model.recordings import Recording
    from impc.studies.fit.settings import FitSettings

# A recorded angle is differentiated over this time, by a parabola: noise of 1 % of the largest
# angle at 100 Hz then gives a rate of a few per cent of the largest.
_RATE_WINDOW = 0.15


def output_feedback() -> Any:
    """The optional subpackage of subjects with sensory and motor noise."""
    try:
        return importlib.import_module("impc.output_feedback.models")
    except ModuleNotFoundError as error:
        if not str(error.name).startswith("impc.output_feedback"):
            raise
        remedy = "install all of impc, or leave the table out"
        raise InputError(
            "[fit.observer]", "needs impc.output_feedback, which is not there", remedy
        ) from None


def fit_structures(plant: Plant, settings: FitSettings) -> tuple[Structure, ...]:
    """Structures of the weights that the settings name, that of [fit.structure] first."""
    first = [] if settings.structure is None else [settings.structure]
    found: list[Structure] = []
    for item in (*first, *settings.structures):
        one = Structure(plant, item.Q, item.R, over=item.over, name=item.name)
        if one.name in [other.name for other in found]:
            raise InputError("[fit] structures", f"has {one.name!r} twice", "name each by itself")
        found.append(one)
    return tuple(found)


def moving_body(
    plant: Plant, family: PlantFamily | None, settings: FitSettings
) -> tuple[Plant, PlantFamily | None]:
    """The plant and its family with the body that the settings ask for."""
    if settings.body != "linear":
        return plant, family
    return plant.linear(), None if family is None else family.linear()


def fit_bounds(plant: Plant, settings: FitSettings, recordings: Sequence[Recording]) -> Bounds:
    """Bounds of the controller: inputs as set, states as set or from the data (3.22)."""
    x_max = np.full(plant.n, np.inf)
    for name, value in settings.bounded_states.items():
        if name not in plant.states:
            raise InputError(
                f"[fit] bounded_states {name}", "is not a state", f"known: {list(plant.states)}"
            )
        limit = value
        if isinstance(value, str):
            limit = settings.margin * _recorded_maximum(plant, name, value, recordings)
        x_max[plant.states.index(name)] = limit
    u_max = None if settings.u_max is None else np.asarray(settings.u_max, dtype=np.float64)
    if u_max is not None and u_max.shape not in ((), (plant.m,)):
        raise InputError(
            "[fit] u_max", f"has {len(u_max)} numbers", f"give one, or {plant.m}, one an input"
        )
    u_min = None if u_max is None else -u_max
    return Bounds(plant, x_min=-x_max, x_max=x_max, u_min=u_min, u_max=u_max)


def _recorded_maximum(plant: Plant, name: str, word: str, recordings: Sequence[Recording]) -> float:
    if word != "data":
        raise InputError(f"[fit] bounded_states {name}", f"got {word!r}", 'give a number or "data"')
    if name in plant.outputs:
        column = plant.outputs.index(name)
        return max(float(np.max(np.abs(trial.outputs[:, column]))) for trial in recordings)
    base = name.removesuffix("_rate")
    if base != name and base in plant.outputs:
        column = plant.outputs.index(base)
        return max(_largest_rate(trial.outputs[:, column], plant.dt) for trial in recordings)
    raise InputError(
        f"[fit] bounded_states {name}", "is neither an output nor the rate of one", "give a number"
    )


def _largest_rate(values: Array, dt: float) -> float:
    window = max(5, 2 * round(_RATE_WINDOW / dt / 2) + 1)
    if len(values) < window:
        raise InputError("recording", f"has {len(values)} samples", f"give at least {window}")
    rate = scipy.signal.savgol_filter(values, window, 2, deriv=1, delta=dt)
    half = window // 2  # at the ends the parabola is one-sided
    return float(np.max(np.abs(rate[half:-half])))
