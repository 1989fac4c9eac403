"""A person that was fitted, as values that JSON keeps: an interrupted command goes on from there.

What the recordings say at its unknowns is not kept: one likelihood tells it again, to the last
digit (docs/noisy-people.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from impc.inverse.coordinates import Point
from impc.inverse.estimates import decode_prices, encode_prices
from impc.inverse.likelihood_fit import person_at
from impc.inverse.likelihood_start import Asked, gain_space, prior_about
from impc.inverse.person_coordinates import PersonCoordinates
from impc.inverse.structured_search import PriceCoordinates

if TYPE_CHECKING:
    from impc.inverse.likelihood_fit import PersonFit
    from impc.inverse.problem import Problem
    from impc.model.observer import Observer

__all__ = ["decode_person", "encode_person"]


def encode_person(fit: PersonFit) -> dict[str, Any]:
    """What coordinates and prior of the search began with, and where it ended."""
    own, space = fit.space.space, fit.space
    K, S = own.given
    return {
        "K": np.asarray(K).tolist(),
        "S": np.asarray(S).tolist(),
        "prices": encode_prices(own.prices) if isinstance(own, PriceCoordinates) else None,
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
    own = gain_space(point, None if kept["prices"] is None else decode_prices(kept["prices"]))
    space = PersonCoordinates(own, observer.with_levels(levels[:split]), levels[split:])
    prior = prior_about(space, Asked(observer, None, (), 1.0, 0))
    place = prior.at(np.array(kept["theta"]))
    unseen = np.array(kept["unseen"])
    return person_at(prior, place, unseen, kept["converged"], kept["evaluations"])
