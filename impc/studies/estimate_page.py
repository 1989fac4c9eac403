"""The page of one estimate, from Python: what `impc.report` writes.

`impc fit` adds what a subject needs (intervals, trials left out, intent, docs/fitting.md); this is
the answer of one method, whatever the method, beside its recordings.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from markupsafe import Markup

from impc.assess.judged import judge
from impc.checking import checked
from impc.control.named_solver import described
from impc.errors import InputError
from impc.inverse.estimates import Estimate
from impc.inverse.methods import METHODS
from impc.reporting.document import (
    Block,
    Chart,
    Lines,
    Picture,
    Report,
    Section,
    TextTable,
    Verdict,
)
from impc.reporting.provenance import Provenance
from impc.reporting.rendering import number
from impc.reporting.shown_units import axis_label, shown_unit
from impc.reporting.style import BLUE, DOUBLE_COLUMN, INK, drawn, journal_style, new_figure
from impc.reporting.writer import owned, write_files
from impc.studies.charts import methods_chart
from impc.studies.methods_table import column_terms, methods_data, methods_table
from impc.studies.signal_words import body_sentence, signal_words

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from impc.assess.judged import MethodFit

_CALLER = "of the program that called impc.report"


class OwnPage(Protocol):
    """An estimate with a page of its own, such as that of an optimal control problem."""

    def page(self, provenance: Provenance) -> Report:
        """The page, its tables and its figures."""


# Trials that are drawn, the first ones.
_DRAWN = 6
# Of the largest entry of a matrix: below it stands the rounding of a search.
_ROUNDING = 1e-12


@checked
def report(estimate: Estimate | OwnPage, folder: str | Path) -> tuple[Path, ...]:
    """Write the page of an estimate, its figures, tables and result.json into a folder.

    Parameters
    ----------
    estimate : Estimate or OptimalControlEstimate
        Of `estimate`, or of `fit_optimal_control`.
    folder : str or Path
        Made when it is missing; an earlier report in it is replaced.

    Returns
    -------
    tuple of Path
        What was written.

    Raises
    ------
    InputError
        When the method ended without a gain: there is nothing to show.
    OutputError
        When the folder cannot be written, or holds other results.

    Examples
    --------
    >>> import tempfile
    >>> import control
    >>> import impc
    >>> plant = impc.Plant(control.ss([[0.9]], [[1]], [[1]], 0, 1))
    >>> bounds = impc.Bounds(plant, u_min=-0.3, u_max=0.3)
    >>> truth = impc.Controller(plant, impc.Weights(1, 1), bounds, horizon=3)
    >>> trial = impc.Recording(plant, truth.simulate([1.0], steps=20).x)
    >>> found = impc.estimate(impc.Problem(plant, bounds, 3, [trial]))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     [path.name for path in impc.report(found, folder)][:2]
    ['report.html', 'result.json']
    """
    place = Path(folder)
    if not isinstance(estimate, Estimate):
        with owned(place, "report"):
            return write_files(place, estimate.page(Provenance(_CALLER)).files())
    if estimate.K is None:
        raise InputError("estimate", f"has no gain: {estimate.reason}", "try another method")
    fit = judge(estimate, estimate.problem.bounds)
    with owned(place, "report"):
        return write_files(place, _document(fit).files())


def _document(fit: MethodFit) -> Report:
    estimate, method = fit.estimate, METHODS[fit.estimate.method]
    provenance = Provenance(_CALLER)
    with journal_style():
        shown = range(min(len(fit.runs), _DRAWN))
        figures = drawn({f"trial-{index + 1}": _trajectories(fit, index) for index in shown})
    pictures = [
        Picture(
            f"trial-{index + 1}",
            f"Outputs and inputs of trial {index + 1}: recorded, and as {method.label} has them",
            f"Trial {index + 1}. Grey: recorded. Blue: simulated. Dotted: bounds.",
        )
        for index in shown
    ]
    shown_blocks: list[Block] = list(pictures)
    if pictures:
        shown_blocks[0] = Chart(pictures[0], methods_chart(estimate.problem, [fit], 0))
    tables = {"gain": _gain(estimate), "vaf": _vaf(fit)}
    if estimate.weights is not None:
        tables["weights"] = _weights(estimate)
    return Report(
        f"impc: {method.label}",
        f"Estimate: {method.label}",
        (Verdict(fit.estimate.status.sentence), method.sentence, Lines(_findings(fit))),
        [
            Section(
                "1. Recorded and simulated",
                (methods_table([fit]), column_terms(), tables["vaf"], *shown_blocks),
                together=True,
            ),
            Section(
                "2. Controller", [tables[name] for name in ("gain", "weights") if name in tables]
            ),
            Section(
                "3. Versions",
                (
                    f"{provenance.made}; {provenance.all_versions}.",
                    body_sentence(estimate.problem.plant),
                    f"Quadratic programs: solved by {described(estimate.problem.solver)}.",
                ),
            ),
        ],
        figures=figures,
        tables=tables,
        data={
            "methods": methods_data([fit]),
            "states": estimate.problem.plant.states,
            "controls": estimate.problem.plant.controls,
            "outputs": estimate.problem.plant.outputs,
            "horizon": estimate.problem.horizon,
            "body": estimate.problem.plant.moves,
            "solver": estimate.problem.solver,
            "starts": estimate.problem.starts,
            "logarithms": estimate.problem.logarithms,
        },
        provenance=provenance,
        words=signal_words(estimate.problem.plant),
    )


def _findings(fit: MethodFit) -> list[str]:
    estimate, outputs = fit.estimate, fit.estimate.problem.plant.outputs
    shares = ", ".join(
        f"{number(float(value), 5)} % of {name}"
        for name, value in zip(outputs, fit.vaf, strict=True)
    )
    lines = [f"Variance accounted for (3.24): {shares}."]
    if np.any(np.isfinite(estimate.problem.bounds.u_max)):
        lines.append(
            "No input exceeds its bound."
            if fit.keeps_bounds
            else f"An input exceeds its bound at {100 * fit.exceeded:.1f} % of the samples."
        )
    lines += [f"{estimate.reason}."] if estimate.reason else []
    if estimate.weights is not None:
        lines.append(
            Markup(
                "Other weights have the same gain and behave alike: "
                "<code>impc.identifiability</code> says how many numbers the recordings tell."
            )
        )
    return lines


def _gain(estimate: Estimate) -> TextTable:
    plant = estimate.problem.plant
    rows = [
        (name, *(number(float(value), 6) for value in row))
        for name, row in zip(plant.controls, estimate.gain, strict=True)
    ]
    return TextTable("Gain K of u = -Kx, in SI units.", ("input", *plant.states), rows)


def _weights(estimate: Estimate) -> TextTable:
    plant, weights = estimate.problem.plant, estimate.stage_weights
    rows = [
        (f"{which} {name}", *(number(float(value), 6) for value in row))
        for which, names, matrix in (
            ("Q", plant.states, weights.Q),
            ("R", plant.controls, weights.R),
        )
        for name, row in zip(names, matrix, strict=True)
    ]
    rows = [row + ("",) * (plant.n + 1 - len(row)) for row in rows]
    heads = ("", *(str(index + 1) for index in range(max(plant.n, plant.m))))
    return TextTable("Weights, scaled to R[0, 0] = 1.", heads, [row[: len(heads)] for row in rows])


def _vaf(fit: MethodFit) -> TextTable:
    outputs = fit.estimate.problem.plant.outputs
    rows = [("all", *(number(float(value), 5) for value in fit.vaf))]
    for index, values in enumerate(fit.trial_vaf):
        rows.append((str(index + 1), *(number(float(value), 5) for value in values)))
    return TextTable(
        "Variance accounted for (3.24), %.", ("trial", *(f"VAF {name} %" for name in outputs)), rows
    )


def _trajectories(fit: MethodFit, index: int) -> Figure:
    problem, run = fit.estimate.problem, fit.runs[index]
    plant, trial = problem.plant, problem.recordings[index]
    time = np.arange(trial.samples) * plant.dt
    count = len(plant.outputs) + plant.m
    figure = new_figure(DOUBLE_COLUMN, 0.5 + 1.2 * count)
    axes = figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
    simulated = run.x @ plant.C.T
    for place, name in enumerate(plant.outputs):
        factor, unit = shown_unit(plant, name)
        axes[place].plot(time, factor * trial.outputs[:, place], color="#BBBBBB", linewidth=3.5)
        axes[place].plot(time, factor * simulated[:, place], color=BLUE, linewidth=1.0)
        axes[place].set_ylabel(f"{name} ({unit})")
    for place, name in enumerate(plant.controls):
        ax = axes[len(plant.outputs) + place]
        ax.plot(time[:-1], run.u[:, place], color=BLUE, linewidth=1.0)
        for limit in (problem.bounds.u_min[place], problem.bounds.u_max[place]):
            if np.isfinite(limit):
                ax.axhline(float(limit), color=INK, linestyle=":", linewidth=1.0)
        ax.set_ylabel(axis_label(plant, name))
    axes[-1].set_xlabel("time (s)")
    return figure
