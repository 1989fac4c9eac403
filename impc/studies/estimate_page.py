"""The page of one estimate, from Python: what `impc.report` writes.

`impc fit` adds what a subject needs (intervals, trials left out, intent, docs/fitting.md); this is
the answer of one method, whatever the method, beside its recordings.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
import pandas as pd
from markupsafe import Markup

from impc.assess.assessments import evaluate_method
from impc.checking import checked
from impc.control.named_solver import described
from impc.errors import InputError
from impc.inverse.estimates import Estimate
from impc.inverse.methods import METHODS
from impc.reporting.document import Block, Lines, Report, Section, Verdict
from impc.reporting.estimate_text import gain_table
from impc.reporting.finding import Chart, Finding, Picture
from impc.reporting.provenance import Provenance
from impc.reporting.rendering import number
from impc.reporting.shown_units import body_sentence, signal_words
from impc.reporting.style import drawn, journal_style
from impc.reporting.writer import owned, write_files
from impc.studies.charts import chart_figure, methods_chart
from impc.studies.fit.report import fit_report
from impc.studies.fit.settings import FitSettings
from impc.studies.fit.subject import FitProgress, fit_recordings
from impc.studies.methods_table import (
    column_terms,
    methods_data,
    methods_finding,
    weight_entries,
)

if TYPE_CHECKING:
    from impc.assess.assessments import MethodFit

_OURS = "inverse_mpc"
_CALLER = "of the program that called impc.report"


class OwnPage(Protocol):
    """An estimate with a page of its own, such as that of an optimal control problem."""

    def page(self, provenance: Provenance) -> Report:
        """The page, its tables and its figures."""


# Trials that are drawn, the first ones.
_DRAWN = 6


@checked
def report(
    estimate: Estimate | OwnPage, folder: str | Path, settings: FitSettings | None = None
) -> tuple[Path, ...]:
    """Write the page of an estimate, its figures, tables and result.json into a folder.

    Parameters
    ----------
    estimate : Estimate or OptimalControlEstimate
        Of `impc.fit`, or of `fit_optimal_control`.
    folder : str or Path
        Made when it is missing; an earlier report in it is replaced.
    settings : FitSettings, optional
        Of an estimate of inverse MPC: the page is that of `impc fit` with these settings, with
        intervals, other methods and trials left out. It takes as long as that.

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
    >>> found = impc.fit(impc.Problem(plant, bounds, 3, [trial]))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     [path.name for path in impc.report(found, folder)][:2]
    ['report.html', 'result.json']
    """
    place = Path(folder)
    if not isinstance(estimate, Estimate):
        with owned(place, "report"):
            return write_files(place, estimate.page(Provenance(_CALLER)).files())
    if settings is not None and estimate.method != _OURS:
        raise InputError("settings", f"are of {_OURS}, not {estimate.method}", "leave them out")
    if estimate.K is None:
        raise InputError("estimate", f"has no gain: {estimate.reason}", "try another method")
    if settings is None:
        document = _document(evaluate_method(estimate, estimate.problem.bounds))
    else:
        kept = FitProgress(estimate=lambda name, make: estimate if name == _OURS else make())
        result = fit_recordings(estimate.problem, settings, kept)
        document = fit_report(result, Provenance(_CALLER))
    with owned(place, "report"):
        return write_files(place, document.files())


def _document(fit: MethodFit) -> Report:
    estimate, method = fit.estimate, METHODS[fit.estimate.method]
    provenance = Provenance(_CALLER)
    with journal_style():
        shown = range(min(len(fit.runs), _DRAWN))
        charts = [methods_chart(estimate.problem, [fit], index) for index in shown]
        figures = drawn({f"trial-{k + 1}": chart_figure(one, 2) for k, one in enumerate(charts)})
    pictures = [
        Picture(
            f"trial-{index + 1}",
            f"Outputs and inputs of trial {index + 1}: recorded, and as {method.label} has them",
            f"Trial {index + 1}. Grey: recorded. In colour: simulated. Dotted: bounds.",
        )
        for index in shown
    ]
    shown_blocks: list[Block] = list(pictures)
    if pictures:
        shown_blocks[0] = Chart(pictures[0], charts[0])
    return Report(
        f"impc: {method.label}",
        f"Estimate: {method.label}",
        (Verdict(fit.estimate.status.sentence), method.sentence, Lines(_findings(fit))),
        [
            Section(
                "1. Recorded and simulated",
                (methods_finding([fit]), column_terms(), _vaf(fit), *shown_blocks),
                together=True,
            ),
            Section("2. Controller", [_gain(estimate), *_weights(estimate)]),
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
                "<code>impc.identifiability</code> says how many numbers the recordings identify."
            )
        )
    return lines


def _gain(estimate: Estimate) -> Finding:
    table = gain_table(estimate.problem.plant, estimate.gain)
    return Finding("gain", table, "Gain K of u = -Kx.", digits=6)


def _weights(estimate: Estimate) -> list[Finding]:
    if estimate.weights is None:
        return []
    entries = weight_entries(estimate.problem.plant, estimate.stage_weights)
    table = pd.DataFrame(entries, columns=["matrix", "first", "second", "unit", "value"])
    return [Finding("weights", table, "Weights, scaled to R = 1 of the first input.", digits=6)]


def _vaf(fit: MethodFit) -> Finding:
    outputs = fit.estimate.problem.plant.outputs
    trials = [("all", fit.vaf), *((str(k + 1), vaf) for k, vaf in enumerate(fit.trial_vaf))]
    rows = [
        (trial, name, float(value))
        for trial, values in trials
        for name, value in zip(outputs, values, strict=True)
    ]
    table = pd.DataFrame(rows, columns=["trial", "output", "vaf_percent"])
    return Finding("vaf", table, "Variance accounted for (3.24).", digits=5)
