"""The page of a fit as one HTML file that needs no other."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np

from impc.assess.covariance import TOLD
from impc.inverse.methods import METHODS
from impc.reporting.rendering import TextTable, embedded, number, render_template
from impc.studies.fit.figures import shown_trials
from impc.studies.fit.sentences import (
    direction_name,
    findings,
    method_note,
    trial_name,
)
from impc.studies.fit.tables import (
    alternatives_table,
    eigenvalues_table,
    entries_table,
    intervals_table,
    limit_sentences,
    prices_table,
    set_sentences,
    statements_table,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from impc.arrays import Array
    from impc.reporting.provenance import FitProvenance
    from impc.studies.fit.result import FitResult

__all__ = ["fit_page"]


def fit_page(result: FitResult, figures: Mapping[str, bytes], provenance: FitProvenance) -> str:
    """Render the page; `figures` are those of `fit_figures`."""
    plant = result.fitted.problem.plant
    count = len(result.given.recordings)
    return render_template(
        "studies/fit/fit_page.html",
        title=str(result.given.recordings[0].label.subject) or "a subject",
        findings=findings(result),
        trajectories=[
            (trial_name(result, index), embedded(figures[f"trajectories-trial-{index + 1}.png"]))
            for index in shown_trials(result)
        ],
        trials=count,
        pictures={
            name: embedded(figures[f"{name}.png"]) for name in ("residuals", "intent", "methods")
        },
        agreement=_agreement(result),
        methods=_methods(result),
        readings=_readings(result),
        weights_set=_weights_set(result),
        weights_reason=result.certainty.weights_reason,
        gain=intervals_table(result),
        limits=limit_sentences(result.certainty),
        alternatives=alternatives_table(result.certainty),
        directions=_directions(result),
        parameters=_parameters(result),
        matrices=[
            _matrix(
                "Q, the prices of the states, at R = 1",
                result.intent.reported.weights.Q,
                plant.states,
                plant.states,
            ),
            _matrix("P, the terminal weight", result.reported_P, plant.states, plant.states),
        ],
        missing=result.intent.missing,
        checks=[
            (trial_name(result, index), trial.findings)
            for index, trial in enumerate(result.given.recordings)
        ],
        terminal_set=_terminal_set(result),
        converged=result.fitted.converged or result.fitted.explained,
        settings=asdict(result.settings),
        provenance=provenance,
        plant=plant,
        seconds=f"{result.seconds:.1f}",
    )


def _agreement(result: FitResult) -> TextTable:
    outputs = result.fitted.problem.plant.outputs
    heads = ["trial"]
    for name in outputs:
        heads += [f"VAF {name} %", f"left out {name} %", f"white? {name} (p)"]
    rows = []
    for index, told in enumerate(result.trials):
        row = [trial_name(result, index)]
        for column in range(len(outputs)):
            held = result.held_out[index].vaf[column] if result.held_out else np.nan
            row += [
                number(told.vaf[column], 5),
                number(held, 5),
                _probability(told.whiteness[column]),
            ]
        rows.append((*row, f"{100 * told.saturated:.1f}"))
    caption = (
        "Variance accounted for (3.24). Left out: predicted from the other trials, after the time "
        "that serves to find where the trial starts. White: p-value of Ljung and Box's test of the "
        "residual; a small one says that something regular is left."
    )
    return TextTable(caption, (*heads, "at the bound %"), tuple(rows))


def _probability(value: float) -> str:
    return "< 0.001" if value < 1e-3 else number(value, 2)


def _methods(result: FitResult) -> TextTable:
    outputs = result.fitted.problem.plant.outputs
    heads = ("method", *(f"VAF {name} %" for name in outputs), "largest input", "", "seconds")
    rows = tuple(
        (
            METHODS[item.name].label,
            *(number(value, 5) for value in item.vaf),
            ", ".join(number(value) for value in item.largest_input),
            method_note(result, item),
            f"{item.estimate.seconds:.2f}",
        )
        for item in result.methods
    )
    caption = "Every method on the same recordings, all trials at once."
    return TextTable(caption, heads, rows)


def _readings(result: FitResult) -> TextTable:
    states = result.fitted.problem.plant.states
    rows = tuple(
        (
            item.rule,
            f"{item.eigenvalues[-1]:.3g}",
            direction_name(np.array(item.dominant), states),
            f"{item.angle:.0f}",
            f"{item.condition:.3g}",
        )
        for item in result.intent.readings
    )
    heads = ("rule", "largest eigenvalue", "dominant direction", "turned by, degrees", "kappa")
    caption = "Weights with exactly the same gain, so with the same behaviour, by several rules."
    return TextTable(caption, heads, rows)


def _weights_set(result: FitResult) -> tuple[tuple[str, ...], tuple[TextTable, ...]]:
    summary = result.certainty.weights
    if summary is None:
        return (), ()
    prices = prices_table(summary)
    tables = [statements_table(summary), *([] if prices is None else [prices])]
    return set_sentences(summary), (*tables, entries_table(summary), eigenvalues_table(summary))


def _directions(result: FitResult) -> TextTable:
    plant, covariance = result.fitted.problem.plant, result.estimate.covariance
    names = tuple(
        state if plant.m == 1 else f"{state} to {control}"
        for control in plant.controls
        for state in plant.states
    )
    back = np.kron(np.array(covariance.G), np.linalg.inv(covariance.T).T)
    sizes = np.tile(np.array(result.intent.sizes), plant.m)
    rows = []
    for index, value in enumerate(covariance.singular_values):
        moved = (back @ covariance.directions[index]) * sizes
        relative = value / covariance.singular_values[0]
        deviation = float(covariance.deviations[index])
        rows.append(
            (
                str(index + 1),
                direction_name(moved / np.linalg.norm(moved), names),
                f"{relative:.1e}",
                _deviation(deviation),
            )
        )
    caption = (
        "Directions of the gain, best determined first, as commands at typical states; the "
        "deviation is relative to the natural size of a gain, so that 1 means all but unknown; "
        f"above {TOLD:g} the recordings do not tell, and the estimate stays near the weights'."
    )
    heads = ("", "direction", "singular value / largest", "standard deviation")
    return TextTable(caption, heads, tuple(rows))


def _deviation(value: float) -> str:
    if np.isinf(value):
        return "not determined"
    return number(value, 2) if value < TOLD else f"not told ({number(value, 2)})"


def _parameters(result: FitResult) -> TextTable | None:
    if not result.parameters:
        return None
    rows = tuple(
        (
            item.name,
            number(item.nominal, 4),
            number(item.value, 4) if item.determined else "not determined",
            number(item.deviation, 2),
        )
        for item in result.parameters
    )
    caption = (
        "Physical parameters fitted with the gain (3.19), in SI units. One that is not determined, "
        "to a factor of e at 95 %, stays near its nominal value whatever the truth."
    )
    return TextTable(caption, ("parameter", "nominal", "fitted", "standard deviation"), rows)


def _matrix(
    caption: str, values: Array, rows: tuple[str, ...], columns: tuple[str, ...]
) -> TextTable:
    body = tuple(
        (name, *(number(float(value)) for value in line))
        for name, line in zip(rows, values, strict=True)
    )
    return TextTable(caption, ("", *columns), body)


def _terminal_set(result: FitResult) -> str:
    changed = result.terminal_set_difference
    present = "without" if result.settings.terminal_set else "with"
    if np.isnan(changed):
        return f"The loop {present} the terminal set does not reach the end of every trial."
    return (
        f"The loop {present} the terminal set differs by {changed:.2g} of an output's size at most."
    )
