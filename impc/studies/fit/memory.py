"""What an interrupted command had done: the results of its stages, one sealed file each.

They belong to one set of recordings, settings, plant and versions, told by a digest of all of them;
what belongs to any other, or was damaged, is not used and is done again.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.arrays import Array, frozen
from impc.assess.resampling import Replicate
from impc.checking import replace
from impc.files.digests import digest, versions
from impc.files.sealed import Kept
from impc.inverse.estimate import Estimate, decode_estimate, encode_estimate
from impc.inverse.methods import METHODS, Method

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from impc.inverse.problem import Problem
    from impc.model.plant_family import PlantFamily
    from impc.studies.fit.settings import FitSettings

__all__ = ["FitMemory", "open_memory"]

# Where a family of plants is looked at: two families may agree at their nominal values.
_FACTORS = (0.9, 1.1)
# Stages of a fit, and of a comparison.
_LEFT_OUT = re.compile(r"without (?:trial )?(\d+)")


@dataclass(frozen=True)
class FitMemory:
    """Controllers and estimates of the stages done so far.

    Attributes
    ----------
    problem : Problem
        As it was posed.
    files : Kept
        One a stage; the folder is made when the first stage is done.
    digest : str
        Of recordings, settings, plant and versions.
    stages : dict
        Name of stage -> what `_encode` keeps of it.
    """

    problem: Problem
    files: Kept
    digest: str
    stages: dict[str, Any] = field(default_factory=dict)

    def estimate(self, name: str, compute: Callable[[], Estimate]) -> Estimate:
        """The estimate of the stage `name`, remembered or computed now and then written down.

        Raises
        ------
        OutputError
            When the file cannot be written.
        """
        if name in self.stages:
            kept = self.stages[name]
            return decode_estimate(_seen(self.problem, name, METHODS[kept["method"]]), kept)
        found = compute()
        self._keep(name, encode_estimate(found))
        return found

    def replicate(self, name: str, compute: Callable[[], Replicate]) -> Replicate:
        """The bootstrap replicate of the stage `name`, in the same way.

        Raises
        ------
        OutputError
            When the file cannot be written.
        """
        if name in self.stages:
            kept = self.stages[name]
            return Replicate(frozen(kept["K"]), frozen(kept["parameters"]))
        found = compute()
        self._keep(name, {"K": found.K.tolist(), "parameters": found.parameters.tolist()})
        return found

    def kept(self) -> str:
        """What to tell whoever interrupts the command."""
        if not self.stages:
            return "nothing was done yet"
        done = ", ".join(self.stages)
        return f"kept in {self.files.folder}: {done}; the same command goes on from there"

    def forget(self) -> None:
        """Remove the folder: the result has been written.

        Raises
        ------
        OutputError
            When that cannot be done.
        """
        self.files.forget()

    def _keep(self, name: str, value: dict[str, Any]) -> None:
        self.files.keep(name, self.digest, value)
        self.stages[name] = value


def open_memory(
    folder: Path,
    problem: Problem,
    settings: FitSettings,
    command: str = "fit",
    made_of: str = "",
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
    files = Kept(folder / f"{command}-in-progress")
    known = digest(_content(problem), settings, made_of, versions())
    return FitMemory(problem, files, known, files.recall_all(known))


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


def _seen(problem: Problem, stage: str, method: Method) -> Problem:
    """The problem of a stage as its method sees it."""
    left_out = _LEFT_OUT.match(stage)
    posed = problem.leaving_out(int(left_out[1]) - 1) if left_out else problem
    return posed if method.name == "inverse_mpc" else method.sees(posed.known())
