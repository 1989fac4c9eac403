"""Report of a comparison for methods that complete or stop early."""

from __future__ import annotations

import html
import json
import re

import numpy as np
import pandas as pd
import pytest
from matplotlib.text import Text

from impc.assess.assessments import MethodFit
from impc.checking import replace
from impc.control.controller import Controller
from impc.inverse.problem import Problem
from impc.levels import Level
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.weights import Weights
from impc.reporting.document import Checks, Copy, Report
from impc.reporting.provenance import Provenance
from impc.reporting.rendering import number
from impc.reporting.style import page_style
from impc.studies.compare.report import compare_report
from impc.studies.compare.subject import compare_recordings
from impc.studies.methods_figure import by_score, methods_figure
from impc.studies.methods_table import methods_finding
from plants import yalmip_example

PROVENANCE = Provenance("plants:yalmip_example", "impc compare", files=("a.csv", "b.csv"))


@pytest.fixture(scope="module")
def problem() -> Problem:
    plant = Plant(yalmip_example(), units={"u": "N m"}, words={"u": "commanded torque"})
    bounds = Bounds(plant, u_min=-1, u_max=1)
    law = Controller(plant, Weights([[1, 0], [0, 1]], 1), bounds, 3)
    trials = [Recording(plant, law.simulate(x0, 20).x) for x0 in ([1, 3], [2, 3])]
    return Problem(plant, bounds, 3, trials)


@pytest.fixture(scope="module")
def compared(problem: Problem) -> tuple[MethodFit, ...]:
    return compare_recordings(problem, 0.0)


def shown(report: Report) -> str:
    main = report.page().partition("<main")[2].partition("</main>")[0]
    main = re.sub("<(svg|script).*?</(svg|script)>", "", main, flags=re.DOTALL)
    return html.unescape(re.sub("<[^>]*>", "", main)).replace("\u00a0", " ")


def changed(fits: tuple[MethodFit, ...], name: str, **fields: object) -> tuple[MethodFit, ...]:
    return tuple(replace(fit, **fields) if fit.name == name else fit for fit in fits)


def test_what_is_left_unexplained_without_the_limit(
    problem: Problem, compared: tuple[MethodFit, ...]
) -> None:
    report = compare_report(problem, compared, PROVENANCE)
    verdict = report.verdict
    assert verdict.level is Level.GREEN
    best, other = by_score(compared)[0], next(f for f in by_score(compared) if not f.keeps_bounds)
    assert np.mean(100 - other.held_out) > 1000 * np.mean(100 - best.held_out)
    assert verdict.headline == (
        "Without the torque limit of 1 N m, over 1000 times as much variance is left "
        f"unexplained, and {number(other.largest_input[0])} N m would be needed."
    )
    fitted = sum(fit.estimate.K is not None for fit in compared)
    assert fitted < len(compared)  # no recorded commands, and no weights with the gain
    assert report.meta[1] == f"{fitted} of {len(compared)} methods fitted"
    assert isinstance(report.copy, Copy)
    assert report.copy.methods.startswith(f"{fitted} models were fitted to 2 trials")
    assert "Recorded commands are needed: these files have none." in shown(report)
    assert report.keys[0].value == f"{np.mean(best.held_out):.2f}"
    lead = np.mean(best.held_out) - np.mean(other.held_out)
    assert float(report.keys[1].value) == pytest.approx(lead, rel=5e-3)
    assert float(report.keys[2].value) == pytest.approx(other.largest_input[0], rel=5e-3)
    assert isinstance(report.copy, Copy)
    assert f"{np.mean(other.held_out):.2f} %" in report.copy.results
    assert any("torque limit matters" in claim.text for claim in verdict.may)
    assert not re.search(r"\((\d\.\d+\)|Table)", shown(report))


def test_files_say_what_the_page_says(problem: Problem, compared: tuple[MethodFit, ...]) -> None:
    report = compare_report(problem, compared, PROVENANCE)
    files = report.files()
    found = json.loads(files["result.json"])
    assert found["verdict"]["headline"] == report.verdict.headline
    assert list(found["methods"]) == [fit.name for fit in compared]
    assert {"methods.csv", "long.csv", "trajectories.csv", "results.mat"} < set(files)
    assert "figures/comparison.svg" in files
    (table,) = [one.table for one in report.beside if one.name == "trajectories"]
    assert table is not None
    assert list(table["trial"].unique()) == ["a.csv", "b.csv"]
    assert "x1_inverse_mpc" in table.columns
    assert max(map(len, methods_finding(compared).text().splitlines())) <= 100


def test_a_model_that_falls_has_no_number(
    problem: Problem, compared: tuple[MethodFit, ...]
) -> None:
    nothing = np.full(2, np.nan)
    fell = changed(compared, "feedback_gain", fell=(5.14, None), vaf=nothing,
                   held_out=np.full((2, 2), np.nan))  # fmt: skip
    assert by_score(fell)[-1].name == "feedback_gain"
    table = methods_finding(fell).table
    assert isinstance(table, pd.DataFrame)
    row = table.set_index("name").loc["feedback_gain"]
    assert row["first_fall"] == 5.14
    assert row[["vaf_x1", "held_out_vaf_x1", "largest_input_u", "beyond_bound"]].isna().all()
    figure = methods_figure(fell)
    texts = [text.get_text() for ax in figure.axes for text in ax.texts]
    assert "stops at 5.1 s" in texts
    assert len(figure.axes[1].containers) == len(by_score(fell)) - 1
    report = compare_report(problem, fell, PROVENANCE)
    assert "stops at 5.1 s" in shown(report)


@pytest.mark.parametrize("largest", [1.2, 29.8])
def test_nothing_of_the_figure_is_cut(compared: tuple[MethodFit, ...], largest: float) -> None:
    fits = []
    for fit in changed(compared, "feedback_gain", largest_input=np.array([largest])):
        problem = fit.estimate.problem
        plant = replace(problem.plant, units=(("u", "N m"),))
        estimate = replace(fit.estimate, problem=replace(problem, plant=plant))
        fits.append(replace(fit, estimate=estimate))
    with page_style():
        figure = methods_figure(fits)
        figure.draw_without_rendering()
        ticks = [tick for ax in figure.axes for tick in ax.get_xticklabels()]
        texts = [one for one in figure.findobj(Text) if one.get_text() and one not in ticks]
        ends = np.array([text.get_window_extent().extents for text in texts])
    assert any("(N m)" in text.get_text() for text in texts)
    assert np.all(ends[:, :2] >= -1)
    assert np.all(ends[:, 2:] <= np.array(figure.bbox.max) + 1)


def test_when_all_fall_nothing_is_said(problem: Problem, compared: tuple[MethodFit, ...]) -> None:
    nothing = np.full((2, 2), np.nan)
    fell = tuple(
        replace(fit, fell=(2.0, 3.2), vaf=nothing[0], held_out=nothing) for fit in compared
    )
    report = compare_report(problem, fell, PROVENANCE)
    assert report.verdict.level is Level.RED
    assert not report.keys
    assert isinstance(report.copy, str)
    assert report.page()


def test_a_best_model_beyond_the_limit_is_amber(
    problem: Problem, compared: tuple[MethodFit, ...]
) -> None:
    poor = np.full((2, 2), 90.0)
    others = tuple(
        fit if fit.name == "feedback_gain" else replace(fit, held_out=poor, vaf=poor[0])
        for fit in compared
    )
    best = changed(others, "feedback_gain", held_out=np.full((2, 2), 99.0), vaf=np.full(2, 99.0))
    report = compare_report(problem, best, PROVENANCE)
    assert report.verdict.level is Level.AMBER
    assert "needs more than 1 N m" in report.verdict.headline
    assert "unknown_limit" in report.verdict.alerts[0].todo[0]
    assert "N m; the limit was given as 1 N m" in report.verdict.alerts[0].found
    assert isinstance(report.copy, Copy)
    assert "best model with the limit explained 90.00 %" in report.copy.results


@pytest.mark.parametrize(
    ("kept", "free", "keep_all", "headline"),
    [
        (98.0, 96.0, False, "Without the torque limit of 1 N m, 2 times as much variance"),
        (99.0, 99.0, False, "Models without the torque limit explain as much"),
        (98.0, 96.0, True, "No model needs more than 1 N m: the torque limit does not matter"),
    ],
)
def test_a_limit_matters_if_without_it_less_is_explained_and_more_needed(
    problem: Problem, compared: tuple[MethodFit, ...],
    kept: float, free: float, keep_all: bool, headline: str,
) -> None:  # fmt: skip
    fits = []
    for fit in compared:
        score = np.full((2, 2), kept if fit.keeps_bounds else free)
        exceeded = 0.0 if keep_all else fit.exceeded
        fits.append(replace(fit, held_out=score, vaf=score[0], exceeded=exceeded))
    verdict = compare_report(problem, fits, PROVENANCE).verdict
    assert verdict.headline.startswith(headline)
    matters = any("matters" in claim.text for claim in verdict.may)
    assert matters is headline.startswith("Without")


def test_without_trials_left_out_nothing_is_said_of_prediction(
    problem: Problem, compared: tuple[MethodFit, ...]
) -> None:
    whole = tuple(replace(fit, held_out=np.empty((0, 2))) for fit in compared)
    report = compare_report(problem, whole, PROVENANCE)
    assert any("predict" in claim.text for claim in report.verdict.may_not)
    (section,) = [one for one in report.sections if one.title == "Checks"]
    checks = section.blocks[0]
    assert isinstance(checks, Checks)
    levels = {check.name: check.level for check in checks.checks}
    assert levels["Left-out trials"] is Level.NOTE
    assert levels["Simulations"] is Level.GREEN
