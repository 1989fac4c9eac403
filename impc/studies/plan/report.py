"""The report of a plan: page, table as CSV, result.json, figures.

See docs/planning.md.
"""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from impc.model.plant import gain_unit
from impc.reporting.document import Lines, Report, Section, Terms, Verdict
from impc.reporting.finding import Finding, Picture
from impc.reporting.rendering import number
from impc.reporting.shown_units import shown_unit, signal_words
from impc.reporting.style import drawn, journal_style
from impc.studies.fit.gain_findings import number_name
from impc.studies.plan.figures import cost_weights_figure, experiments_figure
from impc.studies.plan.sentences import plan_sentences
from impc.studies.plan.study import spread

if TYPE_CHECKING:
    from impc.reporting.provenance import Provenance
    from impc.studies.plan.study import Plan

_PICTURES = (
    Picture(
        "cost_weights",
        "How far each cost weight would be identified, over the amplitude of the perturbation",
        "Half an interval of 95 %, as a factor of the cost weight: farther down is better, 1 is "
        "exact. Each line is a dwell; the large ring marks the experiment above.",
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
        figures = drawn(
            {"cost_weights": cost_weights_figure(plan), "experiments": experiments_figure(plan)}
        )
    first, *rest = plan_sentences(plan)
    sections = [
        Section("1. The experiments", (*_PICTURES, _experiments(plan)), "Experiments"),
        Section("2. What the best one would identify", _best(plan), "Best"),
        Section("3. Groups", (_groups(plan),), "Groups"),
        Section("4. The presumed person", _presumed(plan), "Person"),
        Section(
            "5. Versions",
            (Markup("<code>{}</code>").format(provenance.command), provenance.all_versions),
        ),
    ]
    return Report(
        "impc plan",
        "What an experiment would identify",
        (Verdict(first), Lines(rest)),
        sections,
        figures=figures,
        data=_data(plan),
        provenance=provenance,
        words=signal_words(plan.person.controller.plant),
    )


def _experiments(plan: Plan) -> Finding:
    """Every experiment and what it would identify, as factors of the cost weights (95 %)."""
    rows: list[dict[str, Any]] = []
    for item in plan.outcomes:
        row: dict[str, Any] = {
            "amplitude": float(item.design.amplitude),
            "dwell": float(item.design.dwell),
            "falls_percent": 100 * float(item.falls),
            "at_the_limit_percent": 100 * float(item.at_limit),
        }
        for index, name in enumerate(plan.person.structure.unknowns):
            low, high, error = np.nan, np.nan, np.nan
            if item.expected is not None:
                interval = item.expected.intervals[index]
                ends = interval.low, interval.high
                low, high = (float(np.exp(end - interval.value)) for end in ends)
                error = float(item.expected.deviations[index])
            row |= {f"{name}_low": low, f"{name}_high": high, f"{name}_standard_error": error}
        best = {"A-optimal": plan.best, "D-optimal": plan.sharpest}
        row["best"] = ", ".join(word for word, one in best.items() if item is one)
        rows.append(row)
    caption = (
        "Expected intervals of 95 %, as factors of the presumed cost weight, and standard errors "
        "of its logarithm; dwell in s."
    )
    return Finding("experiments", pd.DataFrame(rows), caption, digits=3)


def _best(plan: Plan) -> list[Finding]:
    expected, person = plan.best.expected, plan.person
    if expected is None:
        return []
    plant, truth, fits = person.controller.plant, np.array(person.controller.K), plan.simulated
    names, some = person.structure.unknowns, fits is not None and len(fits.cost_weights) > 0
    scatter = spread(fits.cost_weights) if fits and some else np.full(len(names), np.nan)
    cost_weights = pd.DataFrame(
        {
            "cost_weight_of": names,
            "presumed": np.exp(person.cost_weights),
            "low": [math.exp(item.low) for item in expected.intervals],
            "high": [math.exp(item.high) for item in expected.intervals],
            "standard_error_of_the_logarithm": np.array(expected.deviations),
            "in_simulated_fits": scatter,
        }
    )
    with_one = "Cost weights, with one for the first command, 95 %."
    body, known, problem = expected.body, [], plan.best.problem
    if body is not None and problem is not None:
        cost_weights["with_an_exact_body"] = np.array(body.exact)
        cost_weights["with_ten_times_the_trials"] = np.array(body.tenfold)
        cost_weights["with_any_number_of_trials"] = np.array(body.floor)
        with_one += (
            " The last three are standard errors too: if all parameters of the body were known "
            "exactly, and with more trials of a body that is known as stated."
        )
        shares = 100 * expected.narrower(body.measured)
        by = pd.DataFrame(shares, columns=[f"{name}_narrower_percent" for name in names])
        by.insert(0, "parameter", body.names)
        by.insert(1, "stated_percent", 100 * problem.parameter_units[problem.stated])
        of_body = (
            "By how much the interval of each cost weight would be narrower if this parameter of "
            "the body were known exactly, and the others as stated; to first order."
        )
        known = [Finding("body", by, of_body, digits=2)]
    places = [(control, state) for control in plant.controls for state in plant.states]
    gains = pd.DataFrame(
        {
            "gain": [number_name(plant, f"K.{control}.{state}") for control, state in places],
            "unit": [gain_unit(plant, control, state) for control, state in places],
            "presumed": truth.ravel(),
            "half_an_interval": 1.96 * np.ravel(expected.gain.entries),
            "identified": np.ravel(expected.gain.individually_identified),
        }
    )
    along = int(np.count_nonzero(expected.gain.identified))
    caption = (
        f"Gains fitted without a structure: {along} of {truth.size} directions would be identified "
        "to a fifth of their natural size. Half an interval is that of 95 %."
    )
    return [
        Finding("cost_weights", cost_weights, with_one, digits=3),
        *known,
        Finding("gain", gains, caption, digits=3),
    ]


def _groups(plan: Plan) -> Finding:
    settings = plan.settings
    rows = [
        (item.feature, item.deviation, *(100 * np.array(item.powers)), item.needed)
        for item in plan.groups
    ]
    powers = [f"power_with_{size}_a_group_percent" for size in settings.groups]
    heads = ["cost_weight_of", "standard_deviation_within_a_group", *powers,
             "persons_a_group_for_80_percent"]  # fmt: skip
    caption = (
        f"Two groups whose cost weight differs by {settings.difference:g} %, t-test of the "
        f"logarithms at 5 %; persons within a group differ by {settings.between:g} %, "
        "and estimates as the intervals above are wide."
    )
    return Finding("groups", pd.DataFrame(rows, columns=heads), caption, digits=3)


def _presumed(plan: Plan) -> tuple[Terms, ...]:
    person, plant = plan.person, plan.person.controller.plant
    shown = [(name, *shown_unit(plant, name)) for name in plant.outputs]
    tau = plan.settings.correlation
    kind = f"correlated over {tau:g} s" if tau > 0 else "white"
    bounds = person.controller.bounds
    terms = [
        (
            "Cost weights",
            [
                f"{name}: {number(math.exp(float(value)))}"
                for name, value in zip(person.structure.unknowns, person.cost_weights, strict=True)
            ],
        ),
        (
            f"Noise in the recorder, {kind}",
            [
                f"{name}: {number(factor * float(value))} {unit}"
                for (name, factor, unit), value in zip(shown, person.deviation, strict=True)
            ],
        ),
        (
            "Limit",
            [
                f"{name}: {number(float(value))} {plant.unit(name)}"
                for name, value in zip(plant.controls, bounds.u_max, strict=True)
            ],
        ),
        ("Horizon", [f"{person.controller.horizon} samples of {plant.dt:g} s"]),
    ]
    return (Terms(terms),)


def _data(plan: Plan) -> dict[str, Any]:
    person, expected, fits = plan.person, plan.best.expected, plan.simulated
    names = person.structure.unknowns
    found: dict[str, Any] = {
        "best": asdict(plan.best.design),
        "sharpest": asdict(plan.sharpest.design),
        "structure": person.structure.name,
        "presumed": dict(zip(names, np.exp(person.cost_weights), strict=True)),
        "gain": {"presumed": person.controller.K},
        "sentences": plan_sentences(plan),
        "simulated": None,
    }
    if expected is not None:
        found["gain"]["deviation"] = expected.gain.entries
        found["limit_deviation"] = expected.limits
    if fits is not None and expected is not None:
        found["simulated"] = {
            "fits": len(fits.cost_weights),
            "failed": fits.failed,
            "inside": dict(zip(names, fits.inside(expected), strict=True)),
            "scatter": dict(zip(names, spread(fits.cost_weights), strict=True)),
        }
    return found
