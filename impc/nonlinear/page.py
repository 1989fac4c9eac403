"""The page of a problem's fit: sentences, tables, figures, result.json (docs/nonlinear.md)."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from impc.arrays import Frozen
from impc.assess.covariance import TWO_SIDED
from impc.inverse.estimates import Status
from impc.reporting.document import Block, Details, Lines, Report, Section, Terms, Verdict
from impc.reporting.finding import Finding, Picture, table_of
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

    from impc.nonlinear.combinations import Combination
    from impc.nonlinear.fit import OptimalControlEstimate
    from impc.reporting.provenance import Provenance

#: Recordings that are drawn, the first ones.
MOST_TRIALS = 6
# Of the largest value that a row has: nearer to zero it is at its limit. An active row with a
# multiplier of lam is kept at a distance of 1e-10 / lam.
_AT_LIMIT = 1e-5
_EXACT = 1e-9


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
    found = {}
    for k, name in enumerate((*problem.state_names, *problem.input_names)):
        kept = np.isfinite(recorded[:, k])
        size = float(np.sum(recorded[kept, k] ** 2))
        left = float(np.sum((recorded[kept, k] - simulated[kept, k]) ** 2))
        found[name] = 100 * (1 - left / size) if size > 0 else np.nan
    return found


def row_name(row: str) -> str:
    """The name of the constraint that a row is of: "force" of "force[0]"."""
    return row.rpartition("[")[0] if row.endswith("]") else row


def reached(estimate: OptimalControlEstimate) -> dict[str, tuple[int, int]]:
    """At how many samples each constraint of the path is at its limit, in the estimate's runs."""
    problem, theta, parts = estimate.problem, list(estimate.theta.values()), []
    for one, (x, u) in zip(estimate.recordings, estimate.runs, strict=True):
        repeated = np.repeat(np.array(theta)[:, None], len(u), axis=1)
        parts.append(problem.functions[3].map(len(u))(x[:-1].T, u.T, one.d.T, repeated).full().T)
    values = np.vstack(parts).reshape(-1, len(problem.rows))
    size = np.max(np.abs(values), axis=0, initial=0.0)
    at_limit = values > -_AT_LIMIT * np.where(size > 0, size, 1.0)
    names = np.array([row_name(row) for row in problem.rows])
    return {
        name: (int(at_limit[:, names == name].any(axis=1).sum()), len(values))
        for name in dict.fromkeys(map(str, names))
    }


# % of a signal below which a fit explains less than it leaves.
_LITTLE = 50.0


def verdict(fit: OptimalFit) -> str:
    """The one sentence that says what may be made of the fit; what forbids most comes first."""
    estimate, told = fit.estimate, fit.estimate.combinations
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
    if not told.told:
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
    """A few plain sentences with numbers."""
    return (
        _what_was_done(fit),
        _agreement(fit),
        *_at_the_limit(fit),
        *fit.estimate.combinations.sentences,
    )


def _what_was_done(fit: OptimalFit) -> str:
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
        f"{samples} samples in all."
    )


def _agreement(fit: OptimalFit) -> str:
    parts = [
        f"{value:.2f} % of {name}"
        for name, value in signal_vaf(fit.estimate).items()
        if not np.isnan(value)
    ]
    return f"It accounts for {', '.join(parts)} (VAF)."


def _at_the_limit(fit: OptimalFit) -> list[str]:
    parts = [
        f"{name} at {samples} of {of} samples" if samples else f"{name} never"
        for name, (samples, of) in reached(fit.estimate).items()
    ]
    return [f"Constraints at their limit: {', '.join(parts)}."] if parts else []


_SOFT = "#8C8C8C"
_ONE_COLUMN = 6  # signals above each other; more stand in two columns
# Factors beyond which an interval is drawn with an arrow.
_FURTHEST = 30.0
_LONGEST = 45  # characters of a legend


def optimal_figures(fit: OptimalFit) -> dict[str, bytes]:
    """Draw all figures: PNG and PDF by file name."""
    with journal_style():
        figures = {
            f"trajectories-{index + 1}": _draw_run(fit, index)
            for index in range(min(len(fit.trials), MOST_TRIALS))
        }
        if interval_rows(fit):
            figures["parameters"] = _draw_intervals(fit)
        figures["singular-values"] = _singular_values(fit)
        return drawn(figures)


def _draw_run(fit: OptimalFit, index: int) -> Figure:
    estimate, names = fit.estimate, fit.names
    one, (x, u) = estimate.recordings[index], estimate.runs[index]
    columns = 1 if len(names) <= _ONE_COLUMN else 2
    rows = -(-len(names) // columns)
    figure = new_figure(DOUBLE_COLUMN, 0.6 + 1.05 * rows)
    axes = figure.subplots(rows, columns, sharex=True, squeeze=False).T.ravel()
    step = 1.0 if fit.dt is None else fit.dt
    for k, name in enumerate(names):
        recorded, run = (one.x, x) if k < len(x[0]) else (one.u, u)
        column = k if k < len(x[0]) else k - len(x[0])
        factor, unit = shown_as(estimate.problem.signal_units.get(name, "-"))
        time, ax = step * np.arange(len(run)), axes[k]
        ax.plot(
            time, factor * recorded[:, column], color=_SOFT, marker="o", markersize=2.5,
            markerfacecolor="white", linewidth=1.2, label="recorded",
        )  # fmt: skip
        ax.plot(
            time, factor * run[:, column], color=VERMILLION, linestyle="--", linewidth=1.0,
            label="simulated",
        )  # fmt: skip
        ax.set_ylabel(f"{name} ({unit})")
    for ax in axes[len(names) :]:
        ax.set_visible(False)
    for ax in (axes[rows - 1], axes[len(names) - 1]):
        ax.set_xlabel("sample (-)" if fit.dt is None else "time (s)")
        ax.tick_params(labelbottom=True)
    axes[0].legend(loc="lower left", ncols=2, bbox_to_anchor=(0, 1.0))
    axes[0].set_title(fit.trials[index], loc="right")
    return figure


def interval_rows(fit: OptimalFit) -> list[tuple[str, float, float]]:
    """Name, and both ends of the interval over the value, of what may be drawn as a factor.

    Positive parameters that are told by themselves, and the told products of several.
    """
    found = []
    for one in fit.estimate.combinations.told:
        if not one.difference:
            factor = float(np.exp(np.minimum(TWO_SIDED * one.deviation, 100.0)))
            found.append((one.name, 1 / factor, factor))
    return found


def _draw_intervals(fit: OptimalFit) -> Figure:
    rows = interval_rows(fit)
    figure = new_figure(SINGLE_COLUMN, 0.7 + 0.24 * len(rows))
    ax = figure.subplots()
    reach = min(max(1.01, *(high for _, _, high in rows)) ** 1.1, _FURTHEST)
    for place, (_, low, high) in enumerate(rows):
        ax.plot([max(low, 1 / reach), min(high, reach)], [place, place], color=BLUE, linewidth=1.6)
        ax.plot(1.0, place, color=BLUE, marker="o", markerfacecolor="white", linestyle="")
        for end, mark in ((low, "<"), (high, ">")):
            if not 1 / reach <= end <= reach:
                ax.plot(np.clip(end, 1 / reach, reach), place, color=BLUE, marker=mark)
    ax.axvline(1.0, color=INK, linewidth=0.6)
    ax.set_xscale("log")
    ax.set_xlim(1 / reach**1.05, reach**1.05)
    ticks = [1 / reach, 1.0, reach]
    ax.set_xticks(ticks, [f"{tick:.4g}" for tick in ticks])
    ax.minorticks_off()
    ax.set_yticks(range(len(rows)), [name for name, _, _ in rows])
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.set_xlabel("95 % interval over the value (-)")
    ax.set_ylabel("told (-)")
    return figure


def _singular_values(fit: OptimalFit) -> Figure:
    found = fit.estimate.combinations
    values = np.maximum(found.singular_values / found.singular_values[0], 1e-17)
    figure = new_figure(SINGLE_COLUMN, 2.2)
    ax = figure.subplots()
    place, told = np.arange(1, len(values) + 1), len(found.told)
    ax.plot(place[:told], values[:told], color=BLUE, marker="o", linestyle="", label="told")
    if told < len(values):
        ax.axvspan(told + 0.5, len(values) + 0.5, color=FORBIDDEN, linewidth=0)
        names = "; ".join(" ".join(one.exponents) for one in found.untold)
        ax.plot(
            place[told:], values[told:], color=VERMILLION, marker="s", markerfacecolor="white",
            linestyle="", label=textwrap.shorten(f"not told: {names}", _LONGEST),
        )  # fmt: skip
    ax.set_yscale("log")
    ax.set_ylim(0.3 * float(values[-1]), 3.0)
    ax.set_xticks(place)
    ax.set_xlabel("direction of the parameters (-)")
    ax.set_ylabel("singular value / largest (-)")
    ax.legend(loc="lower left")
    return figure


#: Under which name its numbers stand among the methods of result.json.
METHOD = "nonlinear_inverse_mpc"
_LEVEL = 0.95
_INTERVALS = Picture(
    "parameters",
    "Intervals of the parameters and products of parameters that the recordings tell",
    "Parameters, and products of them, that the recordings tell: 95 % intervals over the value. "
    "An arrow: it goes on.",
    narrow=True,
)
_VALUES = Picture(
    "singular-values",
    "Singular values of the derivative of the recordings by the parameters, told and not told",
    "Singular values: how strongly the recordings move along each direction of the parameters. "
    "Round: told. Square, on grey: not told, because nothing that was measured moves.",
    narrow=True,
)
_TOLD = (
    "A product that is told has one value whatever the others have. Along a direction that is not "
    "told the parameters may change together, by any factor a, and the recordings stay what they "
    "are. This is said of the neighbourhood of the answer."
)


def optimal_report(fit: OptimalFit, provenance: Provenance) -> Report:
    """Page, result.json, parameters.csv, combinations.csv, trajectories.csv and figures."""
    told: list[Block] = [_TOLD, _combinations(fit), _VALUES]
    return Report(
        f"impc fit: {provenance.plant_name}",
        "The optimal control problem behind the recordings",
        (Verdict(verdict(fit)), Lines(abstract(fit))),
        [
            Section("1. The parameters", (parameter_finding(fit),), "Parameters", together=True),
            Section("2. What is told", told, "What is told"),
            Section("3. Recorded and simulated", _trajectories(fit), "Trajectories"),
            Section("4. Checks of the recordings", (_checks(fit),), "Checks", folded=True),
            Section("5. Settings and versions", _made(fit, provenance), "Settings", folded=True),
        ],
        figures=optimal_figures(fit),
        beside=[_samples(fit)],
        data=_data(fit, provenance),
        provenance=provenance,
    )


def parameter_finding(fit: OptimalFit) -> Finding:
    """A row a parameter: unit, value, both ends, level, whether it is told, first value."""
    estimate, problem = fit.estimate, fit.estimate.problem
    ends = estimate.intervals(_LEVEL)
    apart = {name for one in estimate.combinations.untold for name in one.exponents}
    roughly = {one.name for one in estimate.combinations.told if one.rough}
    rows = [
        (name, unit, value, *ends[name], _LEVEL,
         "no" if name in apart else "roughly" if name in roughly else "yes", estimate.start[name])
        for (name, value), unit in zip(estimate.theta.items(), problem.units, strict=True)
    ]  # fmt: skip
    rows += [
        (name, unit, value, np.nan, np.nan, np.nan, "known", np.nan)
        for name, (value, unit) in fit.known.items()
    ]
    heads = ["parameter", "unit", "value", "low", "high", "level", "told", "start"]
    caption = (
        "Value with its 95 % interval, and where the search began. One that is not told by itself "
        "stays near its start; section 2 says what of it is told."
    )
    figure = _INTERVALS if interval_rows(fit) else None
    return Finding("parameters", pd.DataFrame(rows, columns=heads), caption, figure=figure)


def _ends(one: Combination) -> tuple[float, float]:
    """Both ends of a told product; any positive number for one that is not."""
    if one.difference:
        return one.value - TWO_SIDED * one.deviation, one.value + TWO_SIDED * one.deviation
    with np.errstate(over="ignore"):
        factor = float(np.exp(TWO_SIDED * one.deviation))
    return one.value / factor, one.value * factor


def _combinations(fit: OptimalFit) -> Finding:
    found, rows = fit.estimate.combinations, []
    for one in (*found.told, *found.untold):
        told = "no" if one in found.untold else "roughly" if one.rough else "yes"
        free = "" if told != "no" else "any factor of these" if one.scaling else "near these values"
        rows.append((one.name, one.value, *_ends(one), _LEVEL, told, free))
    heads = ["product", "value", "low", "high", "level", "told", "free"]
    caption = "Products of parameters with their 95 % intervals, in the problem's units."
    return Finding("combinations", pd.DataFrame(rows, columns=heads), caption)


def _trajectories(fit: OptimalFit) -> list[Block]:
    vaf = pd.DataFrame(signal_vaf(fit.estimate).items(), columns=["signal", "vaf_percent"])
    limits = table_of(
        reached(fit.estimate).items(),
        {
            "constraint": lambda pair: pair[0],
            "at_its_limit": lambda pair: pair[1][0],
            "samples": lambda pair: pair[1][1],
        },
    )
    at_limit = "At how many samples each constraint is at its limit."
    findings: list[Block] = [
        Finding("vaf", vaf, "Variance accounted for (3.24), over all recordings.", digits=6),
        *([Finding("limits", limits, at_limit)] if len(limits) else []),
    ]
    pictures = [
        Picture(
            f"trajectories-{index + 1}",
            f"Recorded and simulated states and inputs over time, {fit.trials[index]}",
            f"{fit.trials[index]}. Rings: recorded. Dashed: simulated from the first state alone.",
        )
        for index in range(min(len(fit.trials), MOST_TRIALS))
    ]
    others = [Details("The other recordings", pictures[1:])] if len(pictures) > 1 else []
    return [*findings, pictures[0], *others]


def _checks(fit: OptimalFit) -> Terms:
    return Terms(
        [
            (name, found or ("Nothing found.",))
            for name, found in zip(fit.trials, fit.findings, strict=True)
        ]
    )


def _made(fit: OptimalFit, provenance: Provenance) -> list[Block]:
    problem, estimate = fit.estimate.problem, fit.estimate
    arguments = "; ".join(f"{key} = {value}" for key, value in provenance.plant_arguments.items())
    settings = "; ".join(f"{key} = {value}" for key, value in fit.settings.items())
    constraints = ", ".join(dict.fromkeys(map(row_name, problem.rows))) or "none"
    sample = "not said" if fit.dt is None else f"{fit.dt:.6g} s"
    return [
        Markup("<code>{}</code>").format(provenance.command),
        Terms(
            [
                ("Made", (f"{provenance.made}, in {estimate.seconds:.1f} s of search",)),
                ("Problem", (Markup("<code>{}</code> <code>{}</code>").format(
                    provenance.plant_name, arguments),)),
                ("States, inputs", (f"{', '.join(problem.state_names)}; "
                                    f"{', '.join(problem.input_names)}",)),
                ("Constraints", (constraints,)),
                ("Sample time, horizon", (f"{sample}, {problem.horizon} samples",)),
                ("Search", (f"{estimate.evaluations} evaluations; {fit.status.value}",)),
                ("Settings", (Markup("<code>{}</code>").format(settings),)),
                ("Recordings", (", ".join(provenance.files),)),
                ("Versions", (provenance.all_versions,)),
            ]
        ),
    ]  # fmt: skip


def _samples(fit: OptimalFit) -> Finding:
    """A row a sample: recorded and simulated signals, and disturbances."""
    problem, step, blocks = fit.estimate.problem, 1.0 if fit.dt is None else fit.dt, []
    for index in range(min(len(fit.trials), MOST_TRIALS)):
        one, (x, u) = fit.estimate.recordings[index], fit.estimate.runs[index]
        behind = np.full((1, problem.m), np.nan)
        last = np.full((1, problem.disturbance_count), np.nan)
        time = step * np.arange(len(x))[:, None]
        blocks.append(np.hstack([
            np.full_like(time, index + 1.0), time, one.x, x, np.vstack([one.u, behind]),
            np.vstack([u, behind]), np.vstack([one.d, last]),
        ]))  # fmt: skip
    heads = ["trial", "sample" if fit.dt is None else "time"]
    for names in (problem.state_names, problem.input_names):
        heads += [f"{name}_recorded" for name in names] + [f"{name}_simulated" for name in names]
    table = pd.DataFrame(np.vstack(blocks), columns=[*heads, *problem.disturbance_names])
    return Finding("trajectories", table)


def _data(fit: OptimalFit, provenance: Provenance) -> dict[str, Any]:
    estimate, problem, found = fit.estimate, fit.estimate.problem, fit.estimate.combinations
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
            for name, one, told in zip(
                fit.trials, estimate.recordings, fit.findings, strict=True
            )
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
            "constraints": [*dict.fromkeys(map(row_name, problem.rows))],
            "horizon": problem.horizon,
            "dt": fit.dt,
        },
        "settings": dict(fit.settings),
    }  # fmt: skip
