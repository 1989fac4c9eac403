"""Finished steps of an interrupted fit or comparison, for the same inputs and settings."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from impc.checking import replace
from impc.files.digests import digest, versions
from impc.files.saved_estimates import decode_estimate, encode_estimate
from impc.inverse.estimates import Estimate
from impc.inverse.methods import METHODS
from impc.inverse.problem import Problem
from impc.studies.cache import Cache, Steps
from impc.studies.fit.first import FitProgress
from impc.studies.fit.settings import FitSettings
from impc.studies.methods_table import method_label

# What follows the method in the title of an estimate without one trial.
_LEFT_OUT = re.compile(r", trial (\d+) left out$")


@dataclass(frozen=True)
class FitMemory(Steps):
    """Stored steps of `impc fit` and `impc compare`."""

    problem: Problem = field(kw_only=True)  # As posed

    def progress(self, done: Callable[..., None]) -> FitProgress:
        """Callbacks of a fit; `done` hears the title of each stage, and `found=`."""

        def said(title: str) -> None:
            done(title, found=self.names.get(title, False))

        return FitProgress(
            said, self.estimate, self.get, lambda problem: self.about(problem).progress(done)
        )

    def about(self, problem: Problem) -> FitMemory:
        """Store for another problem of the same recordings, with one more unknown."""
        numbers = problem.own_weights, problem.parameter_units, problem.recordings[0].outputs
        names = problem.parameter_names, problem.signal_errors
        pushes = problem.recordings[0].disturbance
        known = digest(self.digest, *names, *map(np.asarray, (*numbers, pushes)))
        return replace(self, digest=known, problem=problem)

    def estimate(self, name: str, compute: Callable[[], Estimate]) -> Estimate:
        """Stored estimate of the stage `name`, or the result of `compute`."""

        def decode(kept: dict[str, Any]) -> Estimate:
            posed, left_out = self.problem, _LEFT_OUT.search(name)
            if left_out:
                posed = posed.leaving_out(int(left_out[1]) - 1)
            first = method_label("inverse_mpc") + (left_out[0] if left_out else "")
            whole = None if name == first else self.cache.find(first, self.digest)
            if whole is not None and posed.family is not None:  # the fitted body
                found = np.array(whole["logarithms"], dtype=float)
                posed = posed.at(np.array(posed.starts), found, np.array(posed.errors))
            if len(kept["logarithms"]) < len(posed.logarithms):
                posed = posed.with_body_fixed()
            method = METHODS[kept["method"]]
            if method.name not in ("inverse_mpc", "structured"):
                posed = method.restrict(posed.with_nuisance_fixed())
            return decode_estimate(posed, kept)

        return self.get(name, compute, decode, encode_estimate)


def open_memory(
    folder: Path, problem: Problem, settings: FitSettings, command: str = "fit", made_of: str = ""
) -> FitMemory:
    """Open the stored steps of a command in a folder; empty if they belong to other inputs."""
    # A family enters by its nominal plant; `made_of` contains its code (`impc.files.digests`).
    body = () if problem.family is None else (problem.family.names, problem.family.deviations)
    known = digest(replace(problem, family=None), *body, settings, made_of, versions())
    return FitMemory(Cache(folder / f"{command}-in-progress"), known, problem=problem)
