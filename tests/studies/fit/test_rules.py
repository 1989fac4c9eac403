"""The verdict follows from the numbers of its page; truth.json; stages that fail."""

from __future__ import annotations

import itertools
import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import impc
from experiments.search_problems import stick
from impc.arrays import Array
from impc.assess.variance_accounted_for import explained_share
from impc.levels import Level
from impc.reporting.document import Check, Checks, Copy, Report
from impc.reporting.provenance import Provenance
from impc.studies.fit import first, subject
from impc.studies.fit.facts import unlimited_ratio
from impc.studies.fit.findings import read_truth, truth_found
from impc.studies.fit.report import fit_report
from impc.studies.fit.result import FitResult
from impc.studies.fit.subject import fit_recordings
from impc.studies.fit.verdict import RULES, UNDETERMINED, WEIGHTS
from tests.studies.fit.test_verdict import explained, model_error
from tests.support import present


def made_up(
    fitted: float = 99.0, left_out: float | None = None, *, alarm: bool = False,
    known: bool = True, rejected: bool = False, fell: bool = False,
) -> FitResult:  # fmt: skip
    """A fit of a cart with other shares, tests and intervals."""
    base = explained()
    held = np.empty((0, 1)) if left_out is None else np.array([[left_out]])
    own = impc.replace(base.inverse_mpc, vaf=np.array([fitted]), held_out=held)
    trials = tuple(impc.replace(one, vaf=np.array([fitted])) for one in base.trials)
    wide = [
        item if known or item.value is None
        else impc.replace(item, low=item.value - 9 * abs(item.value), high=10 * abs(item.value))
        for item in base.uncertainty.intervals
    ]  # fmt: skip
    return impc.replace(
        base,
        methods=(*base.methods[:-1], own),
        trials=trials,
        lack=(model_error() if alarm else None,),
        weights_test=impc.replace(base.weights_test, p_value=1e-9 if rejected else 0.5),
        uncertainty=impc.replace(base.uncertainty, intervals=tuple(wide)),
        falls=("trial 2: the subject fell at 5 s",) if fell else (),
    )


def _level_of_page(report: Report) -> Level:
    """The level that the tables of a page allow, worst first, from their cells alone."""
    tables = {item.name: item for item in report.findings()}
    trials = present(tables["agreement"].table)
    gains = present(tables["gain_per_unit"].table)
    page = report.page()
    rejected = "No cost explains this gain" in page  # then the shares are those of its weights
    counted = trials.filter(regex="^none$" if rejected else "^vaf_").to_numpy()
    if any(gains["determined"]):  # else 150 samples are too few to predict by
        counted = np.hstack([counted, trials.filter(regex=r"^left_out_vaf_").to_numpy()])
    if np.any(counted < 50):
        return Level.RED
    alarm = "residual_tests" in tables and tables["residual_tests"].level is Level.AMBER
    doubts = rejected or "the subject fell" in page
    return Level.AMBER if alarm or doubts or not any(gains["determined"]) else Level.GREEN


def _checks(report: Report) -> list[Check]:
    blocks = [block for section in report.sections for block in section.blocks]
    return [one for block in blocks if isinstance(block, Checks) for one in block.checks]


def test_the_text_for_a_paper_names_the_warning_that_forbids_gains() -> None:
    """Rejected weights come first and allow gains; the wide intervals do not."""
    report = fit_report(made_up(known=False, rejected=True), Provenance())
    assert report.verdict.alerts[0].title == "No cost weights lead to this gain"
    assert isinstance(report.copy, Copy)
    said = "Gains are not reported: the recordings are too short, or the perturbation is too weak."
    assert said in report.copy.results


CASES = [
    (fitted, left_out, alarm, known, rejected, fell)
    for (fitted, left_out), (alarm, known, rejected, fell) in itertools.product(
        [(60.0, None), (99.0, 98.0), (99.0, -0.3), (40.0, None), (92.0, 40.0), (40.0, 30.0)],
        [(False, True, False, False), (True, True, False, False), (False, False, False, False),
         (False, True, True, False), (False, True, False, True)],
    )
]  # fmt: skip


@pytest.mark.parametrize(("fitted", "left_out", "alarm", "known", "rejected", "fell"), CASES)
def test_the_level_follows_from_the_tables(
    fitted: float, left_out: float | None, alarm: bool, known: bool, rejected: bool, fell: bool
) -> None:
    result = made_up(fitted, left_out, alarm=alarm, known=known, rejected=rejected, fell=fell)
    report = fit_report(result, Provenance())
    assert report.verdict.level is _level_of_page(report)
    if report.verdict.kind == UNDETERMINED:
        assert not known
    (share,) = (one for one in _checks(report) if one.name == "Explained variance")
    assert (share.level is Level.RED) == (report.verdict.level is Level.RED)
    assert isinstance(report.copy, Copy) == (report.verdict.level is not Level.RED)
    if report.verdict.level is Level.AMBER:
        assert report.verdict.alerts
        assert isinstance(report.copy, Copy)
        assert ("Gains were" in report.copy.results) == (rejected or fell)


def test_left_out_trials_count_even_if_weights_are_rejected() -> None:
    """The gain fits, its nearest weights do not, and left-out trials are not predicted."""
    verdict = RULES.verdict(made_up(99.0, -0.3, rejected=True))
    assert verdict.level is Level.RED
    assert "nothing of the place of the cart" in verdict.sentence
    assert not any("limit" in claim.text for claim in verdict.may)


def test_an_offset_does_not_explain_variance() -> None:
    """The share in a corrected output is that of its centred signal, trial by trial."""
    rng, levels = np.random.default_rng(5), (10.0, -4.0, 2.0)
    recorded = [rng.standard_normal((300, 1)) for _ in levels]
    model = [0.5 * one for one in recorded]
    plain = explained_share(recorded, recorded, model)
    np.testing.assert_array_equal(plain, impc.vaf(np.concatenate(recorded), np.concatenate(model)))
    moved: list[list[Array]] = [
        [one + level for one, level in zip(arrays, levels, strict=True)]
        for arrays in (recorded, model)
    ]
    assert impc.vaf(np.concatenate(moved[0]), np.concatenate(moved[1])) > 98
    # 1 - 0.25 of the variance, up to the means of 300 samples.
    np.testing.assert_allclose(explained_share(recorded, *moved), 75.0, atol=0.5)


@pytest.mark.parametrize(("other", "matters"), [(90.0, True), (98.9, False)])
def test_the_best_method_without_a_limit_is_compared(other: float, matters: bool) -> None:
    base = made_up()
    free = [impc.replace(base.methods[0], vaf=np.array([share])) for share in (other, 20.0)]
    result = impc.replace(base, methods=(*free, base.methods[-1]))
    ratio, said = unlimited_ratio(result)
    assert ratio == pytest.approx((100 - other) / 1.0)
    page = fit_report(result, Provenance()).page()
    assert ("The limit matters" in page) == matters
    assert said.strip() in page.replace("\u00a0", " ")


def test_inside_and_outside_are_counted() -> None:
    result = explained()
    (place, speed) = (result.preferred[name] for name in ("K.pull.place", "K.pull.speed"))
    assert truth_found(result, np.array([[place.low, speed.high]])) == (
        True,
        "The recordings are simulated: 2 of the 2 entries of their true gain lie inside their "
        "95 % intervals.",
    )
    right, said = truth_found(result, np.array([[place.high + 0.1, speed.low]]))
    assert not right
    assert "1 of the 2 entries" in said


@pytest.mark.full
@pytest.mark.parametrize(
    ("content", "found"),
    [
        ({"states": ["place", "speed"], "K": [[2.0, 1.0]]}, [[2.0, 1.0]]),
        ({"states": ["speed", "place"], "K": [[2.0, 1.0]]}, None),
        ({"states": ["place", "speed"], "K": [[2.0]]}, None),
        ({"subjects": []}, None),
        (["K"], None),
    ],
)
def test_only_a_truth_of_this_plant_is_one(tmp_path: Path, content: object, found: object) -> None:
    plant = explained().given.plant
    files = [tmp_path / "a.csv", tmp_path / "b.csv"]
    assert read_truth(files, plant) is None
    (tmp_path / "truth.json").write_text(json.dumps(content))
    gain = read_truth(files, plant)
    assert (None if gain is None else gain.tolist()) == found
    assert read_truth([*files, tmp_path / "c" / "a.csv"], plant) is None
    (tmp_path / "truth.json").write_text("no json")
    assert read_truth(files, plant) is None


@cache
def stick_fit(angle: float = -25.0, rate: float = -7.0, noise: float = 3e-4) -> FitResult:
    """A stick balanced by a gain, with recording noise (rad)."""
    plant, rng = impc.Plant(stick(), ["finger"]), np.random.default_rng(5)
    bounds = impc.Bounds(plant, u_min=-6, u_max=6)
    law = impc.Controller.from_gain(plant, [[angle, rate]], bounds, 5, terminal_set=False)
    push = rng.choice([-1.2, 0, 1.2], 30).repeat(10)
    seen = law.simulate(np.zeros(2), disturbance=push).x[:-1, :1]
    trial = impc.Recording(plant, seen + noise * rng.standard_normal(seen.shape), push)
    settings = impc.FitSettings(horizon=5, u_max=6.0)
    return fit_recordings(impc.fit_problem(plant, [trial], settings), settings)


def data(result: FitResult) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(fit_report(result, Provenance()).files()["result.json"])
    return found


@pytest.mark.full
def test_less_than_half_explained_gives_no_interval_and_no_statement() -> None:
    """Noise of three times the motion."""
    result = stick_fit(noise=0.15)
    found = data(result)
    assert np.max(result.inverse_mpc.vaf) < 50
    assert found["usable"] is False
    assert not {"gain", "directions", "statements"} & set(found["findings"])
    assert RULES.verdict(result).level is Level.RED
    assert found["verdict"]["level"] == "red"
    assert data(stick_fit())["usable"] is True


def test_no_weights_is_said_before_any_weights() -> None:
    """A gain without weights, with little noise, and the gain of a regulator."""
    result = stick_fit(-60.0, -4.0)
    assert result.weights_test.rejected
    verdict = RULES.verdict(result)
    assert "no cost weights explain it" in verdict.headline
    assert WEIGHTS in RULES.forbidden(result)
    assert np.min(result.gain_shares) > 99
    assert f"{result.gain_shares[0]:.0f} %" in verdict.may[0].why
    assert "statements" not in data(result)["findings"]
    assert not stick_fit().weights_test.rejected


def test_a_stage_that_fails_is_one_sentence_in_its_place(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawn gains and the test of the model fail: the gain is still reported."""

    def fails(*_: Any, **__: Any) -> Any:
        raise impc.SolverError("stage", "did not end", "try another")

    whole = stick_fit()
    monkeypatch.setattr(subject, "estimate_draws", fails)
    monkeypatch.setattr(first, "lack_of_fit", fails)
    result = fit_recordings(whole.given, impc.FitSettings(horizon=5, u_max=6.0))
    assert set(result.failures) == {"drawn gains", "test of the model"}
    page = fit_report(result, Provenance()).page()
    for stage in result.failures:
        assert f"Not available: {stage}" in page
    np.testing.assert_array_equal(result.estimate.K, whole.estimate.K)
    assert data(result)["failures"] == dict(result.failures)
