"""Measures of every estimate against values computed by hand."""

from __future__ import annotations

import numpy as np
import pytest

import impc
from impc.assess.assessments import ASSESSMENTS, MethodFit, assessed, evaluate_method
from impc.inverse import methods
from tests.assess.cart_fits import cart_problem


@pytest.fixture(scope="module")
def fit() -> MethodFit:
    """Gain that exceeds the bound of the cart."""
    problem = cart_problem(21, 22)
    return evaluate_method(methods.fit(problem, "feedback_gain"), problem.bounds)


def test_numbers_of_a_gain(fit: MethodFit) -> None:
    found, u = assessed(fit), np.concatenate([run.u for run in fit.runs])
    problem = fit.estimate.problem
    recorded = np.concatenate([trial.outputs for trial in problem.recordings])[:, 0]
    simulated = np.concatenate([run.x @ problem.plant.C.T for run in fit.runs])[:, 0]
    share = 100 * (1 - np.sum((recorded - simulated) ** 2) / np.sum(recorded**2))
    plant = problem.plant
    assert found["vaf"] == pytest.approx({plant.outputs[0]: share})
    assert found["largest_input"] == {plant.controls[0]: np.max(np.abs(u))}
    assert found["beyond_bound"] == pytest.approx(100 * np.mean(np.abs(u) > 1 + 1e-6))
    for name in ("first_fall", "condition_number"):
        assert np.isnan(found[name])  # type: ignore[arg-type]
    assert np.all(np.isnan(ASSESSMENTS["held_out_vaf"].find(fit)))
    left = impc.replace(fit, held_out=np.array([[80.0], [90.0]]), fell=(None, 1.5))
    assert assessed(left)["held_out_vaf"] == {plant.outputs[0]: 85.0}
    assert assessed(left)["first_fall"] == 1.5


def test_a_method_without_a_gain(fit: MethodFit) -> None:
    none = evaluate_method(impc.replace(fit.estimate, K=None, S=None), fit.estimate.problem.bounds)
    for item in ASSESSMENTS.values():
        values = item.find(none)
        assert len(values) == len(item.signals(none.estimate.problem.plant))
        assert np.all(np.isnan(values)), item.name


def test_the_condition_number_is_that_of_both_weights(fit: MethodFit) -> None:
    problem = fit.estimate.problem
    found = methods.fit(problem, "inverse_lqr_output")
    values = np.concatenate(
        [np.linalg.eigvalsh(found.stage_weights.Q), np.linalg.eigvalsh(found.stage_weights.R)]
    )
    assert assessed(evaluate_method(found, problem.bounds))["condition_number"] == pytest.approx(
        values.max() / values.min()
    )
