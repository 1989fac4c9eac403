"""Report section on structures of the cost weights (docs/howto/weights.md)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from impc.assess.covariance import TWO_SIDED
from impc.assess.structured_weights import IDENTIFIED_FACTOR
from impc.assess.structures import StructureFit
from impc.assess.variance_accounted_for import innovation_roots, innovations_criterion
from impc.reporting.document import Block, Fold, Section
from impc.reporting.finding import Finding, table_of
from impc.reporting.rendering import probability
from impc.reporting.shown_units import words_of
from impc.studies.fit.facts import shares
from impc.studies.fit.result import FitResult
from impc.studies.methods_figure import explained

# Power below which the test is said to have little power.
_BLIND = 0.1
# Coverage of intervals at a zero cost weight: experiments/structures.md.
_AT_ZERO = (
    "If the best cost weight is zero, 95 % intervals contained the true value in 78 to 96 % of "
    "simulated seats: treat the intervals of all cost weights as somewhat too narrow."
)
# The test keeps its level only with measurement noise and a correct plant.
_OF_THE_MODEL = (
    "The recordings also indicate an error of the body model or of the controller, whatever the "
    "weights: that error alone may be the reason why the structure is rejected."
)


def structure_section(result: FitResult) -> Section:
    """Section of the report."""
    found = result.structures[0]
    blocks: list[Block] = list(structure_sentences(result))
    if found.estimate is not None:
        inside = [_cost_weights(result, found), _ratios(result, found), _powers(result, found)]
        fold = Fold("Cost weights within the structure (do not report)", inside)
        blocks += [fold] if found.refused else inside
    blocks.append(_comparison(result))
    return Section(f"Within the structure: {found.structure.name}", blocks, "Structure")


def structure_data(result: FitResult) -> list[dict[str, Any]]:
    """`structures` in result.json: weights and gain of each structure."""
    rows = []
    for found in result.structures:
        structure, estimate = found.structure, found.estimate
        row: dict[str, Any] = {"name": structure.name, "unknowns": structure.unknowns}
        row |= {"refused": found.refused, "reason": found.reason}
        if estimate is not None:
            row |= {"features": structure.features, "input_features": structure.input_features}
            weights = estimate.stage_weights
            row |= {"Q": weights.Q, "R": weights.R, "K": estimate.gain}
        rows.append(row)
    return rows


def structure_sentences(result: FitResult) -> list[str]:
    """Sentences on the first structure; empty if none was given."""
    if not result.structures:
        return []
    found = result.structures[0]
    lines = [_outcome(found)]
    if found.estimate is None:
        return lines
    if found.refused and result.culprit is not None:
        lines.append(_OF_THE_MODEL)
    own, free = shares(result, found.vaf), shares(result, result.inverse_mpc.vaf)
    lines.append(
        f"Its {found.structure.count} unknowns explain {own} of the variance, weights of any kind "
        f"{free}."
    )
    if not found.refused:
        lines.append(_identified(result, found))
        cost_weights = found.estimate.cost_weights
        if cost_weights is not None and np.any(np.isneginf(cost_weights)):
            lines.append(_AT_ZERO)
        powers = [] if found.test is None else [item.power for item in found.test.powers]
        if powers and max(powers) < _BLIND:
            lines.append("The test has little power against cross terms here (see the table).")
    return lines


def _outcome(found: StructureFit) -> str:
    """Outcome of the test of a structure."""
    name, test = found.structure.name, found.test
    if test is None:
        return f"The structure “{name}” has no result: {found.reason}."
    tested = f"{probability(test.probability)}, {test.freedom} directions of the gain"
    if test.refused:
        return (
            f"The recordings reject the structure “{name}” ({tested}): gains outside it explain "
            "them better. Do not interpret its cost weights."
        )
    within = "If it holds, its cost weights need no further convention."
    if test.freedom:
        return f"The recordings do not reject the structure “{name}” ({tested}). {within}"
    return (
        f"The structure “{name}” was not tested: the recordings determine nothing about the gain "
        f"beyond it. {within}"
    )


def _identified(result: FitResult, found: StructureFit) -> str:
    """Number of identified combinations, and the unknowns that are not identified."""
    covariance, structure, limit = found.covariance, found.structure, np.log(IDENTIFIED_FACTOR)
    assert covariance is not None
    text = (
        f"Of its {structure.count} unknowns the recordings identify {found.identified} "
        f"combinations to within a factor of {IDENTIFIED_FACTOR:g}"
    )
    each = zip(_names(result, structure.unknowns), covariance.each, strict=True)
    loose = [name for name, own in each if not TWO_SIDED * own < limit]
    return f"{text}; not individually: {', '.join(loose)}." if loose else f"{text}."


def _names(result: FitResult, features: Sequence[str]) -> tuple[str, ...]:
    """The features in words."""
    return tuple(words_of(result.given.plant, name) for name in features)


def _cost_weights(result: FitResult, found: StructureFit) -> Finding:
    structure, rows = found.structure, []
    names = _names(result, structure.unknowns)
    for index, label in enumerate(structure.unknowns):
        item, cost_weight = found.intervals[index], bool(structure.is_cost_weight[index])
        ends = np.array([item.value, item.low, item.high])
        value, low, high = map(float, np.exp(ends) if cost_weight else ends)
        cost = np.nan
        if cost_weight and index < len(structure.labels):
            cost = float(value * found.sizes[index] ** 2 / found.effort)
        kind = "cost weight" if cost_weight else "correlation"
        rows.append((names[index], label, kind, value, low, high, cost))
    heads = ["of", "feature", "kind", "value", "low", "high", "cost_over_the_command"]
    return Finding(
        "structure_cost_weights",
        pd.DataFrame(rows, columns=heads),
        "Unknowns of the structure: cost weights relative to that of the first command, in SI "
        "units, with 95 % intervals that allow for autocorrelated residuals. Last column: cost of "
        "the feature at its typical size, relative to the cost of the command.",
        labels={"of": "Cost weight of"},
        hidden=["feature"],
    )


def _ratios(result: FitResult, found: StructureFit) -> Finding:
    table = table_of(
        found.ratios,
        {
            "feature": lambda item: _names(result, [item.first])[0],
            "over": lambda item: _names(result, [item.second])[0],
            "ratio": lambda item: float(np.exp(item.interval.value)),
            "low": lambda item: float(np.exp(item.interval.low)),
            "high": lambda item: float(np.exp(item.interval.high)),
        },
    )
    caption = "Cost of one feature relative to another, both at their typical size (95 %)."
    fold = "Ratios of cost weights"
    return Finding("structure_ratios", table, caption, digits=3, folded=fold)


def _powers(result: FitResult, found: StructureFit) -> Finding:
    table = table_of(
        [] if found.test is None else found.test.powers,
        {
            "cross_term": lambda item: " with ".join(_names(result, (item.first, item.second))),
            "rejected_percent": lambda item: 100 * float(item.power),
        },
    )
    caption = (
        "Power of the test: probability that it rejects the structure at a level of 5 % if there "
        "is a cross term of half the geometric mean of two cost weights."
    )
    fold = "Power of the test"
    return Finding("structure_power", table, caption, digits=2, folded=fold)


def _comparison(result: FitResult) -> Finding:
    plant = result.fitted.problem.plant
    identified = int(np.count_nonzero(result.estimate.covariance.identified))
    free = innovations_criterion(result.fitted, innovation_roots(result.fitted), identified)
    least = min([free, *(item.aic for item in result.structures)])
    own, held = explained(result.inverse_mpc), len(result.inverse_mpc.held_out) > 0
    rows = [("weights of any kind", result.identifiability.free, identified, *own, free - least,
             np.nan, "")]  # fmt: skip
    for item in result.structures:
        test, said, vaf = item.test, item.reason, item.held_out if held else item.vaf
        p = np.nan if test is None or not test.freedom else test.probability
        if test is not None:
            said = "rejected" if test.refused else "not rejected" if test.freedom else "not tested"
        structure = item.structure
        rows.append((structure.name, structure.count, item.identified, *vaf, item.aic - least, p,
                     said))  # fmt: skip
    kind = "left_out_vaf" if held else "vaf"
    words = "Left-out VAF of" if held else "VAF of"
    labels = {f"{kind}_{name}": f"{words} {words_of(plant, name)} (%)" for name in plant.outputs}
    heads = ["structure", "unknowns", "identified", *labels, "aic_above_the_least", "p", "test"]
    return Finding(
        "structures",
        pd.DataFrame(rows, columns=heads),
        "All structures on the same recordings. A structure with p below 0.05 is rejected. AIC: "
        "from the innovations of the residuals, with a penalty of two for each identified "
        "combination.",
        labels={**labels, "aic_above_the_least": "AIC above the smallest"},
    )
