"""Report of a plan."""

from __future__ import annotations

import itertools
import math
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from impc.assess.covariance import TWO_SIDED
from impc.reporting.document import Block, Checks, Report, Section, Terms
from impc.reporting.finding import Finding, Picture
from impc.reporting.shown_units import shown_unit, signal_name
from impc.reporting.style import BLUE, GREEN, HALF, INK, MUTED, PHONE, RULE, new_figure
from impc.studies.plan.sentences import (
    expected,
    listed,
    plan_checks,
    plan_copy,
    plan_keys,
    plan_verdict,
    stated_as,
    target,
    weight_names,
    widths,
)
from impc.studies.plan.study import spread

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from impc.reporting.provenance import Provenance
    from impc.studies.plan.study import Plan

_TRIALS = Picture(
    "trials",
    "Width of the interval of each cost weight over the number of trials, and the target",
    "How far an estimate may be from the truth (95 % interval, approximation). Lower is better. "
    "Dashed: difference to be detected.",
)
_LINES = ((BLUE, "o", "-"), (GREEN, "s", "--"), (INK, "^", ":"), (MUTED, "D", "-."))
# Height of a line of text relative to the axis; largest width that is drawn, %.
_LINE, _MOST = 0.07, 1e4


def plan_report(plan: Plan, provenance: Provenance) -> Report:
    """Report of `impc plan`."""
    count = plan.settings.trials
    return Report(
        "impc plan",
        "plan of an experiment",
        plan_verdict(plan),
        [
            Section("Cost weights", [_cost_weights(plan), *_body(plan)]),
            Section("Experiments", [_experiments(plan)]),
            Section("Groups", [_groups(plan)]),
            Section("Assumed person", [_person(plan)]),
            Section("Checks", [Checks(plan_checks(plan))]),
            Section("Provenance", [Terms(provenance.terms)]),
        ],
        meta=(
            "Simulated before anyone is measured",
            f"{count} trial{'s' * (count > 1)}",
            f"{len(plan.outcomes)} experiments simulated",
        ),
        hero=_TRIALS,
        keys=plan_keys(plan),
        figures={"trials": lambda narrow: _trials_figure(plan, narrow)},
        copy=plan_copy(plan),
        data=_data(plan),
        provenance=provenance,
    )


def _trials_figure(plan: Plan, narrow: bool) -> Figure:
    """Longer side of each interval over the number of trials."""
    figure = new_figure(PHONE if narrow else HALF, 3.6)
    ax = figure.subplots()
    counts, sides = widths(plan)
    with np.errstate(over="ignore"):
        shares = np.clip(100 * np.expm1(sides), 1e-3, None)
    shares[shares > _MOST] = np.nan
    aim, planned = 100 * math.expm1(target(plan)), plan.settings.trials
    known = [*shares[np.isfinite(shares)], aim]
    low, high = math.log(min(known) / 1.3), math.log(max(known) * 1.4)
    styles, least = list(itertools.islice(itertools.cycle(_LINES), len(shares.T))), -1.0
    for values, (color, marker, line) in zip(shares.T, styles, strict=True):
        ax.plot(counts, values, color=color, marker=marker, linestyle=line)
    names = weight_names(plan)
    for k in np.argsort(shares[-1])[: np.count_nonzero(np.isfinite(shares[-1]))]:
        # Names at the right ends of the curves, without overlap.
        least = max((math.log(shares[-1, k]) - low) / (high - low), least + _LINE)
        place = float(counts[-1]), math.exp(low + least * (high - low))
        ax.annotate(names[k], place, (7, 0), textcoords="offset points", va="center",
                    color=styles[k][0])  # fmt: skip
    ax.axhline(aim, color=INK, linewidth=1, linestyle=(0, (4, 3)))
    ax.annotate(f"target {aim:g} %", (counts[0], aim), (0, 4), textcoords="offset points")
    ax.axvline(planned, color=RULE, zorder=0)
    ax.annotate("planned", (planned, math.exp(high)), (4, -12), textcoords="offset points",
                color=MUTED)  # fmt: skip
    ax.set_xscale("log")
    ax.set_xticks(counts, [f"{count:g}" for count in counts], minor=False)
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.set_yscale("log")
    ax.set_ylim(math.exp(low), math.exp(high))
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.yaxis.set_minor_formatter(NullFormatter())
    ax.set_title("95 % interval of a cost weight, up to \u00b1 (%)")
    ax.set_xlabel("Trials of one person (count)")
    return figure


def _experiments(plan: Plan) -> Finding:
    """Table of experiments with expected 95 % intervals relative to the cost weights."""
    plant, names, rows = plan.person.controller.plant, plan.person.structure.unknowns, []
    marks = {"A-optimal": plan.best, "D-optimal": plan.sharpest}
    for item in plan.outcomes:
        ends, widest = np.full((len(names), 3), np.nan), math.nan
        if item.expected is not None:
            sides = [(one.low - one.value, one.high - one.value) for one in item.expected.intervals]
            ends = np.column_stack([np.exp(sides), item.expected.deviations])
            first_order = TWO_SIDED * ends[:, 2:]
            longer = np.where(np.isfinite(sides), np.abs(sides), first_order)
            with np.errstate(over="ignore"):
                widest = float(100 * np.expm1(np.max(longer)))
        row: dict[str, Any] = {
            "amplitude": float(item.design.amplitude),
            "dwell": float(item.design.dwell),
            "widest_interval_percent": widest,
            "falls_percent": 100 * float(item.falls),
            "at_the_limit_percent": 100 * float(item.at_limit),
            "smallest_vaf_percent": float(np.min(item.vaf)),
            "best": ", ".join(word for word, one in marks.items() if item is one),
        }
        for name, values in zip(names, ends, strict=True):
            heads = (f"{name}_{end}" for end in ("low", "high", "standard_error"))
            row |= dict(zip(heads, map(float, values), strict=True))
        rows.append(row)
    unit = shown_unit(plant, plant.disturbances[0])[1]
    return Finding(
        "experiments",
        pd.DataFrame(rows),
        "Widest interval: how far an estimate may be from the truth; an approximation if the "
        "interval has no end. A-optimal: smallest mean variance (selected). D-optimal: smallest "
        "joint confidence region.",
        digits=3,
        labels={
            "amplitude": "Factor" if plan.settings.files else f"Amplitude ({unit})",
            "dwell": "Held for (s)",
            "smallest_vaf_percent": "Attainable VAF (%)",
        },
        hidden=list(rows[0])[7:],
    )


def _cost_weights(plan: Plan) -> Finding:
    found, person, fits = expected(plan), plan.person, plan.simulated
    table = pd.DataFrame(
        {
            "cost_weight": weight_names(plan),
            "feature": person.structure.unknowns,
            "assumed": np.exp(person.cost_weights),
            "low": [math.exp(item.low) for item in found.intervals],
            "high": [math.exp(item.high) for item in found.intervals],
            "interval": [stated_as(item) for item in found.intervals],
            "standard_error_of_the_logarithm": np.array(found.deviations),
        }
    )
    if fits is not None and len(fits.cost_weights):
        table["in_simulated_fits"] = spread(fits.cost_weights)
    hidden = ["feature", "standard_error_of_the_logarithm"]
    if found.body is not None:
        own = {"with_an_exact_body": found.body.exact,
               "with_ten_times_the_trials": found.body.tenfold,
               "with_any_number_of_trials": found.body.floor}  # fmt: skip
        table = table.assign(**{name: np.array(values) for name, values in own.items()})
        hidden += list(own)
    return Finding(
        "cost_weights",
        table,
        "Expected 95 % intervals in the best experiment. The cost weight of "
        f"{signal_name(person.controller.plant, person.controller.plant.controls[0])} is 1.",
        digits=3,
        labels={
            "interval": "Relative to assumed",
            "in_simulated_fits": "Scatter in simulated fits (log)",
        },
        hidden=hidden,
    )


def _body(plan: Plan) -> list[Block]:
    """Table of the benefit of measuring body parameters, most useful first."""
    found, problem = expected(plan), plan.best.problem
    if found.body is None or problem is None:
        return []
    known, names = np.isfinite(found.deviations), plan.person.structure.unknowns
    exact, tenfold = (
        100 * float(np.mean(found.narrower(one)[known])) if np.any(known) else 0.0
        for one in (found.body.exact, found.body.tenfold)
    )
    shares = np.round(100 * found.narrower(found.body.measured), 1) + 0.0
    heads = [f"{name}_narrower_percent" for name in names]
    table = pd.DataFrame(shares, columns=heads)
    table.insert(0, "parameter", found.body.names)
    table.insert(1, "stated_percent", 100 * problem.parameter_units[problem.stated])
    words = (f"{name} (%)" for name in weight_names(plan))
    return [
        Finding(
            "body",
            table.iloc[np.argsort(-np.nanmean(shares, axis=1), kind="stable")],
            "Body: reduction of each interval if this parameter were known exactly. With an "
            f"exactly known body the intervals would be {exact:.0f} % narrower on average, with "
            f"ten times as many trials {tenfold:.0f} %.",
            digits=2,
            folded="Benefit of measuring each parameter of the body",
            labels={"stated_percent": "Stated (%)", **dict(zip(heads, words, strict=True))},
        ),
    ]


def _groups(plan: Plan) -> Finding:
    settings = plan.settings
    powers = [f"power_with_{size}_a_group_percent" for size in settings.groups]
    rows = [
        (name, item.feature, item.deviation, *(100 * np.array(item.powers)), item.needed)
        for item, name in zip(plan.groups, weight_names(plan), strict=True)
    ]
    heads = ["cost_weight", "feature", "standard_deviation_within_a_group", *powers,
             "persons_a_group_for_80_percent"]  # fmt: skip
    sizes = zip(powers, settings.groups, strict=True)
    return Finding(
        "groups",
        pd.DataFrame(rows, columns=heads),
        f"Power to detect a difference of {settings.difference:g} % between two groups whose "
        f"persons differ by {settings.between:g} % (SD; t-test at 5 %).",
        digits=3,
        labels={
            heads[2]: "SD within a group (log)",
            heads[-1]: "Persons per group for 80 %",
            **{key: f"{size} per group (%)" for key, size in sizes},
        },
        hidden=["feature"],
    )


def _person(plan: Plan) -> Terms:
    person, controller = plan.person, plan.person.controller
    plant, tau = controller.plant, plan.settings.correlation
    kind = f"correlated over {tau:g} s" if tau > 0 else "uncorrelated"
    limited = np.isfinite(controller.bounds.u_max)
    names = tuple(np.array(plant.controls)[limited])
    limit = listed(plan, names, controller.bounds.u_max[limited])
    terms = [
        ("Measurement noise", f"{listed(plan, plant.outputs, person.deviation)}; {kind}"),
        ("Prediction horizon", f"{controller.horizon * plant.dt:g} s"),
        ("Limit", limit or "none"),
    ]
    return Terms(terms)


def _data(plan: Plan) -> dict[str, Any]:
    person, found, fits = plan.person, expected(plan), plan.simulated
    names = person.structure.unknowns
    return {
        "best": asdict(plan.best.design),
        "sharpest": asdict(plan.sharpest.design),
        "presumed": dict(zip(names, np.exp(person.cost_weights), strict=True)),
        "gain": {"presumed": person.controller.K, "deviation": found.gain.entries},
        "limit_deviation": found.limits,
        "simulated": None
        if fits is None
        else {"fits": len(fits.cost_weights), "failed": fits.failed, "inside": fits.inside(found)},
    }
