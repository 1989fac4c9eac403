"""Plants from an import path with arguments, or from saved state-space matrices.

A module of this package or of an installed one is never searched in the working folder: a file
there called plants.py or numpy.py replaces nothing. Other modules are searched there last, and only
during the import. Any exception of a user's function becomes one line that names it.

A study file that names a plant `module:function` makes impc run that code. Because someone else may
have written the file, such a name needs the consent of the user on the command line; plants of
this package and saved matrices need none (docs/ref/security.md).
"""

from __future__ import annotations

import importlib.util
import inspect
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from impc.arrays import Array, finite_array
from impc.checking import checked, replace
from impc.errors import ImpcError, InputError, PlantError, one_line
from impc.files.configuration import FILL_IN
from impc.files.saved_plant import SAVED, read_matrices, state_space
from impc.model.plant import Plant
from impc.model.plant_family import DELAY, LIMIT, PlantFamily, plant_differential

#: Arguments of a plant that are measured for every subject.
OWN = ("mass", "height")
#: Key in [plant] with the outputs that are recorded, if not all are.
OUTPUTS = "outputs"
#: Table in [plant] with the uncertainty of its parameters, and its key for all of them.
UNCERTAINTY, _ALL = "uncertainty", "all"
# Largest number of parameters of a plant, and texts about them.
_MOST = 200
_Text = Annotated[str, msgspec.Meta(max_length=_MOST)]


@dataclass(frozen=True)
class Parameter:
    """An argument or a physical parameter of a plant."""

    name: str
    words: str  # the name if the plant has none
    unit: str
    value: object  # default
    deviation: str | float | None  # standard deviation as stated: in the unit, or "5 %"
    choices: tuple[str, ...]  # allowed texts; empty if any
    own: bool  # measured for every subject


@dataclass(frozen=True)
class PlantSource:
    """Function that makes a plant, with its arguments."""

    name: str  # import path ``module:function`` or file
    make: Callable[..., Any]  # keyword arguments -> `control.StateSpace`
    arguments: Mapping[str, Any]  # from the [plant] table

    def defaults(self) -> dict[str, object]:
        """Arguments of the function with their defaults; `FILL_IN` if there is none."""
        found = {}
        for name, item in inspect.signature(self.make).parameters.items():
            if item.kind not in (item.VAR_POSITIONAL, item.VAR_KEYWORD):
                found[name] = FILL_IN if item.default is item.empty else item.default
        return found

    def parameters(self) -> tuple[Parameter, ...]:
        """Arguments, then physical parameters, as the plant itself describes them."""
        system, found = made_by(replace(self, arguments={})), []
        words: dict[str, list[str]] = _stated(self.name, system, "arguments", list[_Text])
        known = _stated(self.name, system, UNCERTAINTY, float | _Text)
        values = self.defaults() | _stated(self.name, system, "parameters", float)
        for name, value in values.items():
            said, unit, *more = [*words.get(name, [name]), "", ""]
            choices = tuple(filter(None, more))
            found.append(Parameter(name, said, unit, value, known.get(name), choices, name in OWN))
        return tuple(found)

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs that are recorded, if [plant] lists them and the function does not.

        A saved plant has all its names in the same key.
        """
        listed = self.arguments.get(OUTPUTS, ())
        if not listed or Path(self.name).suffix in SAVED or OUTPUTS in self.defaults():
            return ()
        if not isinstance(listed, list | tuple) or not all(isinstance(one, str) for one in listed):
            problem = "is no list of names"
            raise InputError(f"[plant] {OUTPUTS}", problem, 'write outputs = ["angle"]').at(
                "", "plant", OUTPUTS
            )
        return tuple(listed)

    def assumed(self) -> dict[str, object]:
        """Arguments of the subject (`OWN`) that keep the plant's typical value."""
        defaults = {} if Path(self.name).suffix in SAVED else self.defaults()
        left = (name for name in OWN if name in defaults and name not in self.arguments)
        return {name: defaults[name] for name in left if defaults[name] != FILL_IN}


def _stated(source: str, system: Any, kind: str, wanted: Any) -> Any:
    """What a system states of its parameters (`kind`), by name; of the type `wanted`."""
    where, remedy = f"plant {source} {kind}", f"correct system.{kind}"
    with users_code(where):
        given = getattr(system, kind, {})
        if not isinstance(given, Mapping) or len(given) > _MOST:
            raise InputError(where, f"is not a mapping of at most {_MOST} names", remedy)
        try:
            plain = msgspec.to_builtins(dict(given), enc_hook=lambda one: one.item())  # of numpy
            return msgspec.convert(plain, dict[_Text, wanted])
        except msgspec.ValidationError as error:
            raise InputError(where, f"is wrong: {one_line(error)}", remedy) from None


def consented_name(
    where: str, named: str, given: str | None, allowed: bool, option: str, known: tuple[str, ...]
) -> str:
    """Name of the plant or model to run: that of the command line, else `named` in a file.

    Code that a file names needs `given` on the command line, or `allowed`. `where` is the place in
    the file; `option` is "plant" or "model"; `known` are short names of this package.
    """
    name = given or named
    if not name:
        raise InputError(where, "is missing", f"name it, or pass --{option}")
    module = name.partition(":")[0]
    data = option == "plant" and Path(name).suffix in SAVED  # a model is never data
    if name in known or data or module == "plants" or ":" not in name:
        return name  # without ":" it is no import path; rejected where it is used
    if given is None and not allowed:
        raise InputError(
            where, f"names code that would be run, {name!a}",
            f"inspect it, then pass --{option} {name} or --allow-{option}",
        )  # fmt: skip
    return name


@checked
def plant_source(name: str, arguments: Mapping[str, Any]) -> PlantSource:
    """Find a plant by import path, or by the name of a .mat, .npz or .json file.

    A file holds A, B, C, dt and optionally D and the names `states`, `inputs`, `outputs`, which
    `arguments` may also give. A .npz file is read without pickles.
    """
    if Path(name).suffix in SAVED:
        matrices = read_matrices(Path(name))
        return PlantSource(
            name, lambda **given: state_space(name, {**matrices, **given}), arguments
        )
    return PlantSource(name, import_function(name), arguments)


@checked
def import_function(path: str) -> Callable[..., Any]:
    """Import ``module:function`` (search order: see the module docstring)."""
    module, _, function = path.partition(":")
    first = module.partition(".")[0]
    if not (first and function):
        raise InputError(
            f"plant {path}",
            "is neither a known name, a file, nor module:function",
            "see docs/tutorials/own_plant.md",
        )
    installed = first in sys.modules or importlib.util.find_spec(first) is not None
    try:
        with (
            users_code(f"plant {path}", ImportError, AttributeError),
            nullcontext() if installed else _beside_the_recordings(),
        ):
            found = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError) as error:
        hidden = installed and Path(f"{first}.py").exists()
        remedy = "rename yours: an installed module has its name" if hidden else "check its names"
        raise InputError(
            f"plant {path}", f"cannot be imported ({one_line(error)})", remedy
        ) from None
    made: Callable[..., Any] = found
    return made


@contextmanager
def users_code(name: str, *passing: type[Exception]) -> Iterator[None]:
    """Turn any exception of user code `name` into one line of this package's form.

    Errors of this package, those in `passing` and KeyboardInterrupt pass unchanged.
    """
    foreseen: tuple[type[Exception], ...] = (ImpcError, *passing)
    try:
        yield
    except foreseen:
        raise
    except BaseException as error:
        if type(error) is KeyboardInterrupt:
            raise
        said = one_line(error)
        problem = f"raised {type(error).__name__}{f' ({said})' if said else ''}"
        raise InputError(name, problem, "correct the function, or its arguments") from None


@contextmanager
def _beside_the_recordings() -> Iterator[None]:
    """Put the working folder last on the import path."""
    folder = os.getcwd()
    sys.path.append(folder)
    try:
        yield
    finally:
        sys.path.reverse()  # remove the last entry, not an equal earlier one
        sys.path.remove(folder)
        sys.path.reverse()


@checked
def make_plant(
    source: PlantSource, recorded: Sequence[str], *, linear: bool = False, **changed: Any
) -> Plant:
    """Make the plant; inputs that are `recorded` are disturbances, the others are controls.

    Names that are not inputs are ignored; `changed` replaces arguments of the source; with
    `linear` the nonlinear body is not made.
    """
    name, system = f"plant {source.name}", made_by(source, **changed)
    if linear and hasattr(system, "body"):
        system.body = None
    if hasattr(system, "no_plant"):  # an optimal control problem
        raise PlantError(name, *system.no_plant)
    inputs = tuple(getattr(system, "input_labels", ()))
    controls = [item for item in inputs if item not in recorded]
    if inputs and not controls:
        remedy = "set command = true in [signals.NAME] of the command"
        raise PlantError(name, "all its inputs are recorded", remedy)
    with _refused_arguments(name), users_code(name, *_REFUSED):
        plant = Plant(system, controls or None)
    return _recorded(plant, source.outputs) if source.outputs else plant


def _recorded(plant: Plant, outputs: Sequence[str]) -> Plant:
    """The plant with some of its outputs, which must determine the states that all of them do."""
    where = f"[plant] {OUTPUTS}"
    if unknown := [name for name in outputs if name not in plant.outputs]:
        known = f"choose from {', '.join(plant.outputs)}"
        raise InputError(where, f"has no output {unknown[0]!r}", known).at("", "plant", OUTPUTS)
    kept = replace(plant, C=plant.C[[plant.outputs.index(name) for name in outputs]],
                   outputs=tuple(outputs))  # fmt: skip
    if any(_seen(plant, value) and not _seen(kept, value) for value in np.linalg.eigvals(plant.A)):
        left = ", ".join(name for name in plant.outputs if name not in outputs)
        problem = f"do not determine all states; that needs {left}"
        raise InputError(where, problem, "record one more output").at("", "plant", OUTPUTS)
    return kept


def _seen(plant: Plant, eigenvalue: complex) -> bool:
    """Whether the outputs show the motion with an `eigenvalue` (Popov-Belevitch-Hautus test)."""
    scaled = plant.C / np.maximum(np.abs(plant.C).max(axis=1, keepdims=True), 1e-300)
    pencil = np.vstack([plant.A - eigenvalue * np.eye(plant.n), scaled])
    values = np.linalg.svd(pencil, compute_uv=False)
    return bool(values[-1] > _UNSEEN * values[0])


def made_by(source: PlantSource, **changed: float) -> Any:
    """Result of the source's function (plant or optimal control problem), some args `changed`."""
    arguments = {**source.arguments, **changed}
    arguments.pop(UNCERTAINTY, None)
    if source.outputs:
        arguments.pop(OUTPUTS)
    for key, value in arguments.items():
        if isinstance(value, str) and value == FILL_IN:
            problem = f"is still {FILL_IN!r}"
            raise InputError(f"[plant] {key}", problem, "fill it in").at("", "plant", key)
    name = f"plant {source.name}"
    with _refused_arguments(name), users_code(name, *_REFUSED), warnings.catch_warnings():
        warnings.simplefilter("error", np.exceptions.ComplexWarning)
        return source.make(**arguments)


# Singular value of the pencil, relative to the largest, below which no output shows a motion.
_UNSEEN = 1e-9
# Relative difference of a derivative from differences of the plant.
_SAME = 1e-3
_REFUSED = (TypeError, ValueError, np.exceptions.ComplexWarning)


@contextmanager
def _refused_arguments(name: str) -> Iterator[None]:
    """Turn errors about the arguments of plant `name` into one line."""
    try:
        yield
    except ImpcError:
        raise
    except np.exceptions.ComplexWarning:  # control.ss would drop the imaginary parts
        raise PlantError(name, "has complex matrices", "make them real") from None
    except (TypeError, ValueError) as error:
        raise InputError(
            name, f"refuses its arguments ({one_line(error)})", "correct the [plant] table"
        ).at("", "plant") from None


def plant_family_of(
    source: PlantSource, recorded: Sequence[str], free: Sequence[str]
) -> PlantFamily | None:
    """Family of plants that differ in `free` and uncertain arguments; None without any.

    `recorded` as in `make_plant`. A nonlinear body keeps its nonlinear part; its linear part
    follows the parameters.
    """
    offered = made_by(source)
    nominal = dict(getattr(offered, "parameters", {}))
    stated = _stated_uncertainty(source, offered)
    stated = {name: given for name, given in stated.items() if name not in free}
    uncertain = [name for name in stated if name in nominal or name not in (DELAY, LIMIT)]
    names = [*free, *uncertain]
    if not names and not stated:
        return None
    values = [nominal[name] if name in nominal else _nominal(source, name) for name in names]
    plain = make_plant(source, recorded)

    def make(given: Array) -> Plant:
        changed = {name: float(value) for name, value in zip(names, given, strict=True)}
        plant = make_plant(source, recorded, linear=True, **changed)
        if plain.body is None:
            return plant
        moved = (plant.A - plain.A, plant.B - plain.B, plant.E - plain.E)
        return replace(plant, body=plain.body.moved(*moved))

    def slopes(given: Array) -> dict[str, tuple[Array, ...]]:
        changed = {name: float(value) for name, value in zip(names, given, strict=True)}
        return _slopes(source, plain, made_by(source, **changed))

    found = PlantFamily(make, names, values, stated, slopes)
    _require_differences(source, found)
    return found if found.names or found.limit_deviation else None


def _slopes(source: PlantSource, plant: Plant, system: Any) -> dict[str, tuple[Array, ...]]:
    """Derivatives of A, B and E of a `plant` by the parameters of which its system knows them."""
    if not hasattr(system, "slopes"):
        return {}
    where, inputs = f"plant {source.name} slopes", list(system.input_labels)
    controls, pushes = (
        [inputs.index(name) for name in part] for part in (plant.controls, plant.disturbances)
    )
    found: dict[str, tuple[Array, ...]] = {}
    with users_code(where):
        for name, (A, B) in system.slopes().items():
            dA = finite_array(f"{where} {name}", A, (plant.n, plant.n))
            dB = finite_array(f"{where} {name}", B, (plant.n, len(inputs)))
            found[name] = dA, dB[:, controls], dB[:, pushes]
    return found


def _require_differences(source: PlantSource, family: PlantFamily) -> None:
    """Require that the derivatives that a plant offers are those of its matrices."""
    if family.slopes(family.nominal).keys().isdisjoint(family.names):
        return
    at, differences = np.zeros(len(family.names)), replace(family, slopes=lambda _: {})
    pair = plant_differential(family, at), plant_differential(differences, at)
    for offered, own in zip(pair[0][:4], pair[1][:4], strict=True):
        size = np.max(np.abs(own), initial=0.0, axis=(0, 1))
        wrong = np.max(np.abs(offered - own), initial=0.0, axis=(0, 1)) > _SAME * size
        if np.any(wrong):
            name = family.names[int(np.argmax(wrong))]
            problem = "is not the derivative of the plant's matrices"
            raise InputError(f"plant {source.name} slopes {name}", problem, "correct system.slopes")


def _stated_uncertainty(source: PlantSource, offered: Any) -> dict[str, Any]:
    """Standard deviations by name: the plant's own, overridden by [plant.uncertainty]."""
    given, place = source.arguments.get(UNCERTAINTY, {}), ("plant", UNCERTAINTY)
    if not isinstance(given, dict):
        remedy = 'write a table [plant.uncertainty], for example mass = "3 %"'
        raise InputError(f"[plant] {UNCERTAINTY}", "is not a table", remedy).at("", *place)
    for name, value in given.items():
        if isinstance(value, bool) or not isinstance(value, (int, float, str)):
            where = f"[plant.{UNCERTAINTY}] {name}"
            raise InputError(where, f"got {value!r}", 'give "5 %"').at("", *place, name)
    given, known = dict(given), dict(getattr(offered, UNCERTAINTY, {}))
    if _ALL in given:
        known = dict.fromkeys(known, given.pop(_ALL))
    return known | given


def _nominal(source: PlantSource, name: str) -> float:
    if name in source.arguments:
        value = source.arguments[name]
    else:
        parameter = inspect.signature(source.make).parameters.get(name)
        value = None if parameter is None else parameter.default
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        remedy = "set it in [plant]"
        raise InputError(f"parameter {name}", "has no nominal value", remedy).at("", "plant", name)
    return float(value)
