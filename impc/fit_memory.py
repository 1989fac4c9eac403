"""What an interrupted command had done: the results of its stages, in one JSON file.

The file belongs to one set of recordings, settings and plant, told by a digest of all of them; with
any other it is not used and is written anew.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
from dataclasses import dataclass, field
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.arrays import Array, frozen
from impc.bootstrap import Replicate
from impc.errors import OutputError
from impc.fitted_controller import FittedController, fit_controller
from impc.gain import GainFit
from impc.inverse_problem import moved
from impc.lqr import solve_lqr
from impc.method_estimates import decode_estimate, encode_estimate
from impc.weights import stage_weights

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from impc.fit_settings import FitSettings
    from impc.inverse_problem import InverseProblem
    from impc.method_estimates import Estimate

__all__ = ["FitMemory", "open_memory"]


@dataclass(frozen=True)
class FitMemory:
    """Controllers and estimates of the stages done so far.

    Attributes
    ----------
    path : Path
        The file; its folder is made when the first stage is done.
    digest : str
        Of recordings, settings and plant.
    stages : dict
        Name of stage -> what `_encode` keeps of it.
    writing : Lock
        Held while a stage is written down: stages end in several threads.
    """

    path: Path
    digest: str
    stages: dict[str, Any] = field(default_factory=dict)
    writing: Lock = field(default_factory=Lock)

    def controller(self, name: str, problem: InverseProblem) -> FittedController:
        """The controller of the stage `name`, remembered or fitted now and then written down.

        Raises
        ------
        WeightsError, SolverError
            As `fit_controller`.
        OutputError
            When the file cannot be written.
        """
        if name in self.stages:
            return _restore(problem, self.stages[name])
        found = fit_controller(problem)
        self._keep(name, _encode(found))
        return found

    def estimate(self, name: str, compute: Callable[[], Estimate]) -> Estimate:
        """The estimate of the stage `name`, remembered or computed now and then written down.

        Raises
        ------
        OutputError
            When the file cannot be written.
        """
        if name in self.stages:
            return decode_estimate(self.stages[name])
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
        return f"kept in {self.path}: {', '.join(self.stages)}; the same command goes on from there"

    def forget(self) -> None:
        """Remove the file: the result has been written."""
        self.path.unlink(missing_ok=True)

    def _keep(self, name: str, value: dict[str, Any]) -> None:
        with self.writing:
            self.stages[name] = value
            self._write()

    def _write(self) -> None:
        staging = self.path.with_suffix(".part")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            staging.write_text(json.dumps({"digest": self.digest, "stages": self.stages}))
            os.replace(staging, self.path)
        except OSError as error:
            raise OutputError(
                f"folder {self.path.parent}",
                f"cannot be written to ({error.strerror})",
                "give another folder",
            ) from None


def open_memory(
    folder: Path, problem: InverseProblem, settings: FitSettings, command: str = "fit"
) -> FitMemory:
    """The memory of a command in a folder, empty when there is none for this very problem."""
    path, digest = folder / f"{command}-in-progress.json", _digest(problem, settings)
    try:
        found = json.loads(path.read_text())
        stages = found["stages"] if found["digest"] == digest else {}
    except (OSError, ValueError, KeyError, TypeError):  # none, or not ours: begin anew
        stages = {}
    return FitMemory(path, digest, stages)


def _digest(problem: InverseProblem, settings: FitSettings) -> str:
    text = hashlib.sha256(f"{importlib.metadata.version('impc')} {settings!r}".encode())
    plant, bounds = problem.plant, problem.bounds
    parts = [plant.A, plant.B, plant.E, plant.C, bounds.x_min, bounds.x_max, bounds.u_min]
    parts += [bounds.u_max, problem.output_scale]
    for trial in problem.recordings:
        parts += [trial.outputs, trial.disturbance, trial.x0]
    if problem.family is not None:
        text.update(repr(problem.family.names).encode())
        parts.append(problem.family.nominal)
    for part in parts:
        text.update(f"{part.shape}".encode() + np.ascontiguousarray(part).tobytes())
    return text.hexdigest()


def _encode(found: FittedController) -> dict[str, Any]:
    free = found.free
    return {
        "Q": found.weights.Q.tolist(),
        "R": found.weights.R.tolist(),
        "misfit": found.misfit,
        "exact": found.exact,
        "converged": found.converged,
        "metrics": found.metrics.tolist(),
        **_nuisance(found.problem),
        "free": {
            "K": free.K.tolist(),
            "S": free.S.tolist(),
            "misfit": free.misfit,
            "explained": free.explained,
            "stabilises": free.stabilises,
            "singular_values": free.singular_values.tolist(),
            "metrics": free.metrics.tolist(),
            "evaluations": free.evaluations,
            "refused": list(free.refused),
            **_nuisance(free.problem),
        },
    }


def _nuisance(problem: InverseProblem) -> dict[str, Any]:
    return {
        "starts": [trial.x0.tolist() for trial in problem.recordings],
        "logarithms": problem.logarithms.tolist(),
    }


def _restore(problem: InverseProblem, kept: dict[str, Any]) -> FittedController:
    free = kept["free"]
    here = _problem(problem, kept)
    weights = stage_weights(kept["Q"], kept["R"])
    return FittedController(
        here,
        GainFit(
            frozen(free["K"]),
            frozen(free["S"]),
            _problem(problem, free),
            free["misfit"],
            free["explained"],
            free["stabilises"],
            frozen(free["singular_values"]),
            frozen(free["metrics"]),
            free["evaluations"],
            tuple(free["refused"]),
        ),
        weights,
        solve_lqr(here.plant, weights),
        kept["misfit"],
        kept["exact"],
        kept["converged"],
        frozen(kept["metrics"]),
    )


def _problem(problem: InverseProblem, kept: dict[str, Any]) -> InverseProblem:
    starts: Array = np.array(kept["starts"], dtype=np.float64)
    return moved(problem, starts, np.array(kept["logarithms"], dtype=np.float64))
