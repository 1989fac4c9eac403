"""A plant from where a user keeps it: an import path with arguments, or a saved state space."""

from __future__ import annotations

import importlib
import inspect
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.errors import ImpcError, InputError, PlantError
from impc.plant import Plant, as_plant
from impc.plant_family import PlantFamily, plant_family
from impc.saved_plant import SAVED, read_matrices, state_space

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from impc.arrays import Array

__all__ = ["PlantSource", "import_function", "make_plant", "plant_family_of", "plant_source"]


@dataclass(frozen=True)
class PlantSource:
    """How to make a plant.

    Attributes
    ----------
    name : str
        Import path ``module:function`` or file.
    make : callable
        Keyword arguments -> `control.StateSpace`.
    arguments : mapping
        Arguments as the configuration's [plant] table gives them.
    """

    name: str
    make: Callable[..., Any]
    arguments: Mapping[str, Any]


def plant_source(name: str, arguments: Mapping[str, Any]) -> PlantSource:
    """Find a plant by import path, or by the name of a .mat, .npz or .json file.

    A file holds A, B, C and dt, and may hold D, and the names `states`, `inputs`, `outputs`, which
    the arguments may give as well. A .npz file is read without pickles.

    Raises
    ------
    InputError
        When there is no such module, function or file, or a matrix is missing.
    """
    if Path(name).suffix in SAVED:
        matrices = read_matrices(Path(name))
        return PlantSource(
            name, lambda **given: state_space(name, {**matrices, **given}), arguments
        )
    return PlantSource(name, import_function(name), arguments)


def import_function(path: str) -> Callable[..., Any]:
    """The function of an import path ``module:function``; the current folder is looked in too.

    Raises
    ------
    InputError
        When there is no such module or function.
    """
    module, colon, function = path.partition(":")
    if not (module and colon and function):
        raise InputError(
            f"plant {path}", "is neither a known name, a file, nor module:function", "see docs"
        )
    sys.path.insert(0, "")  # a user's own module stands beside the recordings
    try:
        found: Callable[..., Any] = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError) as error:
        raise InputError(
            f"plant {path}", f"cannot be imported ({error})", "check module and function"
        ) from None
    finally:
        sys.path.remove("")
    return found


def make_plant(source: PlantSource, recorded: Sequence[str], **changed: float) -> Plant:
    """Make the plant; inputs that are recorded are disturbances, the others are controls.

    Parameters
    ----------
    recorded : sequence of str
        Names of recorded signals; those that are no inputs are ignored.
    **changed : float
        Arguments that replace those of the source.

    Raises
    ------
    InputError, PlantError
        When the arguments do not fit the function, or what it returns is no usable plant.
    """
    arguments = {**source.arguments, **changed}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", np.exceptions.ComplexWarning)
            system = source.make(**arguments)
    except ImpcError:
        raise
    except np.exceptions.ComplexWarning:  # control.ss would drop the imaginary parts
        raise PlantError(
            f"plant {source.name}", "has complex matrices", "give it real ones"
        ) from None
    except (TypeError, ValueError) as error:
        raise InputError(
            f"plant {source.name}", f"refuses its arguments ({error})", "correct the [plant] table"
        ) from None
    names = tuple(getattr(system, "input_labels", ()))
    controls = [name for name in names if name not in recorded]
    if names and not controls:
        raise PlantError(
            f"plant {source.name}", "all its inputs are recorded", "one must be the command"
        )
    return as_plant(system, controls or None)


def plant_family_of(
    source: PlantSource, recorded: Sequence[str], free: Sequence[str]
) -> PlantFamily | None:
    """The plants that differ in the free arguments; None when none is free.

    Parameters
    ----------
    recorded : sequence of str
        Names of recorded signals, as in `make_plant`.
    free : sequence of str
        Names of the arguments that are fitted.

    Raises
    ------
    InputError
        When a free argument has no nominal value, neither given nor as the function's default.
    """
    if not free:
        return None
    nominal = [_nominal(source, name) for name in free]

    def make(values: Array) -> Plant:
        changed = {name: float(value) for name, value in zip(free, values, strict=True)}
        return make_plant(source, recorded, **changed)

    return plant_family(make, free, nominal)


def _nominal(source: PlantSource, name: str) -> float:
    if name in source.arguments:
        value = source.arguments[name]
    else:
        parameter = inspect.signature(source.make).parameters.get(name)
        value = None if parameter is None else parameter.default
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(
            f"[fit] free {name}", "has no nominal value", f"give {name} in the [plant] table"
        )
    return float(value)
