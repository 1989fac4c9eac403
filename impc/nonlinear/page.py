"""The page of a problem's fit: sentences, tables, figures, result.json (docs/nonlinear.md)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from impc.arrays import Frozen
from impc.inverse.estimates import Status
from impc.nonlinear.combinations import interval
from impc.reporting.document import Block, Details, Lines, Report, Section, Terms, Verdict
from impc.reporting.finding import Chart, Finding, Picture
from impc.reporting.rendering import plain
from impc.reporting.shown_units import shown_as
from impc.reporting.style import BLUE, INK, SINGLE_COLUMN, drawn, journal_style, new_figure
from impc.studies.charts import chart_figure

if TYPE_CHECKING:
    from collections.abc import Mapping

    from matplotlib.figure import Figure

    from impc.nonlinear.fit import OptimalControlEstimate
    from impc.reporting.provenance import Provenance

#: Recordings that are drawn, the first ones.
MOST_TRIALS = 6
# Of the largest value that a row has: nearer to zero it is at its limit. An active row with a
# multiplier of lam is kept at a distance of 1e-10 / lam.
_AT_LIMIT = 1e-5
_EXACT = 1e-9
_LITTLE = 50.0  # % of a signal below which a fit explains less than it leaves
_LEVEL = 0.95
_FURTHEST = 30.0  # factor at which an interval is cut off
#: Under which name its numbers stand among the methods of result.json.
METHOD = "nonlinear_inverse_mpc"
_CURVES = [
    {"label": "recorded", "color": "#8C8C8C", "dash": ""},
    {"label": "simulated", "color": "#D55E00", "dash": "6 3"},
]


@dataclass(frozen=True, eq=False)
class OptimalFit(Frozen):
    """An estimate, and where its recordings come from."""

    estimate: OptimalControlEstimate
    trials: tuple[str, ...]  # A name for each recording
    findings: tuple[tuple[str, ...], ...]  # What the checks of each let pass
    dt: float | None = None  # Sample time, s; None where nobody says it
    # Parameters that were not searched: value and unit
    known: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)  # As the user gave them


def signal_vaf(estimate: OptimalControlEstimate) -> dict[str, float]:
    """(3.24) of each state and input over all recordings, %; NaN where nothing was measured."""
    recorded = np.vstack([np.hstack([one.x[1:], one.u]) for one in estimate.recordings])
    simulated = np.vstack([np.hstack([x[1:], u]) for x, u in estimate.runs])
    size = np.nansum(recorded**2, axis=0)
    left = np.nansum((recorded - simulated) ** 2, axis=0)
    values = 100 * (1 - np.divide(left, size, out=np.full_like(size, np.nan), where=size > 0))
    names = (*estimate.problem.state_names, *estimate.problem.input_names)
    return dict(zip(names, map(float, values), strict=True))


def reached(estimate: OptimalControlEstimate) -> pd.DataFrame:
    """At how many samples each constraint of the path is at its limit, in the estimate's runs."""
    rows, theta = estimate.problem.rows, list(estimate.theta.values())
    values = np.array([
        estimate.problem.functions[3](*sample, theta).full().ravel()
        for one, (x, u) in zip(estimate.recordings, estimate.runs, strict=True)
        for sample in zip(x[:-1], u, one.d, strict=True)
    ])  # fmt: skip
    size = np.max(np.abs(values), axis=0, initial=1e-300)
    at_limit = pd.DataFrame(values > -_AT_LIMIT * size)
    owners = at_limit.T.groupby([row.partition("[")[0] for row in rows], sort=False)
    counts = owners.any().sum(axis=1)
    return pd.DataFrame(
        {"constraint": counts.index, "at_its_limit": counts.to_numpy(), "samples": len(values)}
    )


def verdict(fit: OptimalFit) -> str:
    """The one sentence that says what may be made of the fit; what forbids most comes first."""
    estimate = fit.estimate
    poor = [name for name, value in signal_vaf(estimate).items() if value < _LITTLE]
    if not estimate.settled:
        return (
            "The search ended before it converged: begin nearer, or allow it more evaluations; "
            "its parameters are not an answer."
        )
    if poor:
        return (
            f"The problem explains less than half of {', '.join(poor)}: its equations, its cost or "
            "its limits are not those of the recordings."
        )
    if not estimate.combinations.identified:
        return "The recordings identify none of the parameters."
    ends = estimate.intervals().items()
    open_ones = [name for name, (low, high) in ends if not high - low < np.inf]
    if not open_ones:
        return (
            "The problem explains the recordings, which identify every parameter by itself, as far "
            "as the intervals say."
        )
    return (
        "The problem explains the recordings, but they do not identify all of its parameters: "
        f"{', '.join(open_ones)} may be others, alone or together, as the sentences below say."
    )


def abstract(fit: OptimalFit) -> tuple[str, ...]:
    """A few plain sentences with numbers: what was done, and what is identified."""
    estimate, problem = fit.estimate, fit.estimate.problem
    count, loops = len(estimate.recordings), sum(one.closed_loop for one in estimate.recordings)
    samples = sum(len(one.u) for one in estimate.recordings)
    each = "one recording" if count == 1 else f"{count} recordings"
    kind = {
        0: "of one plan" if count == 1 else "of one plan each",
        count: "of a controller that plans anew at every sample",
    }.get(loops, f"of which {loops} are of a controller that plans anew at every sample")
    ahead = "" if fit.dt is None else f" ({problem.horizon * fit.dt:.3g} s)"
    known = f" (and {len(fit.known)} known)" if fit.known else ""
    return (
        f"An optimal control problem over {problem.horizon} samples{ahead} with "
        f"{len(estimate.theta)} unknown parameters{known} was fitted to {each} {kind}, "
        f"{samples} samples in all.",
        *estimate.combinations.sentences,
    )


def optimal_report(fit: OptimalFit, provenance: Provenance) -> Report:
    """Page, result.json, parameters.csv, combinations.csv, trajectories.csv and figures."""
    estimate, shown = fit.estimate, fit.trials[:MOST_TRIALS]
    charts = {f"trajectories-{k + 1}": _trajectories(fit, k) for k in range(len(shown))}
    with journal_style():
        figures = {name: chart_figure(chart, 2) for name, chart in charts.items()}
        figures["parameters"] = _draw_intervals(fit)
        files = drawn(figures)
    pictures = [
        Chart(Picture(name, f"Recorded and simulated states and inputs over time, {trial}",
                      f"{trial}. Dashed: simulated from the first state alone."), chart)
        for (name, chart), trial in zip(charts.items(), shown, strict=True)
    ]  # fmt: skip
    vaf = pd.DataFrame(signal_vaf(estimate).items(), columns=["signal", "vaf_percent"])
    at_limit = "At how many samples each constraint is at its limit."
    agreement: list[Block] = [
        Finding("vaf", vaf, "Variance accounted for (VAF, 3.24), over all recordings.", digits=6),
        *([Finding("limits", reached(estimate), at_limit)] if estimate.problem.rows else []),
        pictures[0],
        *([Details("The other recordings", pictures[1:])] if pictures[1:] else []),
    ]
    meaning = (
        "A product that is identified has one value whatever the others have. Along a direction "
        "that is not the parameters may change together, and the recordings stay what they are."
    )
    checks = [(name, found or ("Nothing found.",))
              for name, found in zip(fit.trials, fit.findings, strict=True)]  # fmt: skip
    arguments = (f"{key} = {value}" for key, value in provenance.plant_arguments.items())
    code, settings = Markup("<code>{}</code>"), fit.settings.items()
    made = {
        "Command": code.format(provenance.command),
        "Made": f"{provenance.made}, in {estimate.seconds:.1f} s of search",
        "Problem": code.format("; ".join((provenance.plant_name, *arguments))),
        "Search": f"{estimate.evaluations} evaluations; {_status(estimate).value}",
        "Settings": code.format("; ".join(f"{key} = {value}" for key, value in settings)),
        "Recordings": ", ".join(provenance.files),
        "Versions": provenance.all_versions,
    }
    terms = Terms([(key, (words,)) for key, words in made.items()])
    return Report(
        f"impc fit: {provenance.plant_name}",
        "The optimal control problem behind the recordings",
        (Verdict(verdict(fit)), Lines(abstract(fit))),
        [
            Section("1. The parameters", (_parameters(fit),), "Parameters", together=True),
            Section("2. What is identified", (meaning, _combinations(fit)), "What is identified"),
            Section("3. Recorded and simulated", agreement, "Trajectories"),
            Section("4. Checks of the recordings", (Terms(checks),), "Checks", folded=True),
            Section("5. Settings and versions", (terms,), "Settings", folded=True),
        ],
        figures=files,
        beside=[_samples(fit)],
        data=_data(fit, provenance),
        provenance=provenance,
    )  # fmt: skip


def _status(estimate: OptimalControlEstimate) -> Status:
    """How the search ended."""
    recorded = [np.hstack([one.x[1:], one.u]) / estimate.scales for one in estimate.recordings]
    size = sum(float(np.nansum(item**2)) for item in recorded)
    if float(estimate.residual @ estimate.residual) <= _EXACT**2 * size:
        return Status.EXPLAINED
    return Status.SETTLED if estimate.settled else Status.STOPPED


def _trajectories(fit: OptimalFit, index: int) -> dict[str, Any]:
    """Recorded and simulated signals, as `impc.studies.charts` has curves."""
    problem, one = fit.estimate.problem, fit.estimate.recordings[index]
    x, u = fit.estimate.runs[index]
    pairs = [*zip(one.x.T, x.T, strict=True), *zip(one.u.T, u.T, strict=True)]
    panels = []
    for name, pair in zip((*problem.state_names, *problem.input_names), pairs, strict=True):
        factor, unit = shown_as(problem.units.get(name, "-"))
        curves = [factor * values for values in pair]
        panels.append({"label": f"{name} ({unit})", "bounds": [], "curves": curves})
    label = "sample (-)" if fit.dt is None else "time (s)"
    title = f"Recorded and simulated, {fit.trials[index]}"
    chart = {"title": title, "label": label, "step": fit.dt or 1.0, "curves": _CURVES}
    return dict(plain({**chart, "panels": panels}))


def _draw_intervals(fit: OptimalFit) -> Figure:
    rows = {one.name: interval(1.0, one.deviation, False, _LEVEL)
            for one in fit.estimate.combinations.identified if not one.difference}  # fmt: skip
    figure = new_figure(SINGLE_COLUMN, 0.7 + 0.24 * len(rows))
    ax = figure.subplots()
    for place, ends in enumerate(rows.values()):
        ax.plot(ends, [place, place], color=BLUE, linewidth=1.6)
        ax.plot(1.0, place, color=BLUE, marker="o", markerfacecolor="white")
    ax.axvline(1.0, color=INK, linewidth=0.6)
    reach = min(max(1.01, *(high for _, high in rows.values()), 1.0) ** 1.1, _FURTHEST)
    ticks = [1 / reach, 1.0, reach]
    ax.set_xscale("log")
    ax.set_xlim(ticks[0], ticks[-1])
    ax.set_xticks(ticks, [f"{tick:.4g}" for tick in ticks])
    ax.minorticks_off()
    ax.set_yticks(range(len(rows)), list(rows))
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.set_xlabel("95 % interval over the value (-)")
    ax.set_ylabel("identified (-)")
    return figure


def _parameters(fit: OptimalFit) -> Finding:
    estimate, units = fit.estimate, fit.estimate.problem.units
    ends, found = estimate.intervals(_LEVEL), estimate.combinations
    identified = {one.name: one.identified for one in found.identified}
    identified |= {name: "no" for one in found.unidentified for name in one.exponents}
    rows = [
        (name, units.get(name, ""), value, *ends[name], _LEVEL, identified.get(name, "yes"),
         estimate.start[name])
        for name, value in estimate.theta.items()
    ]  # fmt: skip
    rows += [
        (name, unit, value, np.nan, np.nan, np.nan, "known", np.nan)
        for name, (value, unit) in fit.known.items()
    ]
    heads = ["parameter", "unit", "value", "low", "high", "level", "identified", "start"]
    caption = (
        "Value with its 95 % interval, and where the search began. One that is not individually "
        "identified stays near its start; section 2 says what of it is identified."
    )
    figure = Picture(
        "parameters",
        "Intervals of the parameters and products of parameters that the recordings identify",
        "Parameters, and products of them, that the recordings identify: 95 % intervals over the "
        "value. One that ends at the edge goes on.",
        narrow=True,
    )
    return Finding("parameters", pd.DataFrame(rows, columns=heads), caption, figure=figure)


def _combinations(fit: OptimalFit) -> Finding:
    found = fit.estimate.combinations
    free = {True: "any factor of these", False: "near these values"}
    rows = [
        (one.name, one.value, *interval(one.value, one.deviation, one.difference, _LEVEL), _LEVEL,
         one.identified, free[one.scaling] if one.identified == "no" else "")
        for one in (*found.identified, *found.unidentified)
    ]  # fmt: skip
    heads = ["product", "value", "low", "high", "level", "identified", "free"]
    caption = "Products of parameters with their 95 % intervals, in the problem's units."
    return Finding("combinations", pd.DataFrame(rows, columns=heads), caption)


def _samples(fit: OptimalFit) -> Finding:
    """A row a sample: recorded and simulated signals, and disturbances."""
    problem, tables = fit.estimate.problem, []
    names = {"x": problem.state_names, "u": problem.input_names, "d": problem.disturbance_names}
    runs = zip(fit.estimate.recordings, fit.estimate.runs, strict=True)
    for index, (one, (x, u)) in enumerate([*runs][:MOST_TRIALS]):
        time = pd.DataFrame({
            "trial": index + 1.0,
            "sample" if fit.dt is None else "time": (fit.dt or 1.0) * np.arange(len(x)),
        })  # fmt: skip
        blocks = [("x", one.x, "_recorded"), ("x", x, "_simulated"), ("u", one.u, "_recorded"),
                  ("u", u, "_simulated"), ("d", one.d, "")]  # fmt: skip
        parts = [pd.DataFrame(values, columns=names[kind]).add_suffix(end)
                 for kind, values, end in blocks]  # fmt: skip
        tables.append(pd.concat([time, *parts], axis=1))
    return Finding("trajectories", pd.concat(tables, ignore_index=True))


def _data(fit: OptimalFit, provenance: Provenance) -> dict[str, Any]:
    estimate, problem, found = fit.estimate, fit.estimate.problem, fit.estimate.combinations
    trials = zip(fit.trials, estimate.recordings, fit.findings, strict=True)
    return {
        "verdict": verdict(fit),
        "sentences": abstract(fit),
        "combinations": {
            kind: [{key: getattr(one, key) for key in ("name", "exponents", "value", "deviation")}
                   for one in getattr(found, kind)]
            for kind in ("identified", "unidentified")
        },
        "singular_values": found.singular_values,
        "loss": estimate.loss,
        "x0": estimate.x0,
        "trials": [
            {"trial": name, "samples": len(one.u), "closed_loop": one.closed_loop, "findings": said}
            for name, one, said in trials
        ],
        "methods": {
            METHOD: {
                "status": _status(estimate).value,
                "misfit": float(np.linalg.norm(estimate.residual)),
                "evaluations": estimate.evaluations,
                "seconds": estimate.seconds,
                "vaf": signal_vaf(estimate),
            }
        },
        "problem": {
            "name": provenance.plant_name,
            "arguments": dict(provenance.plant_arguments),
            "states": problem.state_names,
            "inputs": problem.input_names,
            "disturbances": problem.disturbance_names,
            "horizon": problem.horizon,
            "dt": fit.dt,
        },
        "settings": dict(fit.settings),
    }  # fmt: skip
