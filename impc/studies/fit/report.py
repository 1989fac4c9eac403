"""The report of a fit: its sections, and their tables."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup

from impc.assess.covariance import TOLD
from impc.reporting.document import (
    Block,
    Heading,
    Lines,
    Note,
    Picture,
    Report,
    Section,
    Terms,
    TextTable,
    table_of,
)
from impc.reporting.rendering import number
from impc.studies.fit.csv_tables import fit_tables
from impc.studies.fit.figures import fit_figures
from impc.studies.fit.person import person_section
from impc.studies.fit.result import shown_trials, trial_name
from impc.studies.fit.schema import fit_data
from impc.studies.fit.sentences import (
    direction_name,
    findings,
)
from impc.studies.fit.structures import structure_section
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
from impc.studies.methods_table import column_terms, methods_table

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.reporting.provenance import Provenance
    from impc.studies.fit.result import FitResult

__all__ = ["fit_report"]

_NOT_AT_REST = Note(
    "Not at rest.",
    "The search for weights ended before it converged: a longer or less noisy recording may change "
    "them.",
)
_LEFT = (
    "What the controller does not explain. A residual that is coloured (a small p-value above, a "
    "curve outside the grey band) is the rule with people: they also move for reasons of their "
    "own. The standard deviations below allow for that colour."
)
_RESIDUALS = Picture(
    "residuals",
    "Residuals over time and their autocorrelation",
    "Residuals of every trial, one below the other, and their autocorrelation.",
)
_METHODS = Picture(
    "methods",
    "Output and command of ten seconds under three methods",
    "The ten seconds in which the methods differ most. A method that leaves the dotted lines uses "
    "more than the subject has; one whose curve ends has fallen.",
)
_SAME_GAIN = (
    "All weights in this table have exactly the fitted gain, so the same behaviour under the same "
    "bounds. Which of them is reported is a convention. What holds for all of them may be said of "
    "the subject; what differs between them may not."
)
_INTENT = Picture(
    "intent",
    "Eigenvalues of Q, and shares of the states in the dominant cost, for every rule",
    "Left: eigenvalues of Q. Right: share of each state in the dominant cost at the size that the "
    "states have in the recordings.",
)


def fit_report(result: FitResult, provenance: Provenance) -> Report:
    """Page, result.json, tables and figures."""
    subject = str(result.given.recordings[0].label.subject) or "a subject"
    converged = result.fitted.converged
    found = [
        *([structure_section(result)] if result.structures else []),
        *([] if result.person is None else [person_section(result, result.person)]),
        Section("1. Recorded and simulated", _trajectories(result), "Trajectories", together=True),
        Section("2. What is left", (_LEFT, _RESIDUALS), "What is left"),
        Section(
            "3. Inverse LQR on the same recordings",
            (methods_table(result.methods), column_terms(), _METHODS),
            "Inverse LQR beside it",
        ),
        Section("4. Intent: what the weights say, and what they do not", _intent(result), "Intent"),
        Section("5. The gain, and how sure it is", _gain(result), "Gain"),
        Section("6. Checks of the recordings", (_checks(result),), "Checks"),
        Section("7. Settings and versions", _made(result, provenance), "Settings"),
    ]
    return Report(
        f"impc fit: {subject}",
        f"The controller behind the recordings of {subject}",
        (Lines(findings(result)), *(() if converged else (_NOT_AT_REST,))),
        found,
        figures=fit_figures(result),
        tables=fit_tables(result),
        data=fit_data(result, provenance),
        provenance=provenance,
    )


def _trajectories(result: FitResult) -> list[Block]:
    shown, trials = shown_trials(result), len(result.given.recordings)
    blocks: list[Block] = [_agreement(result)]
    if len(shown) < trials:
        blocks.append(
            f"The {len(shown)} trials that are explained least, of {trials}; the table has all."
        )
    for index in shown:
        name = trial_name(result, index)
        blocks.append(
            Picture(
                f"trajectories-trial-{index + 1}",
                f"Recorded and simulated outputs, command and disturbance over time, {name}",
                f"Counterpart of figure 3.7, {name}. Grey: recorded. Dashed: simulated from the "
                "disturbance alone. Dotted lines: bound of the command; shaded: it stands there.",
            )
        )
    return blocks


def _intent(result: FitResult) -> list[Block]:
    plant, certainty = result.fitted.problem.plant, result.certainty
    reason = certainty.weights_reason
    missing = [f"Not available: {line}" for line in result.intent.missing]
    blocks: list[Block] = [_SAME_GAIN, _readings(result), *missing, _INTENT]
    blocks.append(Heading("All weights with this gain"))
    if certainty.weights is not None:
        blocks += set_sentences(certainty.weights)
    blocks += [f"Not available: {reason}"] if reason else []
    if certainty.weights is not None:
        summary = certainty.weights
        prices = prices_table(summary)
        blocks += [statements_table(summary), *(() if prices is None else (prices,))]
        blocks += [entries_table(summary), eigenvalues_table(summary)]
    Q, P = result.intent.reported.weights.Q, result.reported_P
    blocks.append(Heading("The reported weights"))
    blocks.append(_matrix("Q, the prices of the states, at R = 1", Q, plant.states))
    blocks.append(_matrix("P, the terminal weight", P, plant.states))
    return blocks


def _gain(result: FitResult) -> list[Block]:
    limits, others = limit_sentences(result.certainty), alternatives_table(result.certainty)
    parameters = _parameters(result)
    blocks: list[Block] = [intervals_table(result), _directions(result)]
    blocks += [] if parameters is None else [parameters]
    if limits or others is not None:
        blocks += [Heading("Limit and horizon"), *limits, *(() if others is None else (others,))]
    return blocks


def _checks(result: FitResult) -> Terms:
    return Terms(
        [
            (trial_name(result, index), trial.findings or ("Nothing found.",))
            for index, trial in enumerate(result.given.recordings)
        ]
    )


def _made(result: FitResult, provenance: Provenance) -> list[Block]:
    plant = result.fitted.problem.plant
    given = "".join(f"; {key} = {value}" for key, value in provenance.plant_arguments.items())
    settings = asdict(result.settings)
    return [
        _terminal_set(result),
        Markup("<code>{}</code>").format(provenance.command),
        Terms(
            [
                ("Made", (f"{provenance.made}, in {result.seconds:.1f} s",)),
                (
                    "Plant",
                    (
                        Markup("<code>{}</code>, sample time {} s, states {}{}").format(
                            provenance.plant_name, plant.dt, ", ".join(plant.states), given
                        ),
                    ),
                ),
                ("Settings", ("; ".join(f"{key} = {value}" for key, value in settings.items()),)),
                ("Recordings", (", ".join(provenance.files),)),
                ("Versions", (provenance.all_versions,)),
            ]
        ),
    ]


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
    return TextTable(caption, (*heads, "at the bound %"), rows)


def _probability(value: float) -> str:
    return "< 0.001" if value < 1e-3 else number(value, 2)


def _readings(result: FitResult) -> TextTable:
    states = result.fitted.problem.plant.states
    return table_of(
        "Weights with exactly the same gain, so with the same behaviour, by several rules.",
        result.intent.readings,
        {
            "rule": lambda item: item.rule,
            "largest eigenvalue": lambda item: f"{item.eigenvalues[-1]:.3g}",
            "dominant direction": lambda item: direction_name(np.array(item.dominant), states),
            "turned by, degrees": lambda item: f"{item.angle:.0f}",
            "kappa": lambda item: f"{item.condition:.3g}",
        },
    )


def _directions(result: FitResult) -> TextTable:
    plant, covariance = result.fitted.problem.plant, result.estimate.covariance
    names = tuple(
        state if plant.m == 1 else f"{state} to {control}"
        for control in plant.controls
        for state in plant.states
    )
    back = np.kron(np.array(covariance.G), np.linalg.inv(covariance.T).T)
    sizes = np.tile(np.array(result.intent.sizes), plant.m)
    moved = (covariance.directions @ back.T) * sizes
    values = covariance.singular_values
    return table_of(
        "Directions of the gain, best determined first, as commands at typical states; the "
        "deviation is relative to the natural size of a gain, so that 1 means all but unknown; "
        f"above {TOLD:g} the recordings do not tell, and the estimate stays near the weights'.",
        range(len(values)),
        {
            "": lambda k: str(k + 1),
            "direction": lambda k: direction_name(moved[k] / np.linalg.norm(moved[k]), names),
            "singular value / largest": lambda k: f"{values[k] / values[0]:.1e}",
            "standard deviation": lambda k: _deviation(float(covariance.deviations[k])),
        },
    )


def _deviation(value: float) -> str:
    if np.isinf(value):
        return "not determined"
    return number(value, 2) if value < TOLD else f"not told ({number(value, 2)})"


def _parameters(result: FitResult) -> TextTable | None:
    if not result.parameters:
        return None
    return table_of(
        "Physical parameters fitted with the gain (3.19), in SI units. One that is not determined, "
        "to a factor of e at 95 %, stays near its nominal value whatever the truth.",
        result.parameters,
        {
            "parameter": lambda item: item.name,
            "nominal": lambda item: number(item.nominal, 4),
            "fitted": lambda item: number(item.value, 4) if item.determined else "not determined",
            "standard deviation": lambda item: number(item.deviation, 2),
        },
    )


def _matrix(caption: str, values: Array, names: tuple[str, ...]) -> TextTable:
    rows = [
        (name, *(number(float(value)) for value in line))
        for name, line in zip(names, values, strict=True)
    ]
    return TextTable(caption, ("", *names), rows)


def _terminal_set(result: FitResult) -> str:
    changed = result.terminal_set_difference
    present = "without" if result.settings.terminal_set else "with"
    if np.isnan(changed):
        return f"The loop {present} the terminal set does not reach the end of every trial."
    return (
        f"The loop {present} the terminal set differs by {changed:.2g} of an output's size at most."
    )
