"""The verdict of a fit follows from the numbers of its page, in made-up cases of each kind."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np
import pytest

from impc.assess.assessments import MethodFit
from impc.assess.lack_of_fit import LackOfFit, ModelError
from impc.assess.variance_accounted_for import explained_share, vaf
from impc.checking import replace
from impc.levels import Level
from impc.reporting.document import Check, Checks, Copy, Report
from impc.reporting.provenance import Provenance
from impc.studies.fit.facts import unlimited_ratio
from impc.studies.fit.report import fit_report
from impc.studies.fit.result import FitResult
from impc.studies.fit.verdict import UNDETERMINED, fit_verdict
from tests.studies.fit.test_verdict import explained

if TYPE_CHECKING:
    from impc.arrays import Array


def made_up(
    fitted: float, left_out: float | None, *, alarm: bool, known: bool, rejected: bool, fell: bool
) -> FitResult:
    """A fit of a cart with other shares, tests and intervals."""
    base = explained()
    held = np.empty((0, 1)) if left_out is None else np.array([[left_out]])
    own = replace(base.inverse_mpc, vaf=np.array([fitted]), held_out=held)
    trials = tuple(replace(one, vaf=np.array([fitted])) for one in base.trials)
    error = LackOfFit((ModelError("delay", 1e-5, 11.5, 1.0, 0.1),), alarm=True, untestable=())
    wide = [
        item if known or item.value is None
        else replace(item, low=item.value - 9 * abs(item.value), high=10 * abs(item.value))
        for item in base.uncertainty.intervals
    ]  # fmt: skip
    return replace(
        base,
        methods=(*base.methods[:-1], own),
        trials=trials,
        lack=(error if alarm else None,),
        weights_test=replace(base.weights_test, p_value=1e-9 if rejected else 0.5),
        uncertainty=replace(base.uncertainty, intervals=tuple(wide)),
        falls=("trial 2: the subject fell at 5 s",) if fell else (),
    )


def _level_of_page(report: Report) -> Level:
    """The level that the tables of a page allow, worst first, from their cells alone."""
    tables = {item.name: item for item in report.findings()}
    trials = tables["agreement"].table
    assert trials is not None
    gains = tables["gain_per_unit"].table
    assert gains is not None
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
    result = made_up(99.0, None, alarm=False, known=False, rejected=True, fell=False)
    report = fit_report(result, Provenance())
    assert report.verdict.alerts[0].title == "No cost weights lead to this gain"
    assert isinstance(report.copy, Copy)
    said = "Gains are not reported: the recordings are too short, or the perturbation is too weak."
    assert said in report.copy.results


CASES = [
    (fitted, left_out, alarm, known, rejected, fell)
    for (fitted, left_out), (alarm, known, rejected, fell) in itertools.product(
        [(99.0, None), (99.0, 98.0), (99.0, -0.3), (40.0, None), (92.0, 40.0), (40.0, 30.0)],
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
    result = made_up(99.0, -0.3, alarm=False, known=True, rejected=True, fell=False)
    verdict = fit_verdict(result)
    assert verdict.level is Level.RED
    assert "nothing of the place of the cart" in verdict.sentence
    assert not any("limit" in claim.text for claim in verdict.may)


def test_an_offset_does_not_explain_variance() -> None:
    """The share in a corrected output is that of its centred signal, trial by trial."""
    rng = np.random.default_rng(5)
    recorded = [rng.standard_normal((300, 1)) for _ in range(3)]
    model = [0.5 * one for one in recorded]

    def moved(arrays: list[Array]) -> list[Array]:
        return [one + level for one, level in zip(arrays, (10.0, -4.0, 2.0), strict=True)]

    plain = explained_share(recorded, recorded, model)
    np.testing.assert_array_equal(plain, vaf(np.concatenate(recorded), np.concatenate(model)))
    assert vaf(np.concatenate(moved(recorded)), np.concatenate(moved(model))) > 98
    # 1 - 0.25 of the variance, up to the means of 300 samples.
    np.testing.assert_allclose(
        explained_share(recorded, moved(recorded), moved(model)), 75.0, atol=0.5
    )


@pytest.mark.parametrize(("other", "matters"), [(90.0, True), (98.9, False)])
def test_the_best_method_without_a_limit_is_compared(other: float, matters: bool) -> None:
    base = made_up(99.0, None, alarm=False, known=True, rejected=False, fell=False)

    def free(share: float) -> MethodFit:
        (first, *_) = base.methods
        return replace(first, vaf=np.array([share]))

    result = replace(base, methods=(free(other), free(20.0), base.methods[-1]))
    ratio, said = unlimited_ratio(result)
    assert ratio == pytest.approx((100 - other) / 1.0)
    page = fit_report(result, Provenance()).page()
    assert ("The limit matters" in page) == matters
    assert said.strip() in page.replace("\u00a0", " ")
