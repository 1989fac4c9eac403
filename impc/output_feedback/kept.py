"""Store a fitted sensorimotor model as JSON values, for interrupted commands.

Evaluating the likelihood once at the stored unknowns reproduces the fit to the last digit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from impc.arrays import frozen
from impc.inverse.structured_search import WeightCoordinates
from impc.inverse.unknowns import Point
from impc.output_feedback.fit import person_at
from impc.output_feedback.page import PersonModel
from impc.output_feedback.start import Asked, gain_space, prior_about
from impc.output_feedback.unknowns import PersonCoordinates

if TYPE_CHECKING:
    from impc.inverse.problem import Problem
    from impc.output_feedback.fit import OutputFeedbackFit
    from impc.output_feedback.observer import Observer


def encode_model(model: PersonModel) -> dict[str, Any]:
    """JSON values of a model, fitted or not."""
    fit = None if model.fit is None else encode_person(model.fit)
    return {"fit": fit, "reason": model.reason}


def decode_model(
    name: str, problem: Problem, observer: Observer, kept: dict[str, Any]
) -> PersonModel:
    """Rebuild the model."""
    fit = None if kept["fit"] is None else decode_person(problem, observer, kept["fit"])
    return PersonModel(name, fit, kept["reason"])


def encode_person(fit: OutputFeedbackFit) -> dict[str, Any]:
    """JSON values of a fit: start of coordinates and prior, and final unknowns."""
    own, space = fit.space.space, fit.space
    K, S = own.given
    return {
        "K": np.asarray(K).tolist(),
        "S": np.asarray(S).tolist(),
        "cost_weights": own.cost_weights.tolist() if isinstance(own, WeightCoordinates) else None,
        "starts": own.problem.starts.tolist(),
        "logarithms": own.problem.logarithms.tolist(),
        "levels": space.first.tolist(),
        "theta": fit.theta.tolist(),
        "unseen": fit.unseen.tolist(),
        "converged": fit.converged,
        "evaluations": fit.evaluations,
    }


def decode_person(problem: Problem, observer: Observer, kept: dict[str, Any]) -> OutputFeedbackFit:
    """Rebuild the fit."""
    posed = problem.at(np.array(kept["starts"]), np.array(kept["logarithms"], dtype=np.float64))
    point = Point(np.array(kept["K"]), np.array(kept["S"]), posed)
    levels, split = np.array(kept["levels"]), len(observer.levels)
    own = gain_space(point, None if kept["cost_weights"] is None else frozen(kept["cost_weights"]))
    space = PersonCoordinates(own, observer.with_levels(levels[:split]), levels[split:])
    prior = prior_about(space, Asked(observer, None, (), 1.0, 0))
    place = prior.at(np.array(kept["theta"]))
    unseen = np.array(kept["unseen"])
    return person_at(prior, place, unseen, kept["converged"], kept["evaluations"])
