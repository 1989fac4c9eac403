"""The report of a plan: page, table as CSV, result.json, figures.

See docs/planning.md.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from impc.model.plant import gain_unit
from impc.reporting.document import Lines, Report, Section, Terms, Verdict
from impc.reporting.finding import Finding, Picture, table_of
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
        "exact. "
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
        figures = drawn(
            {"cost_weights": cost_weights_figure(plan), "experiments": experiments_figure(plan)}
        )
    first, *rest = plan_sentences(plan)
    sections = [
        Section("1. The experiments", (*_PICTURES, _experiments(plan)), "Experiments"),
        Section("2. What the best one would say", _best(plan), "Best"),
        Section("3. Groups", (_groups(plan),), "Groups"),
        Section("4. The presumed person", _presumed(plan), "Person"),
        Section(
            "5. Versions",
            (Markup("<code>{}</code>").format(provenance.command), provenance.all_versions),
        ),
    ]
    return Report(
        "impc plan",
        "What an experiment would say",
        (Verdict(first), Lines(rest)),
        sections,
        figures=figures,
        data=_data(plan),
        provenance=provenance,
        words=signal_words(plan.person.controller.plant),
    )


def _experiments(plan: Plan) -> Finding:
    """Every experiment and what it would say, as factors of the presumed cost weights (95 %)."""
    rows: list[dict[str, Any]] = []
    for item in plan.outcomes:
        best = [word for word, one in (("A-optimal", plan.best), ("D-optimal", plan.sharpest))
                if item is one]  # fmt: skip
        row = {
            "amplitude": float(item.design.amplitude),
            "dwell": float(item.design.dwell),
            "falls_percent": 100 * float(item.falls),
            "at_the_limit_percent": 100 * float(item.at_limit),
        }
        for index, name in enumerate(plan.person.structure.unknowns):
            interval = None if item.expected is None else item.expected.intervals[index]
            for end in ("low", "high"):
                away = np.nan if interval is None else getattr(interval, end) - interval.value
                row[f"{name}_{end}"] = float(np.exp(away))
            expected = item.expected
            error = np.nan if expected is None else float(expected.deviations[index])
            row[f"{name}_standard_error"] = error
        rows.append({**row, "best": ", ".join(best)})
    caption = (
        "Expected intervals of 95 %, as factors of the presumed cost weight, and standard errors "
        "of its "
        "logarithm; dwell in s."
    )
    return Finding("experiments", pd.DataFrame(rows), caption, digits=3)


def _best(plan: Plan) -> list[Finding]:
    expected, person = plan.best.expected, plan.person
    if expected is None:
        return []
    plant, truth, fits = person.controller.plant, np.array(person.controller.K), plan.simulated
    scatter = None if fits is None or len(fits.cost_weights) == 0 else spread(fits.cost_weights)
    cost_weights = table_of(
        range(len(person.structure.unknowns)),
        {
            "cost_weight_of": lambda k: person.structure.unknowns[k],
            "presumed": lambda k: math.exp(float(person.cost_weights[k])),
            "low": lambda k: math.exp(expected.intervals[k].low),
            "high": lambda k: math.exp(expected.intervals[k].high),
            "standard_error_of_the_logarithm": lambda k: float(expected.deviations[k]),
            "in_simulated_fits": lambda k: np.nan if scatter is None else float(scatter[k]),
        },
    )
    gains = table_of(
        [(i, j) for i in range(plant.m) for j in range(plant.n)],
        {
            "gain": lambda at: number_name(
                plant, f"K.{plant.controls[at[0]]}.{plant.states[at[1]]}"
            ),
            "unit": lambda at: gain_unit(plant, plant.controls[at[0]], plant.states[at[1]]),
            "presumed": lambda at: float(truth[at]),
            "half_an_interval": lambda at: 1.96 * float(expected.gain.entries[at]),
            "identified": lambda at: bool(expected.gain.individually_identified[at]),
        },
    )
    along = int(np.count_nonzero(expected.gain.identified))
    caption = (
        f"Gains fitted without a structure: {along} of {truth.size} directions would be identified "
        "to a fifth of their natural size. Half an interval is that of 95 %."
    )
    return [
        Finding(
            "cost_weights",
            cost_weights,
            "Cost weights, with one for the first command, 95 %.",
            digits=3,
        ),
        Finding("gain", gains, caption, digits=3),
    ]


def _groups(plan: Plan) -> Finding:
    settings = plan.settings
    powers = {
        f"power_with_{size}_a_group_percent": (lambda item, k=k: 100 * float(item.powers[k]))
        for k, size in enumerate(settings.groups)
    }
    table = table_of(
        plan.groups,
        {
            "cost_weight_of": lambda item: item.feature,
            "standard_deviation_within_a_group": lambda item: float(item.deviation),
            **powers,
            "persons_a_group_for_80_percent": lambda item: float(item.needed),
        },
    )
    caption = (
        f"Two groups whose cost weight differs by {settings.difference:g} %, t-test of the "
        "logarithms at "
        f"5 %; persons within a group differ by {settings.between:g} %."
    )
    return Finding("groups", table, caption, digits=3)


def _presumed(plan: Plan) -> tuple[Terms, ...]:
    person, plant = plan.person, plan.person.controller.plant
    noise = []
    for name, value in zip(plant.outputs, person.deviation, strict=True):
        factor, unit = shown_unit(plant, name)
        noise.append(f"{name}: {number(factor * float(value))} {unit}")
    cost_weights = [
        f"{name}: {number(math.exp(float(value)))}"
        for name, value in zip(person.structure.unknowns, person.cost_weights, strict=True)
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
                ("Cost weights", cost_weights),
                (f"Noise in the recorder, {kind}", noise),
                ("Limit", limits),
                ("Horizon", (f"{person.controller.horizon} samples of {plant.dt:g} s",)),
            ]
        ),
    )


def _data(plan: Plan) -> dict[str, Any]:
    person, expected, fits = plan.person, plan.best.expected, plan.simulated
    names = person.structure.unknowns
    found: dict[str, Any] = {
        "best": {"amplitude": plan.best.design.amplitude, "dwell": plan.best.design.dwell},
        "sharpest": {
            "amplitude": plan.sharpest.design.amplitude,
            "dwell": plan.sharpest.design.dwell,
        },
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
