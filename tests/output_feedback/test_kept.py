"""A stored fit equals the original one to the last digit."""

from __future__ import annotations

import json

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from impc.checking import replace
from impc.inverse.estimates import Estimate
from impc.inverse.methods import fit
from impc.inverse.structured import fit_structured
from impc.model.structure import Structure
from impc.output_feedback.covariance import person_covariance
from impc.output_feedback.fit import fit_output_feedback
from impc.output_feedback.kept import decode_person, encode_person
from impc.output_feedback.observer import Observer
from tests.inverse.test_regulator_span import late_body, late_problem
from tests.output_feedback.test_fit import cart, posed

pytestmark = pytest.mark.full


def any_gain() -> tuple[Estimate, Observer]:
    person = Observer(cart(), ["x"], motor=0.15, sensory=0.02)
    return fit(posed(person, 0.01, 0.9)), person


def gain_of_a_structure() -> tuple[Estimate, Observer]:
    problem = late_problem(structure=Structure(late_body(), ["p", "v"]))
    return fit(problem), Observer(problem.plant, ["p", "v"], motor=0.1, sensory=[0.02, 0.02])


def cost_weights() -> tuple[Estimate, Observer]:
    person = Observer(cart(), ["x"], motor=0.15, sensory=0.02)
    problem = posed(person, 0.01, 0.9)
    structure = Structure(problem.plant, ["x", "v"])
    problem = replace(problem, structure=structure)
    return fit_structured(problem, structure, fit(problem)), person


@pytest.mark.parametrize("make", [any_gain, gain_of_a_structure, cost_weights])
def test_it_is_the_one_that_was_fitted(make: object) -> None:
    assert callable(make)
    found, person = make()
    fit = fit_output_feedback(found, person, max_evaluations=30)
    kept = json.loads(json.dumps(encode_person(fit)))
    again = decode_person(found.problem, person, kept)
    for name in ("K", "S", "recorder", "theta", "unseen"):
        assert_array_equal(getattr(again, name), getattr(fit, name))
    assert (again.value, again.log_likelihood) == (fit.value, fit.log_likelihood)
    assert (again.converged, again.evaluations) == (fit.converged, fit.evaluations)
    assert_array_equal(again.problem.starts, fit.problem.starts)
    ours, theirs = person_covariance(again), person_covariance(fit)
    assert_array_equal(ours.entries, theirs.entries)
    assert_array_equal(ours.levels, theirs.levels)
    assert np.all(np.isfinite(ours.entries))
