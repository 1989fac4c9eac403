"""Report of the example: table, page and result.json."""

from __future__ import annotations

import html
import json
import re
from typing import Any

import numpy as np
import pytest

from impc.assess.assessments import MethodFit
from impc.checking import replace
from impc.levels import Level
from impc.model.plant import Plant
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights
from impc.reporting.document import json_bytes
from impc.reporting.provenance import Provenance
from impc.studies.example.cases import CASES, EXAMPLE, CaseResult
from impc.studies.example.report import RULES, Facts, example_data, example_report


@pytest.fixture(scope="module")
def provenance() -> Provenance:
    return Provenance("plants:yalmip_example", "impc example --case A")


def test_result_json_holds_the_numbers_of_an_independent_computation(
    case_a: CaseResult, provenance: Provenance
) -> None:
    content = json.loads(json_bytes(example_data([case_a], provenance)))
    case = content["cases"]["A"]
    assert tuple(case["x0"]) == CASES["A"]
    assert list(case["methods"]) == list(EXAMPLE)
    A, B = np.array(content["plant"]["A"]), np.array(content["plant"]["B"])
    x, u = np.array(case["truth"]["x"]), np.array(case["truth"]["u"])
    assert x.shape == (21, 2)
    assert u.shape == (20, 1)
    np.testing.assert_allclose(x[1:], x[:-1] @ A.T + u @ B.T, atol=1e-12)
    for method in case["methods"].values():
        if method["K"] is None:  # the LMI is infeasible
            assert not {"x", "u"} & set(method)
            continue
        largest = list(method["largest_input"].values())
        assert largest == [pytest.approx(np.max(np.abs(method["u"])))]
        run = np.array(method["x"])
        assert method["misfit"] == pytest.approx(np.linalg.norm(run - x), abs=1e-12)
        if method["Q"] is not None:
            check_weights(case_a.controller.plant, method)


def check_weights(plant: Plant, method: dict[str, Any]) -> None:
    Q, R = np.array(method["Q"]), np.array(method["R"])
    np.testing.assert_allclose(solve_lqr(plant, Weights(Q, R)).K, method["K"], atol=1e-8)
    distance = np.hypot(np.linalg.norm(Q - np.eye(2)), R[0, 0] - 1)
    assert method["distance"] == pytest.approx(distance, abs=1e-12)


def test_the_page_says_who_stays_within_the_limit(
    case_a: CaseResult, provenance: Provenance
) -> None:
    report = example_report([case_a], provenance)
    assert (report.verdict.level, report.verdict.words) == (Level.GREEN, "As expected")
    assert "two need no more than the limit" in report.verdict.headline
    assert [key.value for key in report.keys] == ["7", "2", "2"]
    assert "up to 1.23" in report.verdict.sentence
    main = report.page().partition("<main")[2].partition("</main>")[0]
    page = html.unescape(re.sub("<[^>]*>", "", main))
    assert page.index("impc inspect trial_1.csv") < page.index("impc fit trial_*.csv")
    assert not re.search(r"\((\d\.\d+|[Tt]able)", page)  # no numbers of the dissertation
    assert 'class="badge big green' in main
    assert "The movement is simulated." in page
    files = report.files(pdf=True)
    assert files["figures/comparison-case-A.svg"].lstrip().startswith(b"<?xml")
    assert files["figures/comparison-case-A.pdf"].startswith(b"%PDF")


def test_another_method_within_the_limit_is_counted(case_a: CaseResult) -> None:
    methods = tuple(
        replace(item, exceeded=0.0) if item.name == "feedback_gain" else item
        for item in case_a.methods
    )
    verdict = RULES.verdict(Facts([replace(case_a, methods=methods), case_a]))
    assert "two need" in verdict.headline  # of all cases
    assert "three need" in RULES.verdict(Facts([replace(case_a, methods=methods)])).headline


def test_an_example_that_finds_nothing_says_so_in_a_box(case_a: CaseResult) -> None:
    def without_weights(item: MethodFit) -> MethodFit:
        return replace(item, estimate=replace(item.estimate, weights=None))

    methods = tuple(map(without_weights, case_a.methods))
    verdict = RULES.verdict(Facts([replace(case_a, methods=methods)]))
    assert verdict.level is Level.AMBER
    assert verdict.alerts[0].found.startswith("No method finds the true cost weights")
