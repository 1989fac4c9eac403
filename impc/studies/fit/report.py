"""The report of a fit: its sections, and their tables."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup

from impc.assess.covariance import TOLD
from impc.control.named_solver import described
from impc.reporting.document import (
    Block,
    Chart,
    Details,
    Heading,
    Lines,
    Note,
    Picture,
    Report,
    Section,
    Terms,
    TextTable,
    Verdict,
    table_of,
)
from impc.reporting.rendering import number
from impc.studies.charts import methods_chart, weights_chart
from impc.studies.fit.csv_tables import fit_tables
from impc.studies.fit.figures import fit_figures
from impc.studies.fit.interval_figures import shown_statements
from impc.studies.fit.result import shown_trials, trial_name
from impc.studies.fit.schema import fit_data
from impc.studies.fit.sentences import direction_name, remarks
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
from impc.studies.fit.truth import truth_sentence, truth_table
from impc.studies.fit.verdict import abstract, other_limit_sentence, verdict
from impc.studies.methods_table import column_terms, methods_table
from impc.studies.signal_words import body_sentence, signal_words

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.reporting.provenance import Provenance
    from impc.studies.fit.result import FitResult

_GAIN = Picture(
    "gain",
    "Every entry of the gain with its interval, one row a state",
    "Entries of the gain, each as the command that it gives at the state's typical size, with 95 % "
    "intervals. Grey: not told by itself. An arrow: it goes on.",
    narrow=True,
)
_STATEMENTS = Picture(
    "statements",
    "Statements on what costs more, each with its range over all weights with this gain",
    "A statement holds for all weights with this gain where its bar stays on one side of zero. "
    "In colour and bold: it may be made of the subject, at 95 %.",
    narrow=True,
)
_LEFT = (
    "What the controller does not explain. A residual that is coloured (a small p-value above, a "
    "curve outside the grey band) is the rule with people: they also move for reasons of their "
    "own. The intervals of the gain allow for that colour."
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
    "Many weights have exactly the fitted gain, so the same behaviour under the same bounds. Which "
    "of them is reported is a convention. What holds for all of them may be said of the subject; "
    "what differs between them may not."
)
_INTENT = Picture(
    "intent",
    "Eigenvalues of Q, and shares of the states in the dominant cost, for every rule",
    "Left: eigenvalues of Q. Right: share of each state in the dominant cost at the size that the "
    "states have in the recordings.",
)


def fit_report(
    result: FitResult,
    provenance: Provenance,
    truth: Array | None = None,
    missing: str = "",
) -> Report:
    """Page, result.json, tables and figures.

    `truth` (m, n).
    """
    told = () if truth is None else (Note("Truth.", truth_sentence(result, truth)),)
    subject = str(result.given.recordings[0].label.subject) or "a subject"
    gain: list[Block] = _gain(result, truth) if result.usable else [verdict(result)]
    return Report(
        f"impc fit: {subject}",
        f"The controller behind the recordings of {subject}",
        (
            Verdict(verdict(result)),
            *(Note("Warning.", _sentence(line)) for line in result.warnings),
            *([Note("Not given:", missing.removeprefix("Not given: "))] if missing else []),
            *told,
            Lines(abstract(result)),
            Details("What stands behind these sentences", (Lines(remarks(result)),)),
        ),
        [
            Section("1. The gain, and how sure it is", gain, "Gain", together=True),
            *([structure_section(result)] if result.structures else []),
            *([] if result.person is None else [result.person.section()]),
            Section("2. What may be said of the weights", _statements(result), "Weights"),
            Section("3. Inverse LQR on the same recordings", _methods(result), "Inverse LQR"),
            Section("4. Recorded and simulated", _trajectories(result), "Trajectories"),
            Section("5. What is left", (_LEFT, _RESIDUALS), "What is left", folded=True),
            Section("6. All weights with this gain", _weights(result), "Intent", folded=True),
            Section("7. Checks of the recordings", (_checks(result),), "Checks", folded=True),
            Section("8. Settings and versions", _made(result, provenance), "Settings", folded=True),
        ],
        figures=fit_figures(result),
        tables=fit_tables(result),
        data={**fit_data(result, provenance), "truth": None if truth is None else {"K": truth}},
        provenance=provenance,
        words=signal_words(result.given.plant),
    )


def _sentence(warning: str) -> str:
    """A warning of the command line without its first word, as a sentence of its own."""
    said = warning.removeprefix("Warning: ")
    return said[:1].upper() + said[1:]


def _gain(result: FitResult, truth: Array | None) -> list[Block]:
    limits, others = limit_sentences(result.certainty), alternatives_table(result.certainty)
    parameters = _parameters(result)
    blocks: list[Block] = [
        _GAIN,
        Details("Every number with its intervals", (intervals_table(result),)),
    ]
    blocks += [] if truth is None else [Details("The true gain", (truth_table(result, truth),))]
    blocks += [] if parameters is None else [parameters]
    blocks += [Details("Combinations of entries: directions of the gain", (_directions(result),))]
    if result.other_limit is not None:
        limits = (*limits, other_limit_sentence(result))
    if limits or others is not None:
        blocks += [Heading("Limit and horizon"), *limits, *(() if others is None else (others,))]
    return blocks


def _statements(result: FitResult) -> list[Block]:
    summary, reason = result.certainty.weights, result.certainty.weights_reason
    blocks: list[Block] = [_SAME_GAIN]
    if summary is None:
        return [*blocks, f"Not available: {reason}"]
    prices = prices_table(summary)
    inside = (statements_table(summary), *(() if prices is None else (prices,)))
    if shown_statements(result):
        blocks.append(_STATEMENTS)
    return [*blocks, Details("Every statement and price with its range", inside)]


def _methods(result: FitResult) -> list[Block]:
    return [
        _METHODS,
        methods_table(result.methods),
        Details("What each column says", (column_terms(),)),
    ]


def _trajectories(result: FitResult) -> list[Block]:
    shown, trials = shown_trials(result), len(result.given.recordings)
    blocks: list[Block] = [_agreement(result)]
    if len(shown) < trials:
        blocks.append(
            f"The {len(shown)} trials that are explained least, of {trials}; the table has all."
        )
    pictures = [
        Picture(
            f"trajectories-trial-{index + 1}",
            f"Recorded and simulated outputs, command and disturbance over time, "
            f"{trial_name(result, index)}",
            f"Counterpart of figure 3.7, {trial_name(result, index)}. Grey: recorded. Dashed: "
            "simulated from the disturbance alone. Dotted lines: bound of the command; shaded: it "
            "stands there.",
        )
        for index in shown
    ]
    others = [Details("The other trials", pictures[1:])] if len(pictures) > 1 else []
    data = methods_chart(result.given, result.methods[::-1], shown[0])
    return [*blocks, Chart(pictures[0], data), *others]


def _weights(result: FitResult) -> list[Block]:
    moved = Chart(_INTENT, weights_chart(result.fitted.problem, result.intent))
    plant, summary = result.fitted.problem.plant, result.certainty.weights
    missing = [f"Not available: {line}" for line in result.intent.missing]
    blocks: list[Block] = [_readings(result), *missing, moved]
    if summary is not None:
        blocks += set_sentences(summary)
        ranges = (entries_table(summary), eigenvalues_table(summary))
        blocks.append(Details("Ranges of entries and eigenvalues of Q", ranges))
    Q, P = result.intent.reported.weights.Q, result.reported_P
    matrices = (
        _matrix("Q, the prices of the states, at R = 1", Q, plant.states),
        _matrix("P, the terminal weight", P, plant.states),
    )
    return [*blocks, Details("The reported weights", matrices)]


def _checks(result: FitResult) -> Terms:
    return Terms(
        [
            (trial_name(result, index), trial.findings or ("Nothing found.",))
            for index, trial in enumerate(result.given.recordings)
        ]
    )


def _made(result: FitResult, provenance: Provenance) -> list[Block]:
    plant = result.fitted.problem.plant
    arguments = "; ".join(f"{key} = {value}" for key, value in provenance.plant_arguments.items())
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
                        Markup(
                            "<code>{}</code>, sample time {} s, states {} <code>{}</code>"
                        ).format(
                            provenance.plant_name, plant.dt, ", ".join(plant.states), arguments
                        ),
                    ),
                ),
                (
                    "Settings",
                    (
                        Markup("<code>{}</code>").format(
                            "; ".join(f"{key} = {value}" for key, value in settings.items())
                        ),
                    ),
                ),
                ("Body", (body_sentence(plant),)),
                (
                    "Quadratic programs",
                    (f"Solved by {described(result.fitted.problem.solver)}.",),
                ),
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
        f"above {TOLD:g} it is not identified, and the estimate stays near the weights'.",
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
    return number(value, 2) if value < TOLD else f"not identified ({number(value, 2)})"


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
    within = bool(result.fitted.problem.terminal_set)
    present = "without" if within else "with"
    if np.isnan(changed):
        effect = "does not reach the end of every trial"
    else:
        effect = f"differs by {changed:.2g} of an output's size at most"
    ends = "ends in its terminal set" if within else "has no terminal set"
    return f"The fitted controller {ends}. The loop {present} it {effect}."
