"""What an interrupted fit or comparison had done, for one set of recordings, settings and plant."""

from __future__ import annotations

import functools
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.arrays import Array, frozen
from impc.assess.resampling import Replicate
from impc.checking import replace
from impc.files.digests import digest, versions
from impc.files.sealed import Kept
from impc.inverse.gain_search import GainFit
from impc.inverse.methods import decode_estimate, encode_estimate
from impc.inverse.noisy_fit import FittedController, fit_controller
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights
from impc.studies.cache import Cache, Codec, by_fields

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from impc.inverse.methods import Estimate
    from impc.inverse.problem import Problem
    from impc.model.plant_family import PlantFamily
    from impc.studies.fit.settings import FitSettings

__all__ = ["FitMemory", "open_memory"]

# Where a family of plants is looked at: two families may agree at their nominal values.
_FACTORS = (0.9, 1.1)
# Fields of a result that are made again, or written in their own way.
_APART = ("problem", "free", "weights", "solution")


@dataclass(frozen=True)
class FitMemory(Cache):
    """The cache of `impc fit` and `impc compare`; its methods are what these two keep.

    `files`, `digest`, `done` and `stages` are as in `Cache`.
    """

    def controller(self, name: str, problem: Problem) -> FittedController:
        """The controller of the stage `name`, fitted to the `problem`.

        Raises
        ------
        WeightsError, SolverError
            As `fit_controller`.
        OutputError
            When the file cannot be written.
        """
        codec = Codec(_encode, functools.partial(_restore, problem))
        return self.get(name, lambda: fit_controller(problem), codec)

    def estimate(self, name: str, compute: Callable[[], Estimate]) -> Estimate:
        """The estimate of the stage `name`, as `compute` makes it.

        Raises
        ------
        OutputError
            When the file cannot be written.
        """
        return self.get(name, compute, Codec(encode_estimate, decode_estimate))

    def replicate(self, name: str, compute: Callable[[], Replicate]) -> Replicate:
        """The bootstrap replicate of the stage `name`, as `compute` makes it.

        Raises
        ------
        OutputError
            When the file cannot be written.
        """
        return self.get(name, compute, by_fields(Replicate))


def open_memory(
    folder: Path, problem: Problem, settings: FitSettings, command: str = "fit", made_of: str = ""
) -> FitMemory:
    """The memory of a command in a folder, empty when there is none for this very problem.

    Parameters
    ----------
    folder : Path
        Where the command writes.
    problem : Problem
    settings : FitSettings
    command : str
        "fit" or "compare".
    made_of : str
        Digest of the files that the problem was made of (`Inputs.digest`).
    """
    known = digest(_content(problem), settings, made_of, versions())
    return FitMemory(Kept(folder / f"{command}-in-progress"), known)


def _content(problem: Problem) -> tuple[Any, ...]:
    """All of a problem that has a content: a family of plants is told by some of its plants."""
    family = problem.family
    if family is None:
        return (problem,)
    plants = [family.make(values) for values in _probes(family)]
    return replace(problem, family=None), family.names, family.nominal, plants


def _probes(family: PlantFamily) -> list[Array]:
    changes = [np.eye(len(family.nominal)) * (factor - 1) + 1 for factor in _FACTORS]
    return [family.nominal * row for row in np.concatenate(changes)]


def _encode(found: FittedController) -> dict[str, Any]:
    weights = {"Q": found.weights.Q.tolist(), "R": found.weights.R.tolist()}
    return _fields(found) | weights | {"free": _fields(found.free)}


def _fields(found: FittedController | GainFit) -> dict[str, Any]:
    """What JSON takes of a result, and what was found of its problem."""
    own = {name: value for name, value in vars(found).items() if name not in _APART}
    own["starts"] = np.array([trial.x0 for trial in found.problem.recordings])
    own["logarithms"] = found.problem.logarithms
    return {
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name, value in own.items()
    }


def _restore(problem: Problem, kept: dict[str, Any]) -> FittedController:
    here, weights = _problem(problem, kept), Weights(kept["Q"], kept["R"])
    free = GainFit(problem=_problem(problem, kept["free"]), **_values(GainFit, kept["free"]))
    return FittedController(
        problem=here,
        free=free,
        weights=weights,
        solution=solve_lqr(here.plant, weights),
        **_values(FittedController, kept),
    )


def _values(kind: type, kept: dict[str, Any]) -> dict[str, Any]:
    """Inverse of `_fields`, of those that JSON took."""
    return {
        item.name: frozen(kept[item.name]) if item.type == "Array" else _tuple(kept[item.name])
        for item in fields(kind)
        if item.name not in _APART
    }


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _problem(problem: Problem, kept: dict[str, Any]) -> Problem:
    starts: Array = np.array(kept["starts"], dtype=np.float64)
    return problem.at(starts, np.array(kept["logarithms"], dtype=np.float64))
