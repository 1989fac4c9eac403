"""The report of a plan: page, table as CSV, result.json, figures.

See docs/planning.md.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from impc.model.signal_units import gain_unit
from impc.reporting.document import Lines, Picture, Report, Section, Terms, TextTable, Verdict
from impc.reporting.rendering import number
from impc.reporting.shown_units import shown_unit
from impc.reporting.style import drawn, journal_style
from impc.studies.fit.tables import number_name
from impc.studies.plan.figures import experiments_figure, prices_figure
from impc.studies.plan.sentences import design_name, plan_sentences, told_as
from impc.studies.plan.simulated_fits import spread
from impc.studies.signal_words import signal_words

if TYPE_CHECKING:
    from impc.reporting.provenance import Provenance
    from impc.studies.plan.designs import Outcome
    from impc.studies.plan.study import Plan

_PICTURES = (
    Picture(
        "prices",
        "How far each price would be told, over the amplitude of the perturbation",
        "Half an interval of 95 %, as a factor of the price: farther down is better, 1 is exact. "
        "Each line is a dwell; the large ring marks the experiment above.",
    ),
    Picture(
        "experiments",
        "Share of the time at the limit, and of the trials that end in a fall",
        "What the perturbation does to the person, over its amplitude; each line is a dwell.",
    ),
)


def plan_report(plan: Plan, provenance: Provenance) -> Report:
    """Page, result.json, experiments.csv and figures."""
    with journal_style():
        figures = drawn({"prices": prices_figure(plan), "experiments": experiments_figure(plan)})
    first, *rest = plan_sentences(plan)
    sections = [
        Section("1. The experiments", (*_PICTURES, _experiments(plan)), "Experiments"),
        Section("2. What the best one would tell", _best(plan), "Best"),
        Section("3. Groups", (_groups(plan),), "Groups"),
        Section("4. The presumed person", _presumed(plan), "Person"),
        Section(
            "5. Versions",
            (Markup("<code>{}</code>").format(provenance.command), provenance.all_versions),
        ),
    ]
    return Report(
        "impc plan",
        "What an experiment would tell",
        (Verdict(first), Lines(rest)),
        sections,
        figures=figures,
        tables={"experiments": _numbers(plan)},
        data=_data(plan),
        provenance=provenance,
        words=signal_words(plan.person.controller.plant),
    )


def _experiments(plan: Plan) -> TextTable:
    names = plan.person.structure.unknowns
    rows = []
    for item in plan.outcomes:
        mark = "A-optimal" if item is plan.best else ""
        mark += (", " if mark else "") + "D-optimal" if item is plan.sharpest else ""
        told = ["-"] * len(names)
        if item.expected is not None:
            told = [told_as(one) for one in item.expected.intervals]
        share = "-" if math.isnan(item.at_limit) else f"{100 * item.at_limit:.1f}"
        rows.append((design_name(plan, item.design), f"{100 * item.falls:.0f}", share, *told, mark))
    heads = ("experiment", "falls (%)", "at the limit (%)", *(f"price of {x}" for x in names), "")
    return TextTable("Expected intervals of 95 %, as factors of the presumed price.", heads, rows)


def _best(plan: Plan) -> tuple[TextTable, ...]:
    expected = plan.best.expected
    if expected is None:
        return ()
    plant, truth = plan.person.controller.plant, np.array(plan.person.controller.K)
    gains = [
        (
            number_name(plant, f"K.{control}.{state}"),
            number(truth[i, j]),
            number(1.96 * expected.gain.entries[i, j]),
            "yes" if expected.gain.told_entries[i, j] else "only with others",
            gain_unit(plant, control, state),
        )
        for i, control in enumerate(plant.controls)
        for j, state in enumerate(plant.states)
    ]
    heads = ("gain", "presumed", "half an interval of 95 %", "told", "unit")
    along = int(np.count_nonzero(expected.gain.told))
    caption = (
        f"Gains fitted without a structure: {along} of {truth.size} directions would be told to a "
        "fifth of their natural size."
    )
    return _price_table(plan), TextTable(caption, heads, gains)


def _price_table(plan: Plan) -> TextTable:
    person, expected, fits = plan.person, plan.best.expected, plan.simulated
    scatter = None if fits is None or len(fits.prices) == 0 else spread(fits.prices)
    rows = []
    for index, name in enumerate(person.structure.unknowns):
        value = math.exp(float(person.prices[index]))
        if expected is None:
            continue
        item = expected.intervals[index]
        rows.append(
            (
                name,
                number(value),
                number(math.exp(item.low)) if np.isfinite(item.low) else "0",
                number(math.exp(item.high)),
                number(float(expected.deviations[index]), 2),
                "-" if scatter is None else number(float(scatter[index]), 2),
            )
        )
    heads = (
        "price of",
        "presumed",
        "interval from",
        "to",
        "deviation of its logarithm",
        "in simulated fits",
    )
    return TextTable("Prices, with one for the first command.", heads, rows)


def _groups(plan: Plan) -> TextTable:
    settings = plan.settings
    rows = [
        (
            item.feature,
            number(item.deviation, 2),
            *(f"{100 * power:.0f}" for power in item.powers),
            "-" if math.isinf(item.needed) else f"{item.needed:.0f}",
        )
        for item in plan.groups
    ]
    heads = (
        "price of",
        "deviation within a group",
        *(f"power with {size} a group (%)" for size in settings.groups),
        "persons a group for 80 %",
    )
    return TextTable(
        f"Two groups whose price differs by {settings.difference:g} %, t-test of the logarithms at "
        f"5 %; persons within a group differ by {settings.between:g} %.",
        heads,
        rows,
    )


def _presumed(plan: Plan) -> tuple[Terms, ...]:
    person, plant = plan.person, plan.person.controller.plant
    noise = []
    for name, value in zip(plant.outputs, person.deviation, strict=True):
        factor, unit = shown_unit(plant, name)
        noise.append(f"{name}: {number(factor * float(value))} {unit}")
    prices = [
        f"{name}: {number(math.exp(float(value)))}"
        for name, value in zip(person.structure.unknowns, person.prices, strict=True)
    ]
    tau = plan.settings.correlation
    kind = f"correlated over {tau:g} s" if tau > 0 else "white"
    limits = [
        f"{name}: {number(float(value))} {plant.unit(name)}"
        for name, value in zip(plant.controls, person.controller.bounds.u_max, strict=True)
    ]
    return (
        Terms(
            [
                ("Prices", prices),
                (f"Noise in the recorder, {kind}", noise),
                ("Limit", limits),
                ("Horizon", (f"{person.controller.horizon} samples of {plant.dt:g} s",)),
            ]
        ),
    )


def _row(plan: Plan, item: Outcome) -> dict[str, Any]:
    names = plan.person.structure.unknowns
    row: dict[str, Any] = {
        "amplitude": item.design.amplitude,
        "dwell": item.design.dwell,
        "falls": item.falls,
        "at_limit": item.at_limit,
    }
    for index, name in enumerate(names):
        told = None if item.expected is None else item.expected.intervals[index]
        row[f"{name} low"] = np.nan if told is None else math.exp(told.low)
        row[f"{name} high"] = np.nan if told is None else math.exp(told.high)
        row[f"{name} deviation"] = (
            np.nan if item.expected is None else float(item.expected.deviations[index])
        )
    return row


def _numbers(plan: Plan) -> TextTable:
    rows = [_row(plan, item) for item in plan.outcomes]
    return TextTable("", tuple(rows[0]), [tuple(row.values()) for row in rows])


def _data(plan: Plan) -> dict[str, Any]:
    person, expected, fits = plan.person, plan.best.expected, plan.simulated
    names = person.structure.unknowns
    found: dict[str, Any] = {
        "experiments": [_row(plan, item) for item in plan.outcomes],
        "best": {"amplitude": plan.best.design.amplitude, "dwell": plan.best.design.dwell},
        "sharpest": {
            "amplitude": plan.sharpest.design.amplitude,
            "dwell": plan.sharpest.design.dwell,
        },
        "structure": person.structure.name,
        "presumed": dict(zip(names, np.exp(person.prices), strict=True)),
        "gain": {"presumed": person.controller.K},
        "groups": [
            {
                "price": item.feature,
                "deviation": item.deviation,
                "power": dict(zip(map(str, plan.settings.groups), item.powers, strict=True)),
                "needed": item.needed,
            }
            for item in plan.groups
        ],
        "sentences": plan_sentences(plan),
        "simulated": None,
    }
    if expected is not None:
        found["gain"]["deviation"] = expected.gain.entries
        found["limit_deviation"] = expected.limits
    if fits is not None and expected is not None:
        found["simulated"] = {
            "fits": len(fits.prices),
            "failed": fits.failed,
            "inside": dict(zip(names, fits.inside(expected), strict=True)),
            "scatter": dict(zip(names, spread(fits.prices), strict=True)),
        }
    return found
