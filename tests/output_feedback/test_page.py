"""Report of a fit with sensory noise: first sentences, tables, result.json."""

from __future__ import annotations

import functools
import json
from typing import Any

import msgspec
import numpy as np
import pytest

from impc.arrays import frozen
from impc.checking import replace
from impc.control.controller import Controller
from impc.control.simulation import Status
from impc.errors import InputError
from impc.model.bounds import Bounds
from impc.model.recordings import Recording
from impc.model.weights import Weights
from impc.output_feedback.models import asked_observer
from impc.output_feedback.observer import Observer
from impc.output_feedback.simulation import simulate_person
from impc.reporting.document import Fold, Section
from impc.reporting.finding import Finding
from impc.reporting.rendering import plain
from impc.studies.fit.result import FitResult
from impc.studies.fit.settings import FitSettings, fit_settings
from impc.studies.fit.subject import fit_problem, fit_recordings, stages
from tests.output_feedback.test_fit import cart

pytestmark = pytest.mark.full

TABLE: dict[str, Any] = {
    "horizon": 5,
    "u_max": 0.9,
    "methods": [],
    "held_out": False,
    "intent_draws": False,
    "observer": {"sensed": ["x", "v"]},
}


def trials() -> list[Recording]:
    """A subject whose sensory noise is half the size of the movement."""
    plant = cart()
    bounds = Bounds(plant, u_min=-0.9, u_max=0.9)
    law = Controller(plant, Weights(np.diag([8.0, 1.0]), 1), bounds, 5, terminal_set=False)
    person = Observer(plant, ["x", "v"], motor=0.05, sensory=[0.05, 0.1])
    rng, found = np.random.default_rng(3), []
    for seed in range(2):
        push = np.repeat(rng.choice([-0.7, 0.0, 0.7], 40), 10)
        outputs = simulate_person(law, person, push, recorder=0.002, seed=seed).outputs
        found.append(Recording(plant, outputs, push))
    return found


@functools.cache
def fitted() -> FitResult:
    settings = fit_settings(TABLE)
    return fit_recordings(fit_problem(cart(), trials(), settings), settings)


def test_who_senses_with_noise_is_preferred_to_who_sees_all() -> None:
    result = fitted()
    assert result.person is not None
    criteria = {item.name: item.fit.criterion for item in result.person.models if item.fit}
    asked = result.person.models[0].name
    assert asked == "estimates, perturbation known"
    assert criteria[asked] < criteria["sees every state, noise in the loop"] - 10
    assert criteria[asked] < criteria["sees every state, noise in the recorder alone"] - 100
    assert f"{asked}, no limit" in criteria
    assert f"“{asked}” or “{asked}, no limit” (AIC 0.0 apart)" in result.person.sentences()[0]


def findings(section: Section) -> dict[str, Finding]:
    """Findings of a section, including folded ones."""
    inside = [one.blocks if isinstance(one, Fold) else [one] for one in section.blocks]
    return {one.name: one for part in inside for one in part if isinstance(one, Finding)}


def test_it_is_said_how_many_gains_differ_from_zero() -> None:
    report = fitted().person
    assert report is not None
    assert report.fit is not None

    def said(intervals: list[list[float]], *, loose: bool = False) -> str:
        fit = replace(report.fit, converged=not loose)
        return replace(report, entries=np.array(intervals), fit=fit).sentences()[1]

    both, one = [[1.0, 2.0], [-2.0, -1.0]], [[1.0, 2.0], [-1.0, 3.0]]
    assert "of 2 of 2 gains" in said(both)
    assert "of 1 of 2 gains" in said(one)
    # By profile an entry that is not individually identified has no interval.
    assert "of 0 of 2 gains" in said([[np.nan, np.nan], [-1.0, np.inf]])
    assert "did not converge" in said(both, loose=True)


def test_the_section_and_result_json_have_the_same_numbers() -> None:
    result = fitted()
    assert result.person is not None
    found = findings(result.person.section())
    sizes = {name: len(one.rows) for name, one in found.items()}
    assert sizes == {"person_gain": 2, "person_levels": 4, "person_models": 5}
    kept = json.loads(json.dumps(plain(result.person.data())))
    rows = found["person_models"].rows
    assert [item["name"] for item in kept["models"]] == [row[0] for row in rows]
    level = kept["levels"]["motor u"]
    assert level["low"] < level["value"] < level["high"]
    assert kept["known"] is True
    assert kept["sensed"] == ["x", "v"]
    assert np.array(kept["errors_ahead"]).shape == (len(kept["ahead"]), 1)
    np.testing.assert_allclose(kept["K"], result.person.fit.K)  # type: ignore[union-attr]
    table = found["person_gain"].table
    assert table is not None
    np.testing.assert_allclose([table["maximum_likelihood"]], kept["K"])  # no angles
    np.testing.assert_allclose(table[["low", "high"]], kept["K_intervals"][0])
    assert kept["at_limit"] is False


def test_the_page_says_what_intervals_held_where_a_limit_was_met() -> None:
    result = fitted()
    assert result.person is not None
    assert not any("80 to 95 %" in line for line in result.person.sentences())
    fit = result.person.fit
    assert fit is not None
    limited = [
        one._replace(status=np.full_like(one.status, Status.ACTIVE))
        for one in fit.identified.trials
    ]
    met = replace(
        result.person, fit=replace(fit, identified=replace(fit.identified, trials=limited))
    )
    assert any("80 to 95 %" in line for line in met.sentences())
    assert met.data()["at_limit"] is True


def test_each_model_is_a_stage_and_intervals_follow_the_likelihood_where_asked() -> None:
    table = TABLE | {"observer": {"sensed": ["x", "v"], "profiles": True}}
    settings = fit_settings(table)
    without = fit_settings({key: item for key, item in TABLE.items() if key != "observer"})
    problem = fit_problem(cart(), trials(), settings)
    heard: list[str] = []
    result = fit_recordings(problem, settings, heard.append)
    quick = fitted()
    assert result.person is not None
    assert quick.person is not None
    assert len(heard) == stages(problem, settings)
    assert len(heard) - stages(problem, without) == len(result.person.models) + 1
    assert stages(problem, fit_settings(TABLE)) == len(heard)
    kept, rough = result.person.data(), quick.person.data()
    assert (kept["profiled"], rough["profiled"]) == (True, False)
    fit, covariance = quick.person.fit, quick.person.covariance
    assert fit is not None
    assert covariance is not None
    about = np.asarray(fit.K)[..., None] + 1.959964 * covariance.entries[..., None] * [-1, 1]
    np.testing.assert_allclose(rough["K_intervals"], about, rtol=1e-6)
    # The gain is well identified: ends are within half a width of the sandwich intervals.
    width = np.ptp(about, axis=-1, keepdims=True)
    assert np.all(np.abs((kept["K_intervals"] - about) / width) < 0.5)
    assert "profile likelihood" not in findings(quick.person.section())["person_gain"].caption
    assert "profile likelihood" in findings(result.person.section())["person_gain"].caption


def test_which_model_is_preferred() -> None:
    report = fitted().person
    assert report is not None
    assert report.fit is not None
    assert report.preferred
    unsettled = replace(report.models[0], fit=replace(report.fit, converged=False))
    for first in (unsettled, replace(unsettled, fit=None)):
        assert not replace(report, models=(first, *report.models[1:])).preferred
    best = replace(report.models[1], fit=replace(report.fit, log_likelihood=1e6))
    other = replace(report, models=(report.models[0], best))
    assert not other.preferred
    assert f"“{best.name}” explains" in other.sentences()[0]


@pytest.mark.parametrize(
    ("ends", "words"),
    [
        ([-np.inf, 2.5], ["not determined", "2.50"]),
        ([np.nan, np.nan], ["-", "-"]),
        ([2.5, 3.5], ["2.50", "3.50"]),
    ],
)
def test_an_interval_without_end_says_so(ends: list[float], words: list[str]) -> None:
    result = fitted()
    assert result.person is not None
    found = findings(replace(result.person, entries=frozen([ends, ends])).section())
    assert [row[2:4] for row in found["person_gain"].rows] == [words, words]


def test_settings_of_a_person() -> None:
    table = {"observer": {"sensed": ["x"], "known": False, "share": True, "motor": False}}
    asked = fit_settings(table).observer
    assert asked is not None
    given = msgspec.structs.asdict(asked)
    del given["profiles"]
    person, walk = asked_observer(cart(), trials(), **given)
    assert person.walk is not None
    # A push of one of three sizes every tenth sample: steps of .7 or 1.4, most of them none.
    np.testing.assert_allclose(walk, person.walk)
    assert 0.1 < walk[0] < 0.7
    assert person.motor[0] == 0 < person.share[0]
    with pytest.raises(InputError, match=r"\[fit.observer\] senses: is not a setting"):
        fit_settings({"observer": {"senses": ["x"]}})
    assert FitSettings().observer is None
