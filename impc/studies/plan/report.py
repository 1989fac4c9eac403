"""Report of a plan."""

from __future__ import annotations

import itertools
import math
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from impc.assess.covariance import TWO_SIDED
from impc.reporting.document import Block, Checks, Report, Section, Terms
from impc.reporting.finding import Finding, Picture, table_of
from impc.reporting.provenance import Provenance
from impc.reporting.shown_units import shown_unit
from impc.reporting.style import BLUE, GREEN, HALF, INK, MUTED, RULE, new_figure, plain_log
from impc.studies.fit.facts import with_unit
from impc.studies.plan import sentences
from impc.studies.plan.designs import gain_places, relative_errors
from impc.studies.plan.study import Plan, spread

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_TRIALS = Picture(
    "trials",
    "Width of the interval of each gain over the number of trials, and the target",
    "How far an estimate may be from the truth (95 % interval). Lower is better; "
    "without a point: not determined. Dashed: difference to be detected.",
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
        sentences.RULES.verdict(sentences.Facts(plan)),
        [
            Section("Gains", [_gains(plan), *_body(plan)]),
            Section("Experiments", [_experiments(plan)]),
            Section("Groups", [_groups(plan)]),
            Section("Assumed person", [_person(plan)]),
            Section("Checks", [Checks(sentences.plan_checks(plan))]),
            Section("Provenance", [Terms(provenance.terms)]),
        ],
        meta=(
            "Simulated before anyone is measured",
            f"{count} trial{'s' * (count > 1)}",
            f"{len(plan.outcomes)} experiments simulated",
        ),
        hero=_TRIALS,
        keys=sentences.plan_keys(plan),
        figures={"trials": lambda: _trials_figure(plan)},
        copy=sentences.plan_copy(plan),
        data=_data(plan),
        provenance=provenance,
    )


def _trials_figure(plan: Plan) -> Figure:
    """Half width of each interval over the number of trials."""
    figure = new_figure(HALF, 3.6)
    ax = figure.subplots()
    counts, sides = sentences.widths(plan)
    shares = np.clip(100 * sides, 1e-3, None)
    shares[shares > _MOST] = np.nan
    aim, planned = 100 * sentences.target(plan), plan.settings.trials
    known = [*shares[np.isfinite(shares)], aim]
    low, high = math.log(min(known) / 1.3), math.log(max(known) * 1.4)
    styles, least = list(itertools.islice(itertools.cycle(_LINES), len(shares.T))), -1.0
    for values, (color, marker, line) in zip(shares.T, styles, strict=True):
        ax.plot(counts, values, color=color, marker=marker, linestyle=line)
    names = sentences.gain_names(plan)
    for k in np.argsort(shares[-1])[: np.count_nonzero(np.isfinite(shares[-1]))]:
        # Names at the right ends of the curves, without overlap.
        least = max((math.log(shares[-1, k]) - low) / (high - low), least + _LINE)
        place = float(counts[-1]), math.exp(low + least * (high - low))
        ax.annotate(names[k], place, (7, 0), textcoords="offset points", va="center",
                    color=styles[k][0])  # fmt: skip
    ax.axhline(aim, color=INK, linewidth=1, linestyle=(0, (4, 3)))
    ax.annotate(f"target {aim:g} %", (counts[0], aim), (0, 4), textcoords="offset points")
    ax.axvline(planned, color=RULE, zorder=0)
    ax.annotate("planned", (planned, math.exp(low)), (4, 5), textcoords="offset points",
                color=MUTED)  # fmt: skip
    ax.set_xscale("log")
    ax.set_xticks(counts, [f"{count:g}" for count in counts], minor=False)
    ax.xaxis.minorticks_off()
    ax.set_yscale("log")
    ax.set_ylim(math.exp(low), math.exp(high))
    plain_log(ax.yaxis)
    ax.set_title("95 % interval of a gain, \u00b1 (%)")
    ax.set_xlabel("Trials of one person (count)")
    return figure


def _experiments(plan: Plan) -> Finding:
    """Table of experiments with expected 95 % intervals relative to the gains."""
    plant, shown = plan.person.controller.plant, sentences.shown_gains(plan)
    unknown = np.full(np.shape(plan.person.controller.K), np.nan)
    sides = 100 * TWO_SIDED * np.array([
        relative_errors(plan.person, unknown if item.expected is None else item.expected.deviations)
        for item in plan.outcomes
    ])  # fmt: skip
    table = table_of(
        zip(plan.outcomes, sides, strict=True),
        {
            "amplitude": lambda row: float(row[0].design.amplitude),
            "dwell": lambda row: float(row[0].design.dwell),
            "widest_interval_percent": lambda row: float(np.max(row[1])),
            "falls_percent": lambda row: 100 * float(row[0].falls),
            "at_the_limit_percent": lambda row: 100 * float(row[0].at_limit),
            "smallest_vaf_percent": lambda row: float(np.min(row[0].vaf)),
            "selected": lambda row: row[0] is plan.best,
        },
    )
    each = [f"{one.key}_percent" for one in shown]
    table[each] = sides
    unit = shown_unit(plant, plant.disturbances[0])[1]
    return Finding(
        "experiments",
        table,
        "Widest interval: how far an estimate of a gain may be from the truth. Selected: smallest "
        "mean variance of the gains.",
        digits=3,
        labels={
            "amplitude": "Factor" if plan.settings.files else f"Amplitude ({unit})",
            "dwell": "Held for (s)",
            "widest_interval_percent": "Widest interval, \u00b1 (%)",
            "smallest_vaf_percent": "Attainable VAF (%)",
        },
        hidden=each,
    )


def _gains(plan: Plan) -> Finding:
    """Table of the assumed gains with their expected intervals, in shown units."""
    found, fits, rows = sentences.expected(plan), plan.simulated, sentences.shown_gains(plan)
    plant, K = plan.person.controller.plant, np.array(plan.person.controller.K)
    commands = [shown_unit(plant, one.control) for one in rows]
    states = [shown_unit(plant, one.state) for one in rows]
    scales = [of[0] / per[0] for of, per in zip(commands, states, strict=True)]
    table = pd.DataFrame(
        {
            "gain": sentences.gain_names(plan),
            "for_every": [with_unit("1", unit) for _, unit in states],
            "assumed": K[gain_places(plant)] * scales,
            "unit": [unit for _, unit in commands],
            "interval": list(map(sentences.stated_as, sentences.halves(plan).tolist())),
            "standard_error_percent": 100 * relative_errors(plan.person, found.deviations),
        }
    )
    hidden = ["standard_error_percent"]
    if fits is not None and len(fits.gains):
        scatter = relative_errors(plan.person, spread(fits.gains))
        table["scatter_in_simulated_fits_percent"] = 100 * scatter
    if found.exact is not None:
        for name, errors in (
            ("an_exact_body", found.exact),
            ("ten_times_the_trials", found.by_trials[-1]),
        ):
            table[f"with_{name}_percent"] = 100 * relative_errors(plan.person, np.array(errors))
            hidden.append(f"with_{name}_percent")
    return Finding(
        "gains",
        table,
        "Opposing command for a unit of each state, with the expected 95 % interval in the best "
        "experiment.",
        digits=3,
        labels={"gain": "Gain on", "interval": "95 % interval"},
        hidden=hidden,
    )


def _body(plan: Plan) -> list[Block]:
    """Table of the benefit of measuring body parameters, most useful first."""
    found, problem, person = sentences.expected(plan), plan.best.problem, plan.person
    if found.exact is None or problem is None or problem.family is None:
        return []
    now, exact, tenfold = (
        relative_errors(person, np.array(errors))
        for errors in (found.deviations, found.exact, found.by_trials[-1])
    )
    known = np.isfinite(now)
    shares = [
        100 * float(np.mean(1 - other[known] / now[known])) if np.any(known) else 0.0
        for other in (exact, tenfold)
    ]
    plant = person.controller.plant
    each = np.round(100 * found.narrower[gain_places(plant)].T, 1) + 0.0
    heads = [f"{one.key}_narrower_percent" for one in sentences.shown_gains(plan)]
    table = pd.DataFrame(each, columns=heads)
    table.insert(0, "parameter", np.array(problem.parameter_names)[problem.stated])
    table.insert(1, "stated_percent", 100 * problem.parameter_units[problem.stated])
    words = (f"{name} (%)" for name in sentences.gain_names(plan))
    return [
        Finding(
            "body",
            table.iloc[np.argsort(-np.nanmean(each, axis=1), kind="stable")],
            "Body: reduction of each interval if this parameter were known exactly. With an "
            f"exactly known body the intervals would be {shares[0]:.0f} % narrower on average, "
            f"with ten times as many trials {shares[1]:.0f} %.",
            digits=2,
            folded="Benefit of measuring each parameter of the body",
            labels={"stated_percent": "Stated (%)", **dict(zip(heads, words, strict=True))},
        ),
    ]


def _groups(plan: Plan) -> Finding:
    settings = plan.settings
    powers = [f"power_with_{size}_a_group_percent" for size in settings.groups]
    rows = [
        (name, 100 * item.deviation, *(100 * np.array(item.powers)), item.needed)
        for item, name in zip(plan.groups, sentences.gain_names(plan), strict=True)
    ]
    heads = ["gain", "deviation_in_a_group_percent", *powers, "persons_a_group_for_80_percent"]
    sizes = zip(powers, settings.groups, strict=True)
    return Finding(
        "groups",
        pd.DataFrame(rows, columns=heads),
        f"Power to detect a difference of {settings.difference:g} % between two groups whose "
        f"persons differ by {settings.between:g} % (SD; t-test at 5 %).",
        digits=3,
        labels={
            "gain": "Gain on",
            heads[1]: "SD in a group (%)",
            heads[-1]: "Persons per group for 80 %",
            **{key: f"{size} per group (%)" for key, size in sizes},
        },
    )


def _person(plan: Plan) -> Terms:
    person, controller = plan.person, plan.person.controller
    plant, tau = controller.plant, plan.settings.correlation
    kind = f"correlated over {tau:g} s" if tau > 0 else "uncorrelated"
    limited = np.isfinite(controller.bounds.u_max)
    names = tuple(np.array(plant.controls)[limited])
    limit = sentences.listed(plan, names, controller.bounds.u_max[limited])
    terms = [
        ("Measurement noise", f"{sentences.listed(plan, plant.outputs, person.deviation)}; {kind}"),
        ("Prediction horizon", f"{controller.horizon * plant.dt:g} s"),
        ("Limit", limit or "none"),
    ]
    return Terms(terms)


def _data(plan: Plan) -> dict[str, Any]:
    person, found, fits = plan.person, sentences.expected(plan), plan.simulated
    simulated = None
    if fits is not None:
        inside = fits.inside(person, found)
        simulated = {"fits": len(fits.gains), "failed": fits.failed, "inside": inside}
    return {
        "best": asdict(plan.best.design),
        "K": person.controller.K,
        "standard_errors": found.deviations,
        "limit_deviation": found.limits,
        "simulated": simulated,
    }
