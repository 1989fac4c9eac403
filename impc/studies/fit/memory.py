"""What an interrupted fit or comparison had done, for one set of recordings, settings and plant.

A person that was fitted, as values that JSON keeps: an interrupted command goes on from there.

What the recordings say at its unknowns is not kept: one likelihood tells it again, to the last
digit (docs/noisy-people.md).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.arrays import frozen
from impc.assess.person_models import PersonModel
from impc.assess.resampling import Replicate
from impc.checking import replace
from impc.files.digests import digest, versions
from impc.inverse.coordinates import Point
from impc.inverse.estimates import (
    Estimate,
    decode_estimate,
    encode_estimate,
)
from impc.inverse.likelihood_fit import person_at
from impc.inverse.likelihood_start import Asked, gain_space, prior_about
from impc.inverse.methods import METHODS, Method
from impc.inverse.person_coordinates import PersonCoordinates
from impc.inverse.structured_search import PriceCoordinates
from impc.studies.cache import Cache, Steps, from_json

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from impc.inverse.likelihood_fit import PersonFit
    from impc.inverse.problem import Problem
    from impc.model.observer import Observer
    from impc.studies.fit.settings import FitSettings

# Stages of a fit, and of a comparison.
_LEFT_OUT = re.compile(r"without (?:trial )?(\d+)")


@dataclass(frozen=True)
class FitMemory(Steps):
    """The steps of `impc fit` and `impc compare`; its methods are what these two keep."""

    problem: Problem = field(kw_only=True)  # As it was posed

    def estimate(self, name: str, compute: Callable[[], Estimate]) -> Estimate:
        """The estimate of the stage `name`, as `compute` makes it."""

        def decode(kept: dict[str, Any]) -> Estimate:
            return decode_estimate(_seen(self.problem, name, METHODS[kept["method"]]), kept)

        return self.get(name, compute, decode, encode_estimate)

    def replicate(self, name: str, compute: Callable[[], Replicate]) -> Replicate:
        """The bootstrap replicate of the stage `name`, as `compute` makes it."""
        return self.get(name, compute, lambda kept: from_json(kept, Replicate))

    def person(
        self, name: str, posed: Problem, observer: Observer, compute: Callable[[], PersonModel]
    ) -> PersonModel:
        """The person who senses with noise of the stage `name`, as `compute` makes it."""

        def encode(model: PersonModel) -> dict[str, Any]:
            fit = None if model.fit is None else encode_person(model.fit)
            return {"fit": fit, "reason": model.reason}

        def decode(kept: dict[str, Any]) -> PersonModel:
            fit = None if kept["fit"] is None else decode_person(posed, observer, kept["fit"])
            return PersonModel(name, fit, kept["reason"])

        return self.get(name, compute, decode, encode)


def open_memory(
    folder: Path, problem: Problem, settings: FitSettings, command: str = "fit", made_of: str = ""
) -> FitMemory:
    """The memory of a command in a folder, empty when there is none for this very problem."""
    # Of a family the plant at its nominal values; its code is in `made_of` (`impc.files.inputs`).
    known = digest(replace(problem, family=None), settings, made_of, versions())
    return FitMemory(Cache(folder / f"{command}-in-progress"), known, problem=problem)


def _seen(problem: Problem, stage: str, method: Method) -> Problem:
    """The problem of a stage as its method sees it."""
    left_out = _LEFT_OUT.match(stage)
    posed = problem.leaving_out(int(left_out[1]) - 1) if left_out else problem
    return posed if method.name in ("inverse_mpc", "structured") else method.sees(posed.known())


def encode_person(fit: PersonFit) -> dict[str, Any]:
    """What coordinates and prior of the search began with, and where it ended."""
    own, space = fit.space.space, fit.space
    K, S = own.given
    return {
        "K": np.asarray(K).tolist(),
        "S": np.asarray(S).tolist(),
        "prices": own.prices.tolist() if isinstance(own, PriceCoordinates) else None,
        "starts": own.problem.starts.tolist(),
        "logarithms": own.problem.logarithms.tolist(),
        "levels": space.first.tolist(),
        "theta": fit.theta.tolist(),
        "unseen": fit.unseen.tolist(),
        "converged": fit.converged,
        "evaluations": fit.evaluations,
    }


def decode_person(problem: Problem, observer: Observer, kept: dict[str, Any]) -> PersonFit:
    """Make the fit again."""
    posed = problem.at(np.array(kept["starts"]), np.array(kept["logarithms"], dtype=np.float64))
    point = Point(np.array(kept["K"]), np.array(kept["S"]), posed)
    levels, split = np.array(kept["levels"]), len(observer.levels)
    own = gain_space(point, None if kept["prices"] is None else frozen(kept["prices"]))
    space = PersonCoordinates(own, observer.with_levels(levels[:split]), levels[split:])
    prior = prior_about(space, Asked(observer, None, (), 1.0, 0))
    place = prior.at(np.array(kept["theta"]))
    unseen = np.array(kept["unseen"])
    return person_at(prior, place, unseen, kept["converged"], kept["evaluations"])
