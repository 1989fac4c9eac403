"""Table of methods: labels and numbers agree with result.json in all commands."""

from __future__ import annotations

import csv
import io
import json

import numpy as np
import pytest

from experiments.coverage import cart, noisy_trial
from impc.assess.assessments import ASSESSMENTS, Assessment, MethodFit, evaluate_method
from impc.checking import replace
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.simulation import scenario
from impc.inverse.methods import METHODS, fit
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.weights import Weights
from impc.reporting.document import json_bytes
from impc.reporting.finding import csv_bytes
from impc.studies.fit.asked import fit_problem
from impc.studies.fit.settings import FitSettings
from impc.studies.methods_table import methods_data, methods_finding, until_its_end


@pytest.fixture(scope="module")
def fits() -> list[MethodFit]:
    settings = FitSettings(horizon=10, u_max=1.0)
    problem = fit_problem(cart(), [noisy_trial(21, 0.0)], settings)
    gain = evaluate_method(fit(problem, "feedback_gain"), problem.bounds)
    none = replace(
        gain.estimate, method="inverse_lqr_lmi", K=None, S=None, reason="it was not tried"
    )
    return [gain, evaluate_method(none, problem.bounds)]


def test_the_three_say_the_same(fits: list[MethodFit]) -> None:
    finding = methods_finding(fits)
    assert finding.table is not None
    numbers = list(csv.DictReader(io.StringIO(csv_bytes(finding.table).decode())))
    data = json.loads(json_bytes(methods_data(fits)))
    assert list(data) == ["feedback_gain", "inverse_lqr_lmi"] == [row["name"] for row in numbers]
    output = fits[0].estimate.problem.plant.outputs[0]
    share = data["feedback_gain"]["vaf"][output]
    assert float(numbers[0][f"vaf_{output}"]) == share
    assert finding.rows[0][1] == f"{share:.4g}"
    assert finding.rows[0][0].lower() == METHODS["feedback_gain"].label
    assert (numbers[1][f"vaf_{output}"], data["inverse_lqr_lmi"]["vaf"]) == ("", {output: None})
    assert numbers[1]["note"] == "it was not tried"


def test_columns_without_a_number_are_not_shown(fits: list[MethodFit]) -> None:
    output = fits[0].estimate.problem.plant.outputs[0]
    assert f"held_out_vaf_{output}" not in methods_finding(fits).shown
    assert f"vaf_{output}" in methods_finding(fits).shown
    left = [replace(fits[0], held_out=np.array([[50.0], [60.0]]))]
    table = methods_finding(left)
    assert float(table.rows[0][table.shown.index(f"held_out_vaf_{output}")]) == 55
    assert f"vaf_{output}" not in table.shown  # left-out trials replace it
    assert table.table is not None
    assert "note" not in table.table


def test_an_assessment_more_is_a_column_more(
    fits: list[MethodFit], monkeypatch: pytest.MonkeyPatch
) -> None:
    count = Assessment(
        "trials", "That were simulated.", lambda _: ("",),
        lambda fit: np.array([float(len(fit.runs)) if fit.runs else np.nan]),
    )  # fmt: skip
    monkeypatch.setitem(ASSESSMENTS, "trials", count)
    found = methods_finding(fits)
    assert float(found.rows[0][found.shown.index("trials")]) == 1
    assert methods_data(fits)["feedback_gain"]["trials"] == 1


def test_a_run_that_falls_has_numbers_only_as_far_as_it_got(example_plant: Plant) -> None:
    bounds = Bounds(example_plant, u_min=-1, u_max=1)
    law = Controller(example_plant, Weights(np.eye(2), 1), bounds, 3, terminal_set=False)
    run = simulate(law, scenario(example_plant, [50.0, 50.0], 400))
    y, u = until_its_end(example_plant, run)
    end = run.reached
    assert 0 < end < 400
    assert len(y) == len(u) == 401
    np.testing.assert_array_equal(y[: end + 1], (run.x @ example_plant.C.T)[: end + 1])
    np.testing.assert_array_equal(u[:end], run.u[:end])
    assert np.all(np.isnan(y[end + 1 :]))
    assert np.all(np.isnan(u[end:]))
