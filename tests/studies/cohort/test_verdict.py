"""Verdict of a cohort for made-up tables of units."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pytest

from impc.reporting.finding import Level
from impc.studies.cohort.figures import forest
from impc.studies.cohort.report import comparisons
from impc.studies.cohort.verdict import Cohort, cohort_verdict

FIT: dict[str, Any] = {
    "words": {"command": "commanded torque", "theta1": "seat tilt"},
    "units": {"K.command.theta1": "N m/rad"},
    "controls": ["command"],
    "outputs": ["theta1"],
}
GAIN = "K.command.theta1"


def cohort(
    shift: float, *, warned: tuple[int, ...] = (), red: tuple[int, ...] = (), spread: float = 20.0,
    wide: tuple[int, ...] = (), visits: int = 1, mean: float = 800.0,
) -> Cohort:  # fmt: skip
    """Twenty people in two groups; the gain of the second, or of the second visit, is shifted."""
    rng = np.random.default_rng(5)
    rows = []
    for number in range(20):
        group = "first" if number < 10 else "second"
        for visit in range(visits):
            moved = visit if visits > 1 else group == "second"
            level = "red" if number in red else "amber" if number in warned else "green"
            rows.append({
                "unit": f"sub-{number}_ses-{visit}", "subject": str(number),
                "visit": str(visit + 1),
                "condition": "", "group": group if visits == 1 else "", "level": level,
                "headline": "It fits." if level == "green" else "The body model does not fit.",
                GAIN: mean + shift * moved + spread * rng.standard_normal(),
                "K_deviation.command.theta1": 1e5 if number in wide else 30.0,
                "vaf.theta1": 99.0 + 0.1 * rng.random(), "saturated": 0.1,
            })  # fmt: skip
    return Cohort(pd.DataFrame(rows), FIT, {})


def test_the_headline_has_direction_size_and_unit() -> None:
    made = cohort(-139.0, spread=0.1)
    found = cohort_verdict(made)
    assert found.level is Level.GREEN
    assert found.headline == (
        "The second group applies 139 N m/rad less torque per seat tilt than the first."
    )
    for part in (
        "n = 20 people",
        "95 % CI 138.99 to 139.12 N m/rad less",
        "Holm p < 0.001",
        "Hedges' g",
    ):
        assert part in found.sentence


def test_a_gain_below_zero_is_larger_the_lower_it_is() -> None:
    made = cohort(-139.0, spread=0.1, mean=-800.0)
    assert "139 N m/rad more torque" in cohort_verdict(made).headline


def test_visits_of_one_group_are_compared() -> None:
    found = cohort_verdict(cohort(50.0, spread=0.1, visits=2))
    assert found.headline.startswith("At visit 2 people apply 50 N m/rad")
    assert found.headline.endswith("more torque per seat tilt than at visit 1.")


def test_no_difference_is_no_claim_that_groups_are_alike() -> None:
    found = cohort_verdict(cohort(0.0))
    assert found.headline == "No difference in a gain between the groups was found."
    assert any("equal" in claim.text for claim in found.may_not)


def test_only_what_is_identified_and_usable_is_compared() -> None:
    made = cohort(-139.0, wide=(0, 1), red=(19,))
    lead = made.lead
    assert lead is not None
    assert lead.n == 17
    kept = made.units.drop(index=[0, 1, 19])
    means = kept.groupby("group")[GAIN].mean()
    assert lead.estimate == pytest.approx(means["second"] - means["first"])
    assert made.identified[1:] == (17, 20)


def test_warnings_make_it_amber_and_are_tried_without() -> None:
    assert cohort_verdict(cohort(-139.0, warned=(3,))).level is Level.GREEN
    made = cohort(-139.0, warned=(3, 4, 12, 13))
    found = cohort_verdict(made)
    assert found.level is Level.AMBER
    (alert,) = found.alerts
    assert alert.title == "4 of 20 fits have a warning"
    assert "Without fits with a warning it is 1" in alert.found
    assert "n = 16" in alert.found


def test_too_few_gains_are_no_comparison() -> None:
    found = cohort_verdict(cohort(-139.0, wide=tuple(range(9))))
    assert found.level is Level.AMBER
    assert "identified in too few people" in found.headline


def test_no_usable_fit_is_red() -> None:
    made = cohort(0.0, red=tuple(range(20)))
    assert cohort_verdict(made).level is Level.RED
    assert cohort_verdict(Cohort(pd.DataFrame(), {}, {"sub-1": "no"})).level is Level.RED


def test_people_whose_gain_is_not_identified_are_hollow() -> None:
    made = cohort(-139.0, wide=(0, 1))
    for narrow in (False, True):
        (axes,) = forest(made, narrow).axes
        dots = [line for line in axes.lines if line.get_marker() == "o"]
        hollow = [line for line in dots if line.get_markerfacecolor() == "none"]
        assert (len(dots), len(hollow)) == (20, 2)


def test_cost_weights_are_compared_as_ratios() -> None:
    made = cohort(0.0)
    units = made.units.rename(columns={GAIN: "log_cost_weight.theta1"})
    units["log_cost_weight.theta1"] = np.log(4.0) + 0.01 * np.random.default_rng(0).random(20)
    units.loc[units["group"] == "second", "log_cost_weight.theta1"] -= np.log(2.0)
    made = Cohort(units.assign(structure_refused=False), FIT, {})
    headline = cohort_verdict(made).headline
    assert headline.startswith("The cost weight of seat tilt is 0.5 times as high in the second")
    table = comparisons(made).table
    assert table is not None
    row = table[table["measure"] == "cost weight of seat tilt"].iloc[0]
    assert (row["difference"], row["unit"]) == (pytest.approx(0.5, rel=0.01), "ratio")
