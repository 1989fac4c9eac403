"""Verdict of a fit: statements, warnings, page and figures."""

from __future__ import annotations

import re
from functools import cache
from types import SimpleNamespace
from typing import Any

import control
import numpy as np
import pytest

import impc
from impc.assess.lack_of_fit import LackOfFit, ModelError
from impc.files.plant_sources import plant_source
from impc.inverse.minimiser import Ended
from impc.levels import Level
from impc.reporting.document import Copy
from impc.reporting.provenance import Provenance
from impc.reporting.shown_units import angles_in
from impc.reporting.style import VERMILLION, page_style
from impc.studies.charts import trajectories
from impc.studies.fit.body_words import added_sentence, remedy_words
from impc.studies.fit.facts import named_gains
from impc.studies.fit.figures import movement_figure, shown_window, statements_figure
from impc.studies.fit.first import FitProgress
from impc.studies.fit.report import fallen_report, fit_report
from impc.studies.fit.result import FitResult, FittedParameter
from impc.studies.fit.settings import missing
from impc.studies.fit.subject import fit_recordings, stages
from impc.studies.fit.verdict import GAIN, RULES, WEIGHTS
from tests.support import regulator

SEED = 20264


@cache
def fitted(limit: float) -> FitResult:
    """A perturbed cart with little recording noise and a limited command."""
    cart = control.ss([[0, 1], [0, 0]], [[0, 0], [1, 1]], [[1, 0]], 0, states=["place", "speed"],
                      inputs=["pull", "push"], outputs=["place"])  # fmt: skip
    units = {"place": "m", "speed": "m/s", "pull": "m/s^2", "push": "m/s^2"}
    words = {"place": "place of the cart", "pull": "pull of the rope"}
    plant = impc.Plant(control.c2d(cart, 0.1), ["pull"], units, words)
    law = regulator(plant, np.diag([4.0, 1.0]), 1, 5, terminal_set=True)
    rng = np.random.default_rng(SEED)
    push = 1.2 * np.repeat(rng.choice([-1.0, 0.0, 1.0], 30), 5)[:, None]
    outputs = law.simulate([0.0, 0.0], disturbance=push).outputs[:-1]
    outputs = outputs + 0.005 * rng.standard_normal(outputs.shape)
    settings = impc.FitSettings(u_max=limit, horizon=5, methods=["inverse_lqr_output"])
    heard: list[str] = []
    problem = impc.fit_problem(plant, [impc.Recording(plant, outputs, push)], settings)
    result = fit_recordings(problem, settings, FitProgress(heard.append))
    assert tuple(heard) == stages(problem, settings)
    return result


def explained(limit: float = 1.0) -> FitResult:
    """A fit without warnings; the result of the model test is dropped."""
    return impc.replace(fitted(limit), lack=(None,))


def model_error(name: str = "delay", size: float = 1.0, deviation: float = 0.1) -> LackOfFit:
    """A test of the model that points to one error."""
    return LackOfFit((ModelError(name, 1e-5, 11.5, size, deviation),), alarm=True, untestable=())


def test_a_fit_that_nothing_speaks_against() -> None:
    result = explained()
    assert not len(result.inverse_mpc.held_out)  # of a single trial
    verdict = RULES.verdict(result)
    assert (verdict.level, list(verdict.alerts)) == (Level.GREEN, [])
    assert "1 m/s^2 explains this movement" in verdict.headline
    share = f"{100 * result.trials[0].saturated:.1f} %"
    assert any(share in claim.why for claim in verdict.may)
    report = fit_report(result, Provenance())
    assert isinstance(report.copy, Copy)
    assert share in report.copy.results
    for row in (row for _, row in named_gains(result) if row.determined):
        assert row.ends in report.copy.results
        summary = report.data["summary"]
        assert summary[f"gain{row.interval.name[1:]}"] == row.value
    assert max(map(len, verdict.text().splitlines())) <= 100


def test_an_error_of_the_model_forbids_gains() -> None:
    result = impc.replace(fitted(1.0), lack=(model_error(),))
    verdict = RULES.verdict(result)
    assert verdict.level is Level.AMBER
    assert "a delay of the command of 100 ± 10 ms (p < 0.0001)" in verdict.alerts[0].found
    assert RULES.forbidden(result) == {GAIN, WEIGHTS}
    assert not any("gain on" in claim.text for claim in verdict.may)
    report = fit_report(result, Provenance())
    assert isinstance(report.copy, Copy)
    assert "Gains are not reported: the residual depends" in report.copy.results
    summary = dict(report.data["summary"])
    assert summary["reason"] == verdict.alerts[0].title
    assert {one for name, one in summary.items() if re.search("^gain.*(?<!_unit)$", name)} == {None}
    page = report.page()
    # The numbers are only in a folded part that says so.
    assert "(do not report)" in page.partition('id="feedback-gain"')[2][:900]
    added = added_sentence(impc.replace(result, lack=(model_error(), None)))
    assert added.startswith("The residuals of a")


@pytest.mark.parametrize(
    ("name", "size", "words"),
    [
        ("shift.place", 1.0, "a time shift of the place of the cart"),
        ("shift.place", 1.0, "(it is recorded 100 ± 10 ms too late)"),
        ("shift.push", -0.4, "(it acts 40 ± 10 ms earlier than recorded)"),
        ("scale.place", -0.2, "an error of scale of the place of the cart (by -20 ± 10 %)"),
        ("offset.place", 0.02, "an offset of the place of the cart (p"),  # of one trial, in m
        ("clock.place", 1e-3, "a clock error of the place of the cart (by +0.1 ± 10 %)"),
        ("limit", 0.05, "another limit of the command, by +5.0 ± 10.0 %"),
    ],
)
def test_an_error_is_said_with_its_size(name: str, size: float, words: str) -> None:
    """At 10 samples/s, with a standard error of 0.1."""
    result = impc.replace(fitted(1.0), lack=(model_error(name, size),))
    assert words in RULES.verdict(result).alerts[0].found


def test_a_corrected_error_is_said_with_its_remedy() -> None:
    problem = SimpleNamespace(fitted_errors=[("clock", "place", [-1e-4, -3e-4])])
    result: Any = SimpleNamespace(
        given=fitted(1.0).given, estimate=SimpleNamespace(problem=problem)
    )
    said = remedy_words(result, ModelError("clock.place", 1e-9, 20.0, -2e-4, 1e-5))
    assert said == (
        "Correct the place of the cart for a clock error of \u22120.02 %, in the file or at the "
        "device."
    )


@pytest.mark.parametrize(
    ("ended", "unconfirmed", "said"),
    [(Ended.STUCK, True, True), (Ended.STUCK, False, False), (Ended.CONVERGED, True, False)],
)
def test_an_unconfirmed_gain_at_no_minimum_is_said(
    ended: Ended, unconfirmed: bool, said: bool
) -> None:
    result = explained()
    fit = impc.replace(result.fitted, fit=impc.replace(result.fitted.fit, unconfirmed=unconfirmed))
    methods = (*result.methods[:-1], impc.replace(result.inverse_mpc, estimate=fit))
    result = impc.replace(
        result, methods=methods, estimate=impc.replace(result.estimate, ended=ended)
    )
    page = fit_report(result, Provenance()).page()
    assert ("did not end at a minimum, and no search from another start confirmed" in page) == said


@pytest.mark.full
def test_no_limit_and_a_limit_that_is_not_reached() -> None:
    for limit, words in ((np.inf, "no limit was given"), (50.0, "never reached")):
        verdict = RULES.verdict(explained(limit))
        assert verdict.level is Level.GREEN
        assert words in verdict.headline
        assert verdict.alerts[0].level is Level.NOTE


def test_a_fall_is_said_and_counted() -> None:
    falls = ("trial_2.csv: the subject fell at 5.1 s",)
    verdict = RULES.verdict(impc.replace(explained(), falls=falls))
    assert verdict.level is Level.AMBER
    assert "1 of 2 trials" in verdict.headline
    page = fallen_report(falls, Provenance()).page()
    assert "fell in every trial" in page
    assert "the subject fell at 5.1\u00a0s" in page


def test_a_limit_that_the_recordings_contradict() -> None:
    """A warning if the estimated limit is far from the given one, beyond its uncertainty."""
    low, result = model_error("limit", -0.3, 0.01), explained()
    added = impc.replace(result, lack=(low, None))
    names = tuple(result.given.plant.controls)
    for value, level in ((0.7, Level.AMBER), (1.002, Level.GREEN)):
        item = FittedParameter(f"u_max.{names[0]}", 1.0, value, 5e-4, 0.3, 0.0)
        found = RULES.verdict(impc.replace(added, parameters=(item,)))
        assert found.level is level
        assert ("probably wrong" in found.headline) == (level is Level.AMBER)
    close = FittedParameter(f"u_max.{names[0]}", 1.0, 0.95, 5e-4, 0.05, 0.0)
    assert RULES.verdict(impc.replace(result, parameters=(close,))).level is Level.GREEN
    # Not estimated, but the residuals of the last fit still point to it.
    doubted = RULES.verdict(impc.replace(result, lack=(low,)))
    assert any("u_max" in remedy for remedy in doubted.alerts[0].todo)
    assert not any("limit" in claim.text for claim in doubted.may)


def test_what_is_not_given_is_said_with_what_that_excludes() -> None:
    source = plant_source("plants:seated_balance_for", {"mass": 70.0})
    assert missing(impc.FitSettings(), source) == (
        "Not given: u_max: without a limit of the command, inverse MPC equals inverse LQR; "
        "the subject's own height: the gains assume height 1.66."
    )
    assert missing(impc.FitSettings(u_max=6.0, free=["height"]), source) == ""
    cursor = plant_source("plants:cursor_plant", {})
    assert missing(impc.FitSettings(u_max=6.0), cursor) == ""


def test_angles_are_shown_as_is_asked() -> None:
    """Units of angles in the figures of a fit."""
    result = fitted(1.0)
    turned = impc.replace(result.given.plant, units=(("place", "rad"), ("pull", "rad/s^2")))
    own = result.inverse_mpc
    problem = impc.replace(own.estimate.problem, plant=turned)
    shown = impc.replace(own, estimate=impc.replace(own.estimate, problem=problem))
    for angles, label, factor in (("degrees", "°", 180 / np.pi), ("radians", "rad", 1.0)):
        with angles_in(angles), page_style():
            ax = movement_figure(shown, 0).axes[0]
        assert ax.get_title(loc="left") == f"Place of the cart ({label})"
        line = next(line for line in ax.lines if line.get_label() == "recorded")
        window = shown_window(shown, 0)
        recorded = factor * result.given.recordings[0].outputs[window, 0]
        np.testing.assert_allclose(np.asarray(line.get_ydata()), recorded)


def test_a_single_sample_at_the_limit_is_seen() -> None:
    """A line of one sample draws nothing: it needs a marker."""
    own = fitted(1.0).inverse_mpc
    at_limit = [one for one in movement_figure(own, 0).axes[1].lines
                if one.get_color() == VERMILLION and one.get_linestyle() == "-"]  # fmt: skip
    assert at_limit
    assert all(one.get_marker() not in ("", "None") for one in at_limit)


def test_curves_of_the_page_are_those_of_the_fit() -> None:
    result = fitted(1.0)
    data = trajectories(result.given, result.methods[::-1], {0: "Trial 1"})
    assert data["curves"][0]["label"] == "recorded"
    (trial,) = data["trials"]
    place, pull = trial["panels"]
    assert (place["limits"], pull["limits"]) == ([], [-1, 1])
    recorded, run = result.given.recordings[0].outputs[:, 0], result.inverse_mpc.runs[0]
    # Curves are rounded to five digits.
    np.testing.assert_allclose(place["curves"][0], recorded, rtol=1e-4)
    np.testing.assert_allclose(place["curves"][1], run.x[:, 0][: len(recorded)], rtol=1e-4)
    assert pull["curves"][0] == [None] * len(recorded)
    np.testing.assert_allclose(pull["curves"][1][:-1], run.u[:, 0][: len(recorded) - 1], rtol=1e-4)
    assert len({len(one) for panel in trial["panels"] for one in panel["curves"]}) == 1


def test_bars_are_the_ranges_of_the_comparisons() -> None:
    result = fitted(1.0)
    (ax,) = statements_figure(result).axes
    shown = sorted(result.compared, key=lambda item: not item.made)
    ends = [np.asarray(line.get_xdata()) for line in ax.lines]
    np.testing.assert_allclose(
        [one for one in ends if np.ptp(one)][: len(shown)],
        [[item.low, item.high] for item in shown],
    )


def test_a_range_of_one_value_is_drawn() -> None:
    """With one output the first comparison is the same for all weights with the gain."""
    result = explained()
    at = [item.low for item in result.compared if item.high == pytest.approx(item.low)]
    (ax,) = statements_figure(result).axes
    marked = [line for line in ax.lines if line.get_marker() == "|"]
    assert [float(np.asarray(line.get_xdata())[0]) for line in marked] == at
    assert len(at) == 1


def test_weights_that_fit_as_well_forbid_a_gain_that_excludes_them() -> None:
    """Two trials of 15 s in a laboratory: 220 by standard errors, 24.7 by the likelihood."""
    result = explained()
    ours = impc.replace(
        result.weights_test, statistic=220.0, likelihood_ratio=24.7, freedom=10, p_value=0.006
    )
    found = RULES.verdict(impc.replace(result, weights_test=ours))
    assert found.level is Level.AMBER
    assert "less certain than its interval" in found.headline
    assert "(chi-squared 24.7)" in found.alerts[0].found
    assert {GAIN, WEIGHTS} <= RULES.forbidden(impc.replace(result, weights_test=ours))
    both = impc.replace(ours, likelihood_ratio=200.0, p_value=1e-9)
    rejected = impc.replace(result, weights_test=both)
    assert "no cost weights explain it" in RULES.verdict(rejected).headline
    assert GAIN not in RULES.forbidden(rejected)
