"""Competing sensorimotor models: stored when interrupted, report section, result.json."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

import impc
from impc.arrays import frozen
from impc.output_feedback import doubts
from impc.output_feedback.fit import OutputFeedbackFit
from impc.output_feedback.intervals import person_covariance
from impc.output_feedback.models import (
    PersonReport,
    asked_observer,
    person_report,
    prediction_errors,
)
from impc.reporting.document import Fold, Section
from impc.reporting.finding import Finding
from impc.reporting.rendering import plain
from impc.studies.fit.first import FitProgress
from impc.studies.fit.memory import open_memory
from impc.studies.fit.settings import fit_settings
from impc.studies.fit.subject import fit_recordings, stages
from tests.inverse.test_structured_fit import late_body, late_problem
from tests.output_feedback import fits
from tests.output_feedback.fits import cart, fitted, least_squares, posed
from tests.output_feedback.test_fit import check_stored
from tests.support import kept_names, present

pytestmark = pytest.mark.full

TABLE: dict[str, Any] = {
    "horizon": 5,
    "u_max": 0.9,
    "methods": [],
    "held_out": False,
    "intent_draws": False,
    "observer": {"sensed": ["x", "v"]},
}


@functools.cache
def trials() -> list[impc.Recording]:
    """A subject whose sensory noise is half the size of the movement."""
    return fits.trials(
        impc.Observer(cart(), ["x", "v"], motor=0.05, sensory=[0.05, 0.1]), 0.002, 0.9
    )


@functools.cache
def reported(*, profiles: bool = False) -> tuple[PersonReport, list[str]]:
    """The report, and the stages of the fit."""
    settings = fit_settings(TABLE | {"observer": {"sensed": ["x", "v"], "profiles": profiles}})
    without = fit_settings({key: item for key, item in TABLE.items() if key != "observer"})
    problem, heard = impc.fit_problem(cart(), trials(), settings), list[str]()
    report = present(fit_recordings(problem, settings, FitProgress(heard.append)).person)
    assert tuple(heard) == stages(problem, settings)
    assert len(heard) - len(stages(problem, without)) == len(report.models) + 1
    return report, heard


def report_and_fit() -> tuple[PersonReport, OutputFeedbackFit]:
    report, _ = reported()
    return report, present(report.fit)


def findings(section: Section) -> dict[str, Finding]:
    """Findings of a section, including folded ones."""
    inside = [one.blocks if isinstance(one, Fold) else [one] for one in section.blocks]
    return {one.name: one for part in inside for one in part if isinstance(one, Finding)}


def test_errors_ahead_are_those_that_the_filter_expects() -> None:
    """One sample ahead they are the innovations; far ahead they grow to the noise in the loop."""
    fit = fitted("vague")
    errors = prediction_errors(fit, (1, 5, 20))
    identified = np.concatenate([trial.innovations for trial in fit.identified.trials])
    # A hundred starts in each of two trials: 5 % of a deviation, twice.
    np.testing.assert_allclose(errors[0], np.sqrt(np.mean(identified**2, axis=0)), rtol=0.12)
    assert errors[0] < errors[1] < errors[2]


def test_without_limit_and_perturbation_there_are_three_models() -> None:
    person = impc.Observer(cart(), ["x"], motor=0.15, sensory=0.02)
    report = person_report(impc.fit(posed(person, 0.01, np.inf, 1)), person, np.zeros(0))
    assert [item.name for item in report.models] == [
        "estimates, perturbation known",
        "sees every state, noise in the loop",
        "sees every state, noise in the recorder alone",
    ]
    # Recording noise alone is the special case of noise in the loop without motor noise.
    _, loop, quiet = (item.fit for item in report.models)
    assert loop is not None
    assert quiet is not None
    assert loop.log_likelihood > quiet.log_likelihood
    assert loop.count == quiet.count + 1


def test_who_cannot_estimate_has_a_reason() -> None:
    asked = impc.Observer(cart(), ["v"], motor=0.15, sensory=0.02)
    problem = posed(impc.Observer(cart()), 0.01, np.inf, 1)
    report = person_report(impc.fit(problem), asked, np.zeros(0))
    assert report.models[0].fit is None
    assert "no stationary Kalman filter" in report.models[0].reason
    assert report.covariance is None
    assert report.models[0].reason in report.sentences()[0]
    assert report.data().keys() == {"models"}


def test_a_structure_is_set_beside_any_gain() -> None:
    """Behind a delay: the same recordings, with fewer unknowns and hardly less likelihood."""
    problem = late_problem(structure=impc.Structure(late_body(), ["p", "v"]))
    person = impc.Observer(problem.plant, ["p", "v"], motor=0.1, sensory=[0.02, 0.02])
    report = person_report(impc.fit(problem), person, np.zeros(0))
    found = {item.name: item.fit for item in report.models}
    kept, free = report.fit, found["estimates, perturbation known, any gain"]
    assert kept is not None
    assert free is not None
    assert free.count == kept.count + 3
    # Twice their difference is chi-squared of three, .5 for what is not the largest to the end.
    assert -0.5 < free.log_likelihood - kept.log_likelihood < 6
    assert np.all(present(report.covariance).entries < person_covariance(free).entries)
    check_stored(kept)


def test_persons_of_an_interrupted_fit_are_not_fitted_again(tmp_path: Path) -> None:
    """`test_subject.py` has checkpoints of the other parts of a fit."""
    person, found = least_squares("limited")
    settings = impc.FitSettings(horizon=5, u_max=0.9)
    stopped = "sees every state, noise in the loop"

    def interrupt(name: str) -> None:
        if name == stopped:
            raise KeyboardInterrupt

    whole = person_report(found, person, np.zeros(0))
    memory = open_memory(tmp_path, found.problem, settings)
    with pytest.raises(KeyboardInterrupt):
        person_report(found, person, np.zeros(0), done=interrupt, remember=memory.get)
    again, names = (
        open_memory(tmp_path, found.problem, settings),
        [one.name for one in whole.models],
    )
    assert kept_names(again) == set(names[: names.index(stopped) + 1]) < set(names)
    report = person_report(found, person, np.zeros(0), remember=again.get)
    np.testing.assert_array_equal(report.entries, whole.entries)
    np.testing.assert_array_equal(report.levels, whole.levels)
    assert [one.criterion for one in report.models] == [one.criterion for one in whole.models]


def test_who_senses_with_noise_is_preferred_to_who_sees_all() -> None:
    report, fit = report_and_fit()
    criteria = {item.name: item.criterion for item in report.models}
    asked, first = report.models[0].name, report.models[0]
    assert asked == "estimates, perturbation known"
    assert criteria[asked] < criteria["sees every state, noise in the loop"] - 10
    assert criteria[asked] < criteria["sees every state, noise in the recorder alone"] - 100
    undecided = f"The recordings do not decide between the models “{asked}” and “{asked}, no limit”"
    assert report.sentences()[0] == f"{undecided} (AIC differs by 0.0)."
    assert report.preferred
    unsettled = impc.replace(first, fit=impc.replace(fit, converged=False))
    for other in (unsettled, impc.replace(first, fit=None)):
        assert not impc.replace(report, models=(other, *report.models[1:])).preferred
    alone = impc.replace(report, models=(first,)).sentences()[0]
    assert alone == "No other model of sensing could be fitted for comparison."
    best = impc.replace(report.models[1], fit=impc.replace(fit, log_likelihood=1e6))
    beaten = impc.replace(report, models=(first, best))
    assert not beaten.preferred
    assert f"“{best.name}” explains" in beaten.sentences()[0]


def test_what_is_said_of_gains_noise_and_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    report, fit = report_and_fit()

    def said(intervals: list[list[float]], *, loose: bool = False) -> str:
        settled = impc.replace(fit, converged=not loose)
        return " ".join(impc.replace(report, entries=np.array(intervals), fit=settled).sentences())

    both, one = [[1.0, 2.0], [-2.0, -1.0]], [[1.0, 2.0], [-1.0, 3.0]]
    assert "of 2 of 2 gains" in said(both)
    assert "of 1 of 2 gains" in said(one)
    # By profile an entry that is not individually identified has no interval.
    assert "of 0 of 2 gains" in said([[np.nan, np.nan], [-1.0, np.inf]])
    assert "did not converge" in said(both, loose=True)
    assert not any("80 to 95 %" in line for line in report.sentences())
    terms = fit.identified
    limited = [
        one._replace(status=np.full_like(one.status, impc.Status.ACTIVE)) for one in terms.trials
    ]
    met = impc.replace(
        report, fit=impc.replace(fit, identified=impc.replace(terms, trials=limited))
    )
    assert any("80 to 95 %" in line for line in met.sentences())
    assert met.data()["at_limit"] is True
    monkeypatch.setattr(doubts, "confusion", lambda _: 0.95)
    assert report.sentences()[-1] == (
        "Gain and noise can hardly be separated here (correlation 0.95)."
    )


def test_a_model_whose_prediction_errors_are_not_white_is_doubted() -> None:
    """In Python and on the page."""
    report, fit = report_and_fit()
    assert fit.doubts == ()
    terms = fit.identified
    summed = [one._replace(innovations=np.cumsum(one.innovations, axis=0)) for one in terms.trials]
    wrong = impc.replace(fit, identified=impc.replace(terms, trials=summed))
    doubt, *_ = wrong.doubts
    assert doubt.startswith("Prediction errors of x are autocorrelated: the model is incomplete")
    assert doubt in impc.replace(report, fit=wrong).sentences()
    assert "did not converge" in impc.replace(fit, converged=False).doubts[0]


def test_the_section_and_result_json_have_the_same_numbers() -> None:
    report, fit = report_and_fit()
    found = findings(report.section())
    sizes = {name: len(one.rows) for name, one in found.items()}
    assert sizes == {"person_gain": 2, "person_levels": 4, "person_models": 5}
    kept = json.loads(json.dumps(plain(report.data())))
    rows = found["person_models"].rows
    assert [item["name"] for item in kept["models"]] == [row[0] for row in rows]
    level = kept["levels"]["motor u"]
    assert level["low"] < level["value"] < level["high"]
    assert (kept["known"], kept["at_limit"], kept["sensed"]) == (True, False, ["x", "v"])
    assert np.array(kept["errors_ahead"]).shape == (len(kept["ahead"]), 1)
    np.testing.assert_allclose(kept["K"], fit.K)
    table = present(found["person_gain"].table)
    np.testing.assert_allclose([table["maximum_likelihood"]], kept["K"])  # no angles
    np.testing.assert_allclose(table[["low", "high"]], kept["K_intervals"][0])


def test_intervals_follow_the_likelihood_where_asked() -> None:
    (report, heard), (rough, others) = reported(profiles=True), reported()
    assert (heard, report.profiled, rough.profiled) == (others, True, False)
    fit, covariance = rough.fit, rough.covariance
    assert fit is not None
    assert covariance is not None
    about = np.asarray(fit.K)[..., None] + 1.959964 * covariance.entries[..., None] * [-1, 1]
    np.testing.assert_allclose(rough.data()["K_intervals"], about, rtol=1e-6)
    # The gain is well identified: ends are within half a width of the sandwich intervals.
    width = np.ptp(about, axis=-1, keepdims=True)
    assert np.all(np.abs((report.data()["K_intervals"] - about) / width) < 0.5)
    assert "profile likelihood" not in findings(rough.section())["person_gain"].caption
    assert "profile likelihood" in findings(report.section())["person_gain"].caption


@pytest.mark.parametrize(
    ("ends", "words"),
    [
        ([-np.inf, 2.5], ["not determined", "2.50"]),
        ([np.nan, np.nan], ["-", "-"]),
        ([2.5, 3.5], ["2.50", "3.50"]),
    ],
)
def test_an_interval_without_end_says_so(ends: list[float], words: list[str]) -> None:
    found = findings(impc.replace(reported()[0], entries=frozen([ends, ends])).section())
    assert [row[2:4] for row in found["person_gain"].rows] == [words, words]


def test_settings_of_a_person() -> None:
    table = {"observer": {"sensed": ["x"], "known": False, "share": True, "motor": False}}
    asked = present(fit_settings(table).observer)
    given = msgspec.structs.asdict(asked)
    del given["profiles"]
    person, walk = asked_observer(cart(), trials(), **given)
    # A push of one of three sizes every tenth sample: steps of .7 or 1.4, most of them none.
    np.testing.assert_allclose(walk, present(person.walk))
    assert 0.1 < walk[0] < 0.7
    assert person.motor[0] == 0 < person.share[0]
    assert impc.FitSettings().observer is None
