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
from impc.reporting.finding import Finding, Picture
from impc.reporting.shown_units import shown_as
from impc.reporting.style import (
    BLUE,
    DOUBLE_COLUMN,
    FORBIDDEN,
    INK,
    SINGLE_COLUMN,
    VERMILLION,
    drawn,
    journal_style,
    new_figure,
)

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
_SOFT = "#8C8C8C"
_ONE_COLUMN = 6  # signals above each other; more stand in two columns
_FURTHEST = 30.0  # factor at which an interval is cut off
#: Under which name its numbers stand among the methods of result.json.
METHOD = "nonlinear_inverse_mpc"
_TOLD = (
    "A product that is told has one value whatever the others have. Along a direction that is not "
    "told the parameters may change together, by any factor a, and the recordings stay what they "
    "are. This is said of the neighbourhood of the answer."
)


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

    @property
    def status(self) -> Status:
        """How the search ended."""
        estimate = self.estimate
        recorded = [np.hstack([one.x[1:], one.u]) / estimate.scales for one in estimate.recordings]
        size = sum(float(np.nansum(item**2)) for item in recorded)
        if float(estimate.residual @ estimate.residual) <= _EXACT**2 * size:
            return Status.EXPLAINED
        return Status.SETTLED if estimate.settled else Status.STOPPED

    @property
    def names(self) -> tuple[str, ...]:
        """Of the states and the inputs, in this order."""
        problem = self.estimate.problem
        return (*problem.state_names, *problem.input_names)


def signal_vaf(estimate: OptimalControlEstimate) -> dict[str, float]:
    """(3.24) of each state and input over all recordings, %; NaN where nothing was measured."""
    problem = estimate.problem
    recorded = np.vstack([np.hstack([one.x[1:], one.u]) for one in estimate.recordings])
    simulated = np.vstack([np.hstack([x[1:], u]) for x, u in estimate.runs])
    size = np.nansum(recorded**2, axis=0)
    left = np.nansum((recorded - simulated) ** 2, axis=0)
    values = 100 * (1 - np.divide(left, size, out=np.full_like(size, np.nan), where=size > 0))
    names = (*problem.state_names, *problem.input_names)
    return dict(zip(names, map(float, values), strict=True))


def reached(estimate: OptimalControlEstimate) -> dict[str, tuple[int, int]]:
    """At how many samples each constraint of the path is at its limit, in the estimate's runs."""
    problem, theta, parts = estimate.problem, np.array([*estimate.theta.values()]), []
    for one, (x, u) in zip(estimate.recordings, estimate.runs, strict=True):
        repeated = np.repeat(theta[:, None], len(u), axis=1)
        parts.append(problem.functions[3].map(len(u))(x[:-1].T, u.T, one.d.T, repeated).full().T)
    values = np.vstack(parts).reshape(-1, len(problem.rows))
    size = np.max(np.abs(values), axis=0, initial=0.0)
    at_limit = values > -_AT_LIMIT * np.where(size > 0, size, 1.0)
    owners = np.array([row.partition("[")[0] for row in problem.rows])
    return {
        name: (int(at_limit[:, owners == name].any(axis=1).sum()), len(values))
        for name in dict.fromkeys(map(str, owners))
    }


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
    if not estimate.combinations.told:
        return "The recordings tell none of the parameters."
    ends = estimate.intervals().items()
    open_ones = [name for name, (low, high) in ends if not high - low < np.inf]
    if not open_ones:
        return (
            "The problem explains the recordings, which tell every parameter by itself, as far as "
            "the intervals say."
        )
    return (
        "The problem explains the recordings, but they do not tell all of its parameters: "
        f"{', '.join(open_ones)} may be others, alone or together, as the sentences below say."
    )


def abstract(fit: OptimalFit) -> tuple[str, ...]:
    """A few plain sentences with numbers: what was done, how well it agrees, what is told."""
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
    agree = [f"{value:.2f} % of {name}" for name, value in signal_vaf(estimate).items()
             if not np.isnan(value)]  # fmt: skip
    limits = [f"{name} at {at} of {of} samples" if at else f"{name} never"
              for name, (at, of) in reached(estimate).items()]  # fmt: skip
    return (
        f"An optimal control problem over {problem.horizon} samples{ahead} with "
        f"{len(estimate.theta)} unknown parameters{known} was fitted to {each} {kind}, "
        f"{samples} samples in all.",
        f"It accounts for {', '.join(agree)} (VAF).",
        *([f"Constraints at their limit: {', '.join(limits)}."] if limits else []),
        *estimate.combinations.sentences,
    )


def optimal_figures(fit: OptimalFit) -> dict[str, bytes]:
    """Draw all figures: PNG and PDF by file name."""
    with journal_style():
        figures = {
            f"trajectories-{index + 1}": _draw_run(fit, index)
            for index in range(min(len(fit.trials), MOST_TRIALS))
        }
        if _factors(fit):
            figures["parameters"] = _draw_intervals(fit)
        figures["singular-values"] = _draw_values(fit)
        return drawn(figures)


def _draw_run(fit: OptimalFit, index: int) -> Figure:
    estimate, names = fit.estimate, fit.names
    one, (x, u) = estimate.recordings[index], estimate.runs[index]
    columns = 1 if len(names) <= _ONE_COLUMN else 2
    rows = -(-len(names) // columns)
    figure = new_figure(DOUBLE_COLUMN, 0.6 + 1.05 * rows)
    axes = figure.subplots(rows, columns, sharex=True, squeeze=False).T.ravel()
    signals = [*zip(one.x.T, x.T, strict=True), *zip(one.u.T, u.T, strict=True)]
    for ax, name, (recorded, run) in zip(axes, names, signals, strict=False):
        factor, unit = shown_as(estimate.problem.signal_units.get(name, "-"))
        time = (fit.dt or 1.0) * np.arange(len(run))
        ax.plot(
            time, factor * recorded, color=_SOFT, marker="o", markersize=2.5,
            markerfacecolor="white", linewidth=1.2, label="recorded",
        )  # fmt: skip
        ax.plot(time, factor * run, color=VERMILLION, linestyle="--", label="simulated")
        ax.set_ylabel(f"{name} ({unit})")
    for ax in axes[len(names) :]:
        ax.set_visible(False)
    for ax in (axes[rows - 1], axes[len(names) - 1]):
        ax.set_xlabel("sample (-)" if fit.dt is None else "time (s)")
        ax.tick_params(labelbottom=True)
    axes[0].legend(loc="lower left", ncols=2, bbox_to_anchor=(0, 1.0))
    axes[0].set_title(fit.trials[index], loc="right")
    return figure


def _factors(fit: OptimalFit) -> dict[str, tuple[float, float]]:
    """Both ends over the value, of what is told and may be drawn as a factor, by its name."""
    told = fit.estimate.combinations.told
    return {
        one.name: interval(1.0, one.deviation, False, _LEVEL) for one in told if not one.difference
    }


def _draw_intervals(fit: OptimalFit) -> Figure:
    rows = _factors(fit)
    figure = new_figure(SINGLE_COLUMN, 0.7 + 0.24 * len(rows))
    ax = figure.subplots()
    for place, ends in enumerate(rows.values()):
        ax.plot(ends, [place, place], color=BLUE, linewidth=1.6)
        ax.plot(1.0, place, color=BLUE, marker="o", markerfacecolor="white")
    ax.axvline(1.0, color=INK, linewidth=0.6)
    reach = min(max(1.01, *(high for _, high in rows.values())) ** 1.1, _FURTHEST)
    ticks = [1 / reach, 1.0, reach]
    ax.set_xscale("log")
    ax.set_xlim(ticks[0], ticks[-1])
    ax.set_xticks(ticks, [f"{tick:.4g}" for tick in ticks])
    ax.minorticks_off()
    ax.set_yticks(range(len(rows)), list(rows))
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.set_xlabel("95 % interval over the value (-)")
    ax.set_ylabel("told (-)")
    return figure


def _draw_values(fit: OptimalFit) -> Figure:
    found = fit.estimate.combinations
    values = np.maximum(found.singular_values / found.singular_values[0], 1e-17)
    place, told = np.arange(1, len(values) + 1), len(found.told)
    figure = new_figure(SINGLE_COLUMN, 2.2)
    ax = figure.subplots()
    ax.plot(place[:told], values[:told], color=BLUE, marker="o", linestyle="", label="told")
    if found.untold:
        ax.axvspan(told + 0.5, len(values) + 0.5, color=FORBIDDEN, linewidth=0)
        ax.plot(
            place[told:], values[told:], color=VERMILLION, marker="s", markerfacecolor="white",
            linestyle="", label="not told",
        )  # fmt: skip
    ax.set_yscale("log")
    ax.set_ylim(0.3 * float(values[-1]), 3.0)
    ax.set_xticks(place)
    ax.set_xlabel("direction of the parameters (-)")
    ax.set_ylabel("singular value / largest (-)")
    ax.legend(loc="lower left")
    return figure


def optimal_report(fit: OptimalFit, provenance: Provenance) -> Report:
    """Page, result.json, parameters.csv, combinations.csv, trajectories.csv and figures."""
    checks = [(name, found or ("Nothing found.",))
              for name, found in zip(fit.trials, fit.findings, strict=True)]  # fmt: skip
    return Report(
        f"impc fit: {provenance.plant_name}",
        "The optimal control problem behind the recordings",
        (Verdict(verdict(fit)), Lines(abstract(fit))),
        [
            Section("1. The parameters", (_parameters(fit),), "Parameters", together=True),
            Section("2. What is told", (_TOLD, _combinations(fit)), "What is told"),
            Section("3. Recorded and simulated", _trajectories(fit), "Trajectories"),
            Section("4. Checks of the recordings", (Terms(checks),), "Checks", folded=True),
            Section("5. Settings and versions", _settings(fit, provenance), "Settings",
                    folded=True),
        ],
        figures=optimal_figures(fit),
        beside=[_samples(fit)],
        data=_data(fit, provenance),
        provenance=provenance,
    )  # fmt: skip


def _parameters(fit: OptimalFit) -> Finding:
    estimate = fit.estimate
    ends, found = estimate.intervals(_LEVEL), estimate.combinations
    told = {one.name: one.told for one in found.told}
    told |= {name: "no" for one in found.untold for name in one.exponents}
    units = zip(estimate.theta.items(), estimate.problem.units, strict=True)
    rows = [
        (name, unit, value, *ends[name], _LEVEL, told.get(name, "yes"), estimate.start[name])
        for (name, value), unit in units
    ]
    rows += [
        (name, unit, value, np.nan, np.nan, np.nan, "known", np.nan)
        for name, (value, unit) in fit.known.items()
    ]
    heads = ["parameter", "unit", "value", "low", "high", "level", "told", "start"]
    caption = (
        "Value with its 95 % interval, and where the search began. One that is not told by itself "
        "stays near its start; section 2 says what of it is told."
    )
    figure = Picture(
        "parameters",
        "Intervals of the parameters and products of parameters that the recordings tell",
        "Parameters, and products of them, that the recordings tell: 95 % intervals over the "
        "value. One that ends at the edge goes on.",
        narrow=True,
    )
    table = pd.DataFrame(rows, columns=heads)
    return Finding("parameters", table, caption, figure=figure if _factors(fit) else None)


def _combinations(fit: OptimalFit) -> Finding:
    found = fit.estimate.combinations
    free = {True: "any factor of these", False: "near these values"}
    rows = [
        (one.name, one.value, *interval(one.value, one.deviation, one.difference, _LEVEL), _LEVEL,
         one.told, free[one.scaling] if one.told == "no" else "")
        for one in (*found.told, *found.untold)
    ]  # fmt: skip
    heads = ["product", "value", "low", "high", "level", "told", "free"]
    caption = "Products of parameters with their 95 % intervals, in the problem's units."
    figure = Picture(
        "singular-values",
        "Singular values of the derivative of the recordings by the parameters, told and not told",
        "Singular values: how strongly the recordings move along each direction of the "
        "parameters. Round: told. Square, on grey: not told, because nothing that was measured "
        "moves.",
        narrow=True,
    )
    return Finding("combinations", pd.DataFrame(rows, columns=heads), caption, figure=figure)


def _trajectories(fit: OptimalFit) -> list[Block]:
    vaf = pd.DataFrame(signal_vaf(fit.estimate).items(), columns=["signal", "vaf_percent"])
    limits = [(name, *counts) for name, counts in reached(fit.estimate).items()]
    table = pd.DataFrame(limits, columns=["constraint", "at_its_limit", "samples"])
    at_limit = "At how many samples each constraint is at its limit."
    pictures = [
        Picture(
            f"trajectories-{index + 1}",
            f"Recorded and simulated states and inputs over time, {name}",
            f"{name}. Rings: recorded. Dashed: simulated from the first state alone.",
        )
        for index, name in enumerate(fit.trials[:MOST_TRIALS])
    ]
    return [
        Finding("vaf", vaf, "Variance accounted for (3.24), over all recordings.", digits=6),
        *([Finding("limits", table, at_limit)] if limits else []),
        pictures[0],
        *([Details("The other recordings", pictures[1:])] if pictures[1:] else []),
    ]


def _settings(fit: OptimalFit, provenance: Provenance) -> list[Block]:
    problem, estimate = fit.estimate.problem, fit.estimate
    arguments, settings = (
        "; ".join(f"{key} = {value}" for key, value in given.items())
        for given in (provenance.plant_arguments, fit.settings)
    )
    code = Markup("<code>{}</code>")
    sample = "not said" if fit.dt is None else f"{fit.dt:.6g} s"
    terms = {
        "Made": f"{provenance.made}, in {estimate.seconds:.1f} s of search",
        "Problem": code.format(f"{provenance.plant_name} {arguments}".strip()),
        "States, inputs": f"{', '.join(problem.state_names)}; {', '.join(problem.input_names)}",
        "Constraints": ", ".join(reached(estimate)) or "none",
        "Sample time, horizon": f"{sample}, {problem.horizon} samples",
        "Search": f"{estimate.evaluations} evaluations; {fit.status.value}",
        "Settings": code.format(settings),
        "Recordings": ", ".join(provenance.files),
        "Versions": provenance.all_versions,
    }
    return [code.format(provenance.command), Terms([(key, (of,)) for key, of in terms.items()])]


def _samples(fit: OptimalFit) -> Finding:
    """A row a sample: recorded and simulated signals, and disturbances."""
    problem, tables = fit.estimate.problem, []
    runs = zip(fit.estimate.recordings, fit.estimate.runs, strict=True)
    for index, (one, (x, u)) in enumerate([*runs][:MOST_TRIALS]):
        columns: dict[str, Any] = {"trial": index + 1.0}
        columns["sample" if fit.dt is None else "time"] = (fit.dt or 1.0) * np.arange(len(x))
        for names, recorded, run in (
            (problem.state_names, one.x, x),
            (problem.input_names, one.u, u),
        ):
            for kind, values in (("recorded", recorded), ("simulated", run)):
                columns |= {f"{name}_{kind}": pd.Series(item)
                            for name, item in zip(names, values.T, strict=True)}  # fmt: skip
        pairs = zip(problem.disturbance_names, one.d.T, strict=True)
        tables.append(pd.DataFrame(columns | {name: pd.Series(item) for name, item in pairs}))
    return Finding("trajectories", pd.concat(tables, ignore_index=True))


def _data(fit: OptimalFit, provenance: Provenance) -> dict[str, Any]:
    estimate, problem, found = fit.estimate, fit.estimate.problem, fit.estimate.combinations
    trials = zip(fit.trials, estimate.recordings, fit.findings, strict=True)
    return {
        "verdict": verdict(fit),
        "sentences": abstract(fit),
        "combinations": {
            kind: [
                {"name": one.name, "exponents": one.exponents, "value": one.value,
                 "deviation": one.deviation}
                for one in items
            ]
            for kind, items in (("told", found.told), ("untold", found.untold))
        },
        "singular_values": found.singular_values,
        "loss": estimate.loss,
        "x0": estimate.x0,
        "trials": [
            {"trial": name, "samples": len(one.u), "closed_loop": one.closed_loop, "findings": told}
            for name, one, told in trials
        ],
        "methods": {
            METHOD: {
                "status": fit.status.value,
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
            "constraints": list(reached(estimate)),
            "horizon": problem.horizon,
            "dt": fit.dt,
        },
        "settings": dict(fit.settings),
    }  # fmt: skip
