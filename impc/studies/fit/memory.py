"""What an interrupted fit or comparison had done, for one set of recordings, settings and plant."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from impc.assess.resampling import Replicate
from impc.checking import replace
from impc.files.digests import digest, versions
from impc.files.saved_estimates import decode_estimate, encode_estimate
from impc.inverse.methods import METHODS, Method
from impc.studies.cache import Cache, Steps, from_json

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem
    from impc.studies.fit.settings import FitSettings

Part = TypeVar("Part")

# Stages of a fit, and of a comparison.
_WHOLE = "inverse_mpc"
_LEFT_OUT = re.compile(r"without (?:trial )?(\d+)")


@dataclass(frozen=True)
class FitMemory(Steps):
    """The steps of `impc fit` and `impc compare`; its methods are what these two keep."""

    problem: Problem = field(kw_only=True)  # As it was posed

    def about(self, problem: Problem) -> FitMemory:
        """The memory of another problem of the same recordings, which has one unknown more."""
        known = digest(self.digest, problem.parameter_names, problem.offsets)
        return replace(self, digest=known, problem=problem)

    def estimate(self, name: str, compute: Callable[[], Estimate]) -> Estimate:
        """The estimate of the stage `name`, as `compute` makes it."""

        def decode(kept: dict[str, Any]) -> Estimate:
            posed = self.problem
            whole = None if name == _WHOLE else self.cache.find(_WHOLE, self.digest)
            if whole is not None and posed.family is not None:  # the body that it has found
                found = np.array(whole["logarithms"], dtype=float)
                posed = posed.at(np.array(posed.starts), found, np.array(posed.shifts))
            if len(kept["logarithms"]) < len(posed.logarithms):
                posed = posed.with_body_fixed()
            return decode_estimate(_seen(posed, name, METHODS[kept["method"]]), kept)

        return self.get(name, compute, decode, encode_estimate)

    def replicate(self, name: str, compute: Callable[[], Replicate]) -> Replicate:
        """The bootstrap replicate of the stage `name`, as `compute` makes it."""
        return self.get(name, compute, lambda kept: from_json(kept, Replicate))

    def part(
        self,
        name: str,
        compute: Callable[[], Part],
        encode: Callable[[Part], Any],
        decode: Callable[[Any], Part],
    ) -> Part:
        """What an optional subpackage finds in the stage `name`, as `compute` makes it."""
        return self.get(name, compute, decode, encode)


def open_memory(
    folder: Path, problem: Problem, settings: FitSettings, command: str = "fit", made_of: str = ""
) -> FitMemory:
    """The memory of a command in a folder, empty when there is none for this very problem."""
    # Of a family the plant at its nominal values; its code is in `made_of` (`impc.files.digests`).
    body = () if problem.family is None else (problem.family.names, problem.family.deviations)
    known = digest(replace(problem, family=None), *body, settings, made_of, versions())
    return FitMemory(Cache(folder / f"{command}-in-progress"), known, problem=problem)


def _seen(problem: Problem, stage: str, method: Method) -> Problem:
    """The problem of a stage as its method sees it."""
    left_out = _LEFT_OUT.match(stage)
    posed = problem.leaving_out(int(left_out[1]) - 1) if left_out else problem
    return (
        posed
        if method.name in ("inverse_mpc", "structured")
        else method.restrict(posed.with_nuisance_fixed())
    )
