"""Rules of all verdicts, the table of methods, and the pages of an estimate and of `inspect`."""

from __future__ import annotations

import csv
import inspect
import io
import json
import re
from pathlib import Path
from string import Formatter
from typing import Any

import numpy as np
import pandas as pd
import pytest

import impc
from experiments.coverage import cart, noisy_trial
from impc.assess.assessments import ASSESSMENTS, Assessment, MethodFit, evaluate_method
from impc.cli.main import main
from impc.control.closed_loop import simulate
from impc.inverse.methods import METHODS
from impc.levels import Level
from impc.nonlinear import page
from impc.reporting.document import json_bytes
from impc.reporting.finding import csv_bytes
from impc.reporting.rules import Line, Rules
from impc.studies.compare import verdict as compare
from impc.studies.example import report as example
from impc.studies.example import sweep_report
from impc.studies.methods_table import methods_data, methods_finding, until_its_end
from impc.studies.plan import sentences as plan
from impc.studies.reliability import verdict as reliability
from impc.studies.selection.verdict import KEY_RULES, SELECT_RULES, KeyFacts, SelectFacts
from plants import yalmip_example
from tests.support import present

# Rules, and the class of their facts.
RULES: dict[str, tuple[Rules[Any], type]] = {
    "select": (SELECT_RULES, SelectFacts),
    "key-parameters": (KEY_RULES, KeyFacts),
    "reliability": (reliability.RULES, reliability.Facts),
    "compare": (compare.RULES, compare.Facts),
    "plan": (plan.RULES, plan.Facts),
    "example": (example.RULES, example.Facts),
    "sweep": (sweep_report.RULES, sweep_report.Facts),
    "optimal control": (page.RULES, page.OptimalFit),
}
BOTH = pytest.mark.parametrize(("rules", "facts"), RULES.values(), ids=RULES)


@BOTH
def test_an_amber_badge_has_its_reason_in_a_box(rules: Rules[Any], facts: type) -> None:
    for kind in rules.kinds:
        if kind.level is Level.AMBER:
            assert all((kind.title, kind.found, kind.means, kind.todo)), kind.headline


@BOTH
def test_every_word_of_a_template_is_known(rules: Rules[Any], facts: type) -> None:
    texts = [
        text
        for kind in rules.kinds
        for text in (kind.headline, kind.sentence, kind.title, kind.found, kind.means, *kind.todo)
    ]
    for row in (*rules.may, *rules.may_not):
        texts += [row.text, row.why] if isinstance(row, Line) else []
    used = {name for text in texts for _, name, _, _ in Formatter().parse(text) if name}
    own = {*dir(facts), *re.findall(r"self\.(\w+)", inspect.getsource(facts))}
    assert used <= own.union(rules.words), used - own.union(rules.words)


@pytest.fixture(scope="module")
def fits() -> list[MethodFit]:
    settings = impc.FitSettings(horizon=10, u_max=1.0)
    problem = impc.fit_problem(cart(), [noisy_trial(21, 0.0)], settings)
    gain = evaluate_method(impc.fit(problem, "feedback_gain"), problem.bounds)
    none = impc.replace(
        gain.estimate, method="inverse_lqr_lmi", K=None, S=None, reason="it was not tried"
    )
    return [gain, evaluate_method(none, problem.bounds)]


def test_the_three_say_the_same(fits: list[MethodFit]) -> None:
    finding = methods_finding(fits)
    numbers = list(csv.DictReader(io.StringIO(csv_bytes(present(finding.table)).decode())))
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
    left = [impc.replace(fits[0], held_out=np.array([[50.0], [60.0]]))]
    table = methods_finding(left)
    assert float(table.rows[0][table.shown.index(f"held_out_vaf_{output}")]) == 55
    assert f"vaf_{output}" not in table.shown  # left-out trials replace it
    assert "note" not in present(table.table)


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


def test_a_run_that_falls_has_numbers_only_as_far_as_it_got(example_plant: impc.Plant) -> None:
    bounds = impc.Bounds(example_plant, u_min=-1, u_max=1)
    law = impc.Controller(example_plant, impc.Weights(np.eye(2), 1), bounds, 3, terminal_set=False)
    run = simulate(law, impc.scenario(example_plant, [50.0, 50.0], 400))
    y, u = until_its_end(example_plant, run)
    end = run.reached
    assert 0 < end < 400
    assert len(y) == len(u) == 401
    np.testing.assert_array_equal(y[: end + 1], (run.x @ example_plant.C.T)[: end + 1])
    np.testing.assert_array_equal(u[:end], run.u[:end])
    assert np.all(np.isnan(y[end + 1 :]))
    assert np.all(np.isnan(u[end:]))


@pytest.fixture(scope="module")
def problem() -> impc.Problem:
    plant = impc.Plant(yalmip_example())
    bounds = impc.Bounds(plant, u_min=-1, u_max=1)
    law = impc.Controller(plant, impc.Weights([[1, 0], [0, 1]], 1), bounds, 3)
    return impc.Problem(plant, bounds, 3, [impc.Recording(plant, law.simulate([1, 3], 20).x)])


@pytest.fixture(scope="module")
def estimate(problem: impc.Problem) -> impc.Estimate:
    return impc.fit(problem)


def test_it_explains_and_says_what_is_missing(estimate: impc.Estimate, tmp_path: Path) -> None:
    names = {path.relative_to(tmp_path).as_posix() for path in impc.report(estimate, tmp_path)}
    assert {"report.html", "result.json", "gain.csv", "figures/trial-1.svg"} < names
    found = json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))
    assert found["verdict"]["level"] == "amber"  # neither intervals nor left-out trials
    assert "explains 100.00 %" in found["verdict"]["headline"]
    assert any("interval" in line for line in found["verdict"]["may_not_report"])
    gain = pd.read_csv(tmp_path / "gain.csv")["value"]
    np.testing.assert_allclose(gain, np.ravel(estimate.gain))


def test_a_method_that_knows_no_limit_is_said_to_know_none(
    problem: impc.Problem, estimate: impc.Estimate, tmp_path: Path
) -> None:
    impc.report(impc.fit(problem, "feedback_gain", start=estimate), tmp_path)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "1.23" in page
    assert '<span class="detail">no limit</span>' in page


def test_every_column_is_drawn_and_each_question_has_its_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    time = np.arange(900) / 100
    columns = {"Zeit [s]": time, "Sitz [Grad]": np.sin(time), "theta2 [deg]": np.cos(time),
               "<b>Stoß [N*m]": np.sign(np.sin(9 * time)),
               "Sync [V]": np.where((time >= 2) & (time < 2.1), 5.0, 0.0)}  # fmt: skip
    (tmp_path / "a.csv").write_text(pd.DataFrame(columns).to_csv(index=False), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    opened: list[str] = []
    monkeypatch.setattr("click.launch", opened.append)
    with pytest.raises(SystemExit) as ended:
        main(["inspect", "a.csv", "--plant", "seated-balance", "--open"])
    assert ended.value.code == 0
    assert opened == [str(Path("results/inspect/report.html"))]
    text = (tmp_path / "results/inspect/signals.csv").read_bytes().decode()
    table = pd.read_csv(io.StringIO(text)).fillna("").set_index("column")
    assert dict(table.taken_for) == {
        "Zeit": "time", "Sitz": "theta1", "theta2": "theta2", "<b>Stoß": "perturbation",
        "": "start of the trial", "Sync": "not used",
    }  # fmt: skip
    assert table.line_of_its_answer[""] == "[recording] start = 2"
    assert "gon" in table.question["Sitz"]
    assert table.question["theta2"] == ""
    assert table.line_of_its_answer["Sitz"] == '[signals.theta1] column = "Sitz", unit = "?"'
    page = opened and (tmp_path / opened[0]).read_text(encoding="utf-8")
    assert page
    assert "<b>Sto" not in page
    drawn = present(re.search(r'<script type="application/json"[^>]*>(.*?)</script>', page, re.S))
    (trial,) = json.loads(drawn[1])["trials"]
    assert trial["step"] == pytest.approx(0.01)
    for panel, values in zip(trial["panels"], list(columns.values())[1:], strict=True):
        np.testing.assert_allclose(panel["curves"][0], values, rtol=1e-4, atol=1e-9)
