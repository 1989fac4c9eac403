"""Verdict of a cohort for made-up tables of units."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pytest

from impc.files.configuration import Configuration, RecordingTable
from impc.levels import Level
from impc.studies.cohort.figures import forest
from impc.studies.cohort.report import comparisons, subjects
from impc.studies.cohort.results import Cohort
from impc.studies.cohort.study import Study, Unit
from impc.studies.cohort.verdict import RULES
from impc.studies.fit.verdict import UNDETERMINED
from tests.studies.cohort.made_up import column, gain_column
from tests.support import present

GAIN = "K.command.theta1"
COLUMNS = {
    GAIN: gain_column("seat tilt", "commanded torque", "N m/rad", np.pi / 180, "N m", "1°"),
    "vaf.theta1": column("variance accounted for, seat tilt", "seat tilt", "%"),
}


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
            gain = mean + shift * moved + spread * rng.standard_normal()
            half = 1.96e5 if number in wide else 0.98 * spread
            rows.append({
                "unit": f"sub-{number}_ses-{visit}", "subject": str(number),
                "visit": str(visit + 1),
                "condition": "", "group": group if visits == 1 else "", "level": level,
                "headline": "It fits." if level == "green" else "The body model does not fit.",
                "kind": "",
                GAIN: gain, "K_deviation.command.theta1": half / 1.96,
                "K_low.command.theta1": gain - half, "K_high.command.theta1": gain + half,
                "K_determined.command.theta1": number not in wide,
                "vaf.theta1": 99.0 + 0.1 * rng.random(), "saturated": 0.1,
            })  # fmt: skip
    return Cohort(pd.DataFrame(rows), COLUMNS, {})


HEADLINES: list[tuple[dict[str, Any], str]] = [
    (
        {"shift": -139.0, "spread": 0.1},
        "The second group answers 1° of seat tilt with 2.43 N m less torque than the first group.",
    ),
    (  # a gain below zero is larger the lower it is
        {"shift": -139.0, "spread": 0.1, "mean": -800.0},
        "The second group answers 1° of seat tilt with 2.43 N m more torque than the first group.",
    ),
    (
        {"shift": 50.0, "spread": 0.1, "visits": 2},
        "At visit 2 people answer 1° of seat tilt with 0.872 N m more torque than at visit 1.",
    ),
    ({"shift": 0.0}, "No difference in a gain between the groups was found."),
    (
        {"shift": -139.0, "wide": tuple(range(9))},
        "Gains are known well enough in too few people for a comparison.",
    ),
    ({"shift": 0.0, "red": tuple(range(20))}, "No fit of this study can be used."),
]


@pytest.mark.parametrize(("given", "headline"), HEADLINES)
def test_headlines(given: dict[str, Any], headline: str) -> None:
    found = RULES.verdict(cohort(**given))
    level = Level.AMBER if "wide" in given else Level.RED if "red" in given else Level.GREEN
    assert (found.level, found.headline) == (level, headline)


def test_numbers_of_a_difference_and_no_claim_of_equality_without_one() -> None:
    found = RULES.verdict(cohort(-139.0, spread=0.1))
    for part in ("n = 20 people", "95 % CI 2.4258 to 2.4281 N m/° less", "p_holm < .001",
                 "Hedges' g"):  # fmt: skip
        assert part in found.sentence
    found = RULES.verdict(cohort(0.0))
    assert any("equal" in claim.text for claim in found.may_not)
    assert "p_holm = .208" in found.sentence


def test_all_usable_fits_count_and_uncertain_ones_little() -> None:
    made = cohort(-139.0, wide=(0, 1), red=(19,))
    made.units.loc[0, GAIN] = 5000.0
    lead = present(made.lead)
    assert lead.n == 19
    kept = made.units.drop(index=[0, 1, 19])
    means = kept.groupby("group")[GAIN].mean()
    assert lead.estimate == pytest.approx(means["second"] - means["first"], abs=0.5)
    assert made.determined[1:] == (17, 20)


def test_fits_far_from_their_group_are_named_and_tried_without() -> None:
    """Two wrong gains, known well: the page marks them and gives the difference without them."""
    made = cohort(-139.0)
    ends = [GAIN, "K_low.command.theta1", "K_high.command.theta1"]
    made.units.loc[[3, 15], ends] = 3000.0, 2900.0, 3100.0
    found = RULES.verdict(made)
    assert found.level is Level.AMBER
    assert found.headline == "No difference in a gain between the groups was found."
    assert "Without the 2 fits to look at it is 2.6 N m/° less" in found.sentence
    (alert,) = found.alerts
    assert alert.title == "2 of 20 fits are far from the others of their group"
    assert "3 (3.7 times), 15 (4.6 times)" in alert.found
    (axes,) = forest(made).axes
    assert sum(line.get_marker() == "s" for line in axes.lines) == 2
    study = Study("", Configuration(RecordingTable(), {}), tuple(
        Unit(row["subject"], "0", "", (), row["group"])
        for row in made.units.to_dict("records")
    ))  # fmt: skip
    table = present(subjects(study, made).table)
    marked = table[table["why"].str.startswith("Look at it: a gain is")]
    assert marked["subject"].tolist() == ["3", "15"]
    assert marked["value"].tolist() == pytest.approx([3000 * np.pi / 180] * 2)
    assert marked["value_si"].tolist() == pytest.approx([3000.0] * 2)


def test_the_reference_is_subtracted() -> None:
    made = cohort(-139.0, spread=0.1)
    renamed = made.units.assign(
        group=made.units["group"].map({"first": "LBP", "second": "control"})
    )
    for reference, first in (("", "control"), ("LBP", "LBP")):
        table = present(comparisons(Cohort(renamed, COLUMNS, {}, reference)).table)
        assert table["compared"].iloc[0].endswith(f" - {first}")
        assert (table["difference"].iloc[0] > 0) == (first == "control")
        row = table.iloc[0]
        assert (row["unit"], row["unit_si"]) == ("N m/°", "N m/rad")
        assert row["difference"] == pytest.approx(row["difference_si"] * np.pi / 180)


def test_warnings_make_it_amber_and_are_tried_without() -> None:
    """One does not, and a fit that determines no gain is no warning of the study."""
    assert RULES.verdict(cohort(-139.0, warned=(3,))).level is Level.GREEN
    made = cohort(-139.0, warned=(3, 4, 12, 13))
    found = RULES.verdict(made)
    assert found.level is Level.AMBER
    (alert,) = found.alerts
    assert alert.title == "4 of 20 fits have a warning"
    assert "Without fits with a warning it is 2.6 N m/° less" in alert.found
    assert "n = 16" in alert.found
    units = made.units.assign(kind=made.units["kind"].where(made.units.index != 3, UNDETERMINED))
    assert Cohort(units, COLUMNS, {}).warned == 3
    assert RULES.verdict(Cohort(units.drop(index=[12, 13]), COLUMNS, {})).level is Level.GREEN


def test_a_study_of_which_nothing_was_fitted_is_red() -> None:
    assert RULES.verdict(Cohort(pd.DataFrame(), {}, {"sub-1": "no"})).level is Level.RED


def test_people_whose_gain_is_not_determined_are_hollow() -> None:
    made = cohort(-139.0, wide=(0, 1))
    (axes,) = forest(made).axes
    dots = [line for line in axes.lines if line.get_marker() == "o"]
    hollow = [line for line in dots if line.get_markerfacecolor() == "none"]
    assert (len(dots), len(hollow)) == (20, 2)


def test_cost_weights_are_compared_as_ratios() -> None:
    made = cohort(0.0)
    units = made.units.rename(columns={GAIN: "log_cost_weight.theta1"})
    units["log_cost_weight.theta1"] = np.log(4.0) + 0.01 * np.random.default_rng(0).random(20)
    units.loc[units["group"] == "second", "log_cost_weight.theta1"] -= np.log(2.0)
    weight = {"log_cost_weight.theta1": column("cost weight of seat tilt", "seat tilt", "-")}
    made = Cohort(units.assign(structure_refused=False), weight, {})
    headline = RULES.verdict(made).headline
    assert headline.startswith("The cost weight of seat tilt is 0.5 times as high in the second")
    table = present(comparisons(made).table)
    row = table[table["measure"] == "cost weight of seat tilt"].iloc[0]
    assert (row["difference"], row["unit"]) == (pytest.approx(0.5, rel=0.01), "ratio")
