"""What a fit says of structures of the weights: findings and a picture (docs/structures.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from impc.assess.long_run_covariance import residual_noise
from impc.assess.structured_weights import IDENTIFIED_FACTOR
from impc.assess.structures import criterion_of
from impc.assess.variance_accounted_for import residuals_of
from impc.reporting.document import Block, Details, Heading, Section
from impc.reporting.finding import Finding, Picture, table_of
from impc.reporting.style import BLUE, INK, VERMILLION, new_figure
from impc.studies.fit.structure_words import factor_of
from impc.studies.fit.verdict import direction_name

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from impc.assess.structures import StructureFit
    from impc.studies.fit.result import FitResult

_WIDTH = 4.2  # inches, so that its words can be read on a phone
_PICTURE = Picture(
    "structured-weights",
    "Cost weights of the features with their intervals, one row each, on a logarithmic axis",
    "Cost weights within the structure, at a cost weight of one for the first input, with "
    "intervals of 95 % for the colour of the residuals. An arrow: no lower end, the cost weight "
    "may be zero.",
    narrow=True,
)


def structure_section(result: FitResult) -> Section:
    """Section of the page."""
    found = result.structures[0]
    blocks: list[Block] = []
    if found.estimate is not None:
        inside = [*_ratios(found), _combinations(found), *_powers(found)]
        blocks += [_cost_weights(found), Details("Ratios and combinations of cost weights", inside)]
    blocks += [Heading("Structures side by side"), _comparison(result)]
    return Section(f"Within the structure: {found.structure.name}", blocks, "Structure")


def structure_data(result: FitResult) -> list[dict[str, Any]]:
    """Weights and gain of every structure, for result.json."""
    return [
        {
            "name": found.structure.name,
            "unknowns": found.structure.unknowns,
            "refused": found.refused,
            "reason": found.reason,
        }
        if found.estimate is None
        else {
            "name": found.structure.name,
            "unknowns": found.structure.unknowns,
            "features": found.structure.features,
            "input_features": found.structure.input_features,
            "refused": found.refused,
            "reason": found.reason,
            "Q": found.estimate.stage_weights.Q,
            "R": found.estimate.stage_weights.R,
            "K": found.estimate.gain,
        }
        for found in result.structures
    ]


def cost_weight_figure(result: FitResult) -> Figure:
    """Cost weights of the first structure with their intervals."""
    found = result.structures[0]
    labels = found.structure.unknowns
    figure = new_figure(_WIDTH, 0.9 + 0.28 * len(labels))
    ax = figure.subplots()
    ends = [end for item in found.intervals for end in (item.low, item.value, item.high)]
    finite = [end for end in ends if np.isfinite(end)]
    left, right = min(finite) - 1.0, max(finite) + 1.0
    for row, item in enumerate(found.intervals):
        low, high = max(item.low, left), min(item.high, right)
        ax.plot(np.exp([low, high]), [row, row], color=BLUE, linewidth=1.4)
        if item.low < left:
            ax.plot([np.exp(left)], [row], color=BLUE, marker="<", markersize=5)
        if item.high > right:
            ax.plot([np.exp(right)], [row], color=BLUE, marker=">", markersize=5)
        if np.isfinite(item.value):
            ax.plot([np.exp(item.value)], [row], color=VERMILLION, marker="o", markersize=4)
    ax.set_xscale("log")
    ax.set_xlim(np.exp(left) / 1.2, np.exp(right) * 1.2)
    ax.set_yticks(range(len(labels)), labels)
    ax.set_ylim(len(labels) - 0.5, -0.5)
    ax.set_ylabel("feature (-)")
    ax.set_xlabel("cost weight over that of the first input (SI)")
    ax.grid(visible=True, axis="x", color=INK, alpha=0.15, linewidth=0.5)
    return figure


def _cost_weights(found: StructureFit) -> Finding:
    structure, rows = found.structure, []
    for index, label in enumerate(structure.unknowns):
        item, cost_weight = found.intervals[index], bool(structure.is_cost_weight[index])
        ends = np.array([item.value, item.low, item.high])
        value, low, high = np.exp(ends) if cost_weight else ends
        cost = np.nan
        if cost_weight and index < len(structure.labels):
            cost = float(value * found.sizes[index] ** 2 / found.effort)
        kind = "cost_weight" if cost_weight else "correlation"
        rows.append((label, kind, float(value), float(low), float(high), cost))
    heads = ["feature", "kind", "value", "low", "high", "cost_over_the_command"]
    return Finding(
        "structure_cost_weights",
        pd.DataFrame(rows, columns=heads),
        f"Unknowns of the structure “{structure.name}”: cost weights over that of "
        f"{structure.input_labels[0]}, in SI units, with intervals of 95 % that allow for "
        "autocorrelated residuals. Last: what the feature costs at the size that it has in the "
        "recordings, over what the command costs.",
        figure=_PICTURE if found.ratios else None,
    )


def _ratios(found: StructureFit) -> list[Finding]:
    if not found.ratios:
        return []
    table = table_of(
        found.ratios,
        {
            "feature": lambda item: item.first,
            "over": lambda item: item.second,
            "ratio": lambda item: float(np.exp(item.interval.value)),
            "low": lambda item: float(np.exp(item.interval.low)),
            "high": lambda item: float(np.exp(item.interval.high)),
        },
    )
    caption = (
        "What one feature costs over another, both at the size that they have in the recordings "
        "(95 %)."
    )
    return [Finding("structure_ratios", table, caption, digits=3)]


def _combinations(found: StructureFit) -> Finding:
    covariance = found.covariance
    assert covariance is not None
    values = covariance.singular_values
    table = table_of(
        range(len(values)),
        {
            "combination": lambda k: direction_name(
                covariance.directions[k], found.structure.unknowns
            ),
            "relative_singular_value": lambda k: float(values[k] / values[0]),
            "standard_error": lambda k: float(covariance.deviations[k]),
            "identified": lambda k: factor_of(float(covariance.deviations[k])),
        },
    )
    return Finding(
        "structure_combinations",
        table,
        "Combinations of the unknowns (sums of logarithms), best determined first: "
        f"{covariance.rank} of {found.structure.count} above rounding, {found.identified} "
        f"identified to a factor of {IDENTIFIED_FACTOR:g} at 95 %.",
        digits=2,
    )


def _powers(found: StructureFit) -> list[Finding]:
    if found.test is None or not found.test.powers:
        return []
    table = table_of(
        found.test.powers,
        {
            "cross_term": lambda item: f"{item.first} with {item.second}",
            "refused_percent": lambda item: 100 * float(item.power),
        },
    )
    caption = (
        "What the test of the structure would see: how probably it refuses a cross term as large "
        "as half the geometric mean of two cost weights, at a level of 5 %."
    )
    return [Finding("structure_power", table, caption, digits=2)]


def _comparison(result: FitResult) -> Finding:
    outputs = result.fitted.problem.plant.outputs
    roots = np.asarray(residual_noise(residuals_of(result.fitted, result.fitted.problem)).root)
    identified = int(np.count_nonzero(result.estimate.covariance.identified))
    free = criterion_of(result.fitted, roots, identified)
    least = min([free, *(item.aic for item in result.structures)])
    held = [item.vaf for item in result.held_out]
    left_out = np.mean(held, axis=0) if held else np.full(len(outputs), np.nan)
    vaf = result.inverse_mpc.vaf
    rows = [("weights of any kind", result.identifiability.free, identified,
             *vaf, *left_out, free - least, np.nan, "")]  # fmt: skip
    for item in result.structures:
        test = item.test
        p = np.nan if test is None or not test.freedom else test.probability
        rows.append((item.structure.name, item.structure.count, item.identified, *item.vaf,
                     *item.held_out, item.aic - least, p, _outcome(item)))  # fmt: skip
    heads = [
        "structure",
        "unknowns",
        "identified",
        *(f"vaf_{name}" for name in outputs),
        *(f"left_out_vaf_{name}" for name in outputs),
        "aic_above_the_least",
        "p",
        "the_recordings",
    ]
    return Finding(
        "structures",
        pd.DataFrame(rows, columns=heads),
        "Every structure on the same recordings, VAF in %. p: of what its weights leave, if it "
        "holds, for autocorrelated residuals; below 0.05 the recordings refuse it. AIC: of the "
        "innovations of the residuals, two for each combination that is identified.",
    )


def _outcome(item: StructureFit) -> str:
    if item.test is None:
        return item.reason
    if item.test.refused:
        return "refuse it"
    return "do not refuse it" if item.test.freedom else "cannot test it"
