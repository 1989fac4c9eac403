"""Save and load an estimate with its problem as JSON, exact to the last digit, without code.

Python functions are not saved: a nonlinear body and a family of plants must be passed to `load`
again, which compares them with the saved values.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from impc.arrays import finite_array, frozen
from impc.checking import checked, replace
from impc.errors import DataError, ImpcError, InputError
from impc.files.disk import unwritable, write_whole
from impc.files.results import SCHEMA, ResultFile, read_content, read_result
from impc.inverse.estimates import Estimate, Goodness, SearchEnd, Status
from impc.inverse.methods import METHODS
from impc.inverse.minimiser import Ended
from impc.inverse.problem import Problem
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.plant_family import PlantFamily, plant_at
from impc.model.recordings import Label, Recording
from impc.model.signal_errors import KINDS
from impc.model.structure import Structure
from impc.model.weights import Weights

_SIGNALS = ("states", "controls", "disturbances", "outputs", "commands")
# Conversion of plain fields by annotation.
_PLAIN: dict[Any, Any] = {"bool": bool, "int": int, "str": str}
# Relative tolerance for entries of a plant that is passed again.
_SAME = 1e-9


@checked
def save_estimate(estimate: Estimate, path: str | Path) -> Path:
    """Save the estimate and its problem as JSON; read the file with `impc.load`."""
    place = Path(path)
    content = {
        "schema": SCHEMA,
        "problem": _encode(estimate.problem),
        "estimate": encode_estimate(estimate),
    }
    try:
        write_whole(place, json.dumps(content).encode())
    except (OSError, ValueError) as error:
        raise unwritable(f"file {place}", error, "choose another file") from None
    return place


@checked
def load(
    path: str | Path, *, plant: Plant | None = None, family: PlantFamily | None = None
) -> Estimate | ResultFile:
    """Load a saved estimate, or the result of a command.

    Parameters
    ----------
    path : str or Path
        File written by `Estimate.save`, folder written by a command or `impc.report`, or its
        result.json.
    plant : Plant, optional
        Plant of the estimate; needed if it has a nonlinear body, which is not saved.
    family : PlantFamily, optional
        Family of the estimate; needed if physical parameters were fitted.

    Returns
    -------
    Estimate or ResultFile

    Raises
    ------
    DataError
        If the file is missing or damaged, or another version of impc wrote it.
    InputError
        If the plant or the family is needed, or differs from the saved one.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> import control
    >>> import impc
    >>> plant = impc.Plant(control.ss([[0.9]], [[1]], [[1]], 0, 1))
    >>> bounds = impc.Bounds(plant, u_min=-0.3, u_max=0.3)
    >>> truth = impc.Controller(plant, impc.Weights(1, 1), bounds, horizon=3)
    >>> trial = impc.Recording(plant, truth.simulate([1.0], steps=20).x)
    >>> found = impc.fit(impc.Problem(plant, bounds, 3, [trial]))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     again = impc.load(found.save(pathlib.Path(folder) / "found.json"))
    ...     files = impc.report(found, folder)
    ...     result = impc.load(folder)
    >>> bool((again.K == found.K).all()), result.methods["inverse_mpc"].status
    (True, 'explained')
    """
    place = Path(path)
    if os.path.isdir(place):
        return read_result(place)
    content = read_content(place)
    if "estimate" not in content:
        return read_result(place)
    try:
        return decode_estimate(_problem(content["problem"], plant, family), content["estimate"])
    except ImpcError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        reason = " ".join(str(error).split())[:80]
        problem = f"is damaged ({type(error).__name__}: {reason})"
        raise DataError(f"file {place}", problem, "save the estimate again") from None


def encode_estimate(estimate: Estimate) -> dict[str, Any]:
    """Values of an estimate for JSON, exact to the last digit, without the problem itself."""
    kept: dict[str, Any] = _encode(replace(estimate, problem=None))
    problem = estimate.problem
    return kept | {
        "starts": problem.starts.tolist(),
        "errors": problem.errors.tolist(),
        "logarithms": problem.logarithms.tolist(),
        "terminal_set": bool(problem.terminal_set),
    }


def decode_estimate(seen: Problem, kept: Mapping[str, Any]) -> Estimate:
    """Rebuild an estimate from `kept` values and the problem as its method saw it."""
    m, n, weights = seen.plant.m, seen.plant.n, kept["weights"]
    sizes = {"K": (m, n), "S": (m, m)}
    posed = replace(seen, terminal_set=kept["terminal_set"])
    own = (np.array(kept[name], dtype=float) for name in ("starts", "logarithms", "errors"))
    numbers = {name: float(kept[name]) for name in ("misfit", "noise", "seconds")}
    if kept["method"] not in METHODS or not isinstance(kept["reason"], str):
        raise ValueError("unknown method, or a reason that is not text")
    known = {*seen.plant.outputs, *seen.plant.disturbances}
    if not all(kind in KINDS and name in known for kind, name in seen.signal_errors):
        raise ValueError("an error of an unknown signal")
    values = dict(kept) | {
        **numbers,
        "evaluations": int(kept["evaluations"]),
        "cost_weights": None if kept["cost_weights"] is None else frozen(kept["cost_weights"]),
        "problem": posed.at(*own),
        "refitted": None if kept["refitted"] is None else _end(kept["refitted"], sizes),
        "rivals": tuple(_end(one, sizes) for one in kept["rivals"]),
        "weights": None if weights is None else Weights(weights["Q"], weights["R"]),
        "metrics": frozen(np.reshape(kept["metrics"], (-1, m, m))),
        "status": Status(kept["status"]),
        "fit": Goodness(
            **{item.name: _PLAIN[item.type](kept["fit"][item.name]) for item in fields(Goodness)}
        ),
        **{
            name: None if kept[name] is None else frozen(finite_array(name, kept[name], size))
            for name, size in sizes.items()
        },
    }
    return Estimate(**{item.name: values[item.name] for item in fields(Estimate)})


def _end(kept: Mapping[str, Any], sizes: Mapping[str, tuple[int, int]]) -> SearchEnd:
    K, S = (frozen(finite_array(name, kept[name], size)) for name, size in sizes.items())
    starts, logarithms, errors = (frozen(kept[name]) for name in ("starts", "logarithms", "errors"))
    objective, ended = float(kept["objective"]), Ended(kept["ended"])
    return SearchEnd(K, S, starts, logarithms, errors, objective, ended)


def _encode(value: Any) -> Any:
    """JSON value: fields by name, arrays as lists, enumerations by value; no functions."""
    if isinstance(value, Plant):
        return _fields(value) | {"body": value.body is not None}
    if isinstance(value, Problem):
        names = [] if value.family is None else list(value.family.names)
        return _fields(replace(value, family=None)) | {"family": names}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, tuple):
        return [_encode(item) for item in value]
    if isinstance(value, Enum):
        return value.value
    return _fields(value) if is_dataclass(value) else value


def _fields(value: Any) -> dict[str, Any]:
    return {item.name: _encode(getattr(value, item.name)) for item in fields(value)}


def _problem(kept: dict[str, Any], plant: Plant | None, family: PlantFamily | None) -> Problem:
    saved, names = kept["plant"], kept["family"]
    if family is not None and family.limit_deviation:
        family = _with_limits(family, kept)
    if names and (family is None or list(family.names) != names):
        raise InputError("family", f"must have {', '.join(names)}", "pass load(..., family=...)")
    if family is not None and names:
        plant = plant_at(family, np.array(kept["logarithms"], dtype=float))
    if saved["body"] and plant is None:
        raise InputError("plant", "has an unsaved nonlinear body", "pass load(..., plant=...)")
    if plant is None:
        fixed = {name: tuple(saved[name]) for name in _SIGNALS}
        pairs = {name: tuple(map(tuple, saved[name])) for name in ("units", "words", "gravity")}
        previewed = {"previewed": tuple(saved["previewed"])}
        plant = _filled(Plant, saved | fixed | pairs | previewed | {"body": None})
        _require_names(plant)
    _require_same(plant, saved)
    structure = kept["structure"]
    found: Problem = _filled(
        Problem,
        kept
        | {
            "plant": plant,
            "bounds": Bounds(plant, **kept["bounds"]),
            "recordings": tuple(_recording(item, plant) for item in kept["recordings"]),
            "signal_errors": tuple((str(kind), name) for kind, name in kept["signal_errors"]),
            "family": family if names else None,
            "structure": None if structure is None else _filled(Structure, _tuples(structure)),
            "feedback_states": tuple(kept["feedback_states"]),
        },
    )
    return found


def _with_limits(family: PlantFamily, kept: dict[str, Any]) -> PlantFamily:
    """Family extended by the control limits as parameters, at their nominal values."""
    plant, count = family.make(family.nominal), len(family.names)
    wider = family.with_limits(plant, Bounds(plant, **kept["bounds"]))
    nominal = np.array(wider.nominal)
    nominal[count:] /= np.exp(np.array(kept["logarithms"], dtype=float)[count:])
    return replace(wider, nominal=frozen(nominal))


def _require_names(plant: Plant) -> None:
    """Require a text name for every signal."""
    sizes = (plant.n, plant.m, plant.E.shape[1], len(plant.C), len(plant.commands))
    for signals, size in zip(_SIGNALS, sizes, strict=True):
        names = getattr(plant, signals)
        if len(names) != size or not all(isinstance(name, str) for name in names):
            raise ValueError(f"{signals} without names")
    for pairs in (plant.units, plant.words):
        if not all(isinstance(text, str) for pair in pairs for text in pair):
            raise ValueError("a unit that is not text")
    finite_array("gravity", [moment for _, moment in plant.gravity], (len(plant.gravity),))
    if not {name for name, _ in plant.gravity} <= set(plant.states):
        raise ValueError("a moment of gravity of no state")


def _require_same(plant: Plant, saved: Mapping[str, Any]) -> None:
    """Require that a plant that is passed again equals the saved one."""
    other = [name for name in _SIGNALS if list(getattr(plant, name)) != saved[name]]
    for name in ("A", "B", "E", "C", "dt", "observer", "ahead"):
        own, kept = np.asarray(getattr(plant, name)), np.asarray(saved[name], dtype=float)
        if own.shape != kept.shape or not np.allclose(own, kept, rtol=_SAME, atol=0):
            other.append(name)
    if (plant.body is not None) != saved["body"]:
        other.append("body")
    if other:
        raise InputError("plant", f"has a different {other[0]} than saved", "pass the same plant")


def _recording(kept: Mapping[str, Any], plant: Plant) -> Recording:
    values = dict(kept) | {
        "label": Label(**kept["label"]),
        "findings": tuple(kept["findings"]),
        "signals": tuple(kept["signals"]),
        "commands": np.reshape(kept["commands"], (-1, plant.m)),
        "finer": np.reshape(kept["finer"], (len(kept["finer"]), plant.E.shape[1])),
        "target": np.reshape(kept["target"], (len(kept["outputs"]), -1)),
    }
    found: Recording = _filled(Recording, values)
    return found


def _tuples(kept: Mapping[str, Any]) -> dict[str, Any]:
    return {name: tuple(item) if name.endswith("labels") else item for name, item in kept.items()}


def _filled(kind: Any, values: Mapping[str, Any]) -> Any:
    """Make a `kind` from its checked fields, bypassing `__init__`."""
    made = object.__new__(kind)
    made._fill(**{
        item.name: frozen(values[item.name])
        if item.type == "Array"
        else values[item.name]
        for item in fields(kind)
    })  # fmt: skip
    return made
