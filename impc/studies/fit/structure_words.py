"""What may be said of structures of the weights, in sentences (docs/structures.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.assess.covariance import TWO_SIDED
from impc.assess.structured_weights import IDENTIFIED_FACTOR
from impc.reporting.rendering import number

if TYPE_CHECKING:
    from impc.assess.structures import Ratio, StructureFit
    from impc.assess.weight_profiles import WeightInterval
    from impc.studies.fit.result import FitResult

# A test that refuses a departure less often than this has not looked.
_BLIND = 0.1
# docs/structures.md, What was measured.
_AT_ZERO = (
    "Where the best cost weight is zero, intervals of 95 % held the truth of simulated seats in "
    "78 to 96 %: take those of all cost weights for somewhat wider."
)
# The test holds its level where noise is in the recorder and the plant is the body.
_OF_THE_MODEL = (
    "The recordings also show an error of the body's model or of the controller's, whatever the "
    "weights: that alone makes the test refuse a structure, so that the refusal may not be the "
    "structure's fault."
)


def structure_sentences(result: FitResult) -> tuple[str, ...]:
    """What may be said within the first structure; nothing where none was asked for."""
    if not result.structures:
        return ()
    found = result.structures[0]
    lines = [_verdict(found)]
    if found.estimate is None:
        return tuple(lines)
    if found.refused and result.culprit is not None:
        lines.append(_OF_THE_MODEL)
    lines.append(_explains(result, found))
    if not found.refused:
        lines += [*_cost_weights(found), _identified(found)]
        cost_weights = found.estimate.cost_weights
        lines += (
            [_AT_ZERO] if cost_weights is not None and np.any(np.isneginf(cost_weights)) else []
        )
    power = _power(found)
    return (*lines, *([power] if power else []))


def _verdict(found: StructureFit) -> str:
    name, test = found.structure.name, found.test
    if test is None:
        return f"Nothing can be said within the structure “{name}”: {found.reason}."
    if test.refused:
        return (
            f"The recordings refuse the structure “{name}”: other gains explain what its weights "
            f"leave ({probability(test.probability)}, {test.freedom} directions of the gain). "
            "What it says of cost weights is not the subject's."
        )
    if test.freedom == 0:
        return (
            f"Within the structure “{name}” statements on cost weights need no convention. "
            "Whether it holds was not tested: the recordings identify nothing of the gain "
            "beyond it."
        )
    return (
        f"Within the structure “{name}”, which the recordings do not refuse "
        f"({probability(test.probability)}, {test.freedom} directions of the gain), statements on "
        "cost weights need no convention."
    )


def _explains(result: FitResult, found: StructureFit) -> str:
    outputs = result.fitted.problem.plant.outputs
    own = ", ".join(
        f"{value:.2f} % of {name}" for value, name in zip(found.vaf, outputs, strict=True)
    )
    text = f"Its {found.structure.count} unknowns account for {own} (VAF)"
    if not np.any(np.isnan(found.held_out)):
        held = [f"{value:.2f} %" for value in found.held_out]
        text += f", in trials left out for {' and '.join(held)}"
    free = " and ".join(f"{value:.2f} %" for value in result.inverse_mpc.vaf)
    return f"{text}; weights of any kind for {free}."


def _cost_weights(found: StructureFit) -> list[str]:
    lines = []
    for ratio in _tree(found.ratios):
        lines.append(
            f"Within it {ratio.first} costs {number(float(np.exp(ratio.interval.value)), 2)} times "
            f"as much as {ratio.second}, at the size that they have in the recordings "
            f"(95 %: {ends(ratio.interval)})."
        )
    if found.ratios and not lines:
        lines.append(
            "No ratio of two of its cost weights is known to within a factor of "
            f"{IDENTIFIED_FACTOR:g} at 95 %."
        )
    for index, label in enumerate(found.structure.labels):
        item = found.intervals[index]
        if item.low == -np.inf and np.isfinite(item.high) and found.ratios:
            at_size = item.high + 2 * np.log(found.sizes[index]) - np.log(found.effort)
            lines.append(
                f"{label} may cost nothing: at most {number(float(np.exp(at_size)), 2)} times as "
                f"much as {found.structure.input_labels[0]}, at the size that they have (95 %)."
            )
    return lines


def _tree(ratios: tuple[Ratio, ...]) -> list[Ratio]:
    """The best identified ratios that do not follow from one another."""
    group: dict[str, str] = {}

    def root(label: str) -> str:
        while label in group:
            label = group[label]
        return label

    kept = []
    for ratio in sorted(ratios, key=lambda item: item.interval.high - item.interval.low):
        reach = max(
            ratio.interval.high - ratio.interval.value, ratio.interval.value - ratio.interval.low
        )
        one, other = root(ratio.first), root(ratio.second)
        if one != other and reach < np.log(IDENTIFIED_FACTOR):
            group[one] = other
            kept.append(ratio)
    return kept


def _identified(found: StructureFit) -> str:
    """Told and unidentified combinations, with their percentages."""
    covariance = found.covariance
    assert covariance is not None
    structure = found.structure
    text = (
        f"Of its {structure.count} unknowns the recordings identify {found.identified} "
        f"combinations to a factor of {IDENTIFIED_FACTOR:g} or better"
    )
    pair = _best_pair(found)
    text += f": {pair}." if pair else "."
    blind = [
        label
        for label, own in zip(structure.unknowns, covariance.each, strict=True)
        if TWO_SIDED * own >= np.log(IDENTIFIED_FACTOR)
    ]
    if blind:
        text += f" By themselves they do not identify {', '.join(blind)}."
    return text


def _best_pair(found: StructureFit) -> str:
    """The pair of weights whose ratio and common size are identified most unequally, in words."""
    covariance, structure = found.covariance, found.structure
    assert covariance is not None
    best, text = 0.0, ""
    moving = np.flatnonzero(np.isfinite(covariance.values) & structure.is_cost_weight)
    for place, i in enumerate(moving):
        for j in moving[place + 1 :]:
            row = np.zeros(structure.count)
            row[i], row[j] = 1.0, -1.0
            ratio, size = covariance.spread(row)[0], covariance.spread(np.abs(row) / 2)[0]
            if not (np.isfinite(ratio) or np.isfinite(size)):
                continue
            unequal = abs(np.log(max(ratio, 1e-12) / max(size, 1e-12)))
            if unequal > best:
                one, other = structure.unknowns[i], structure.unknowns[j]
                best = unequal
                text = (
                    f"the ratio of the cost weight of {one} to that of {other} "
                    f"{factor_of(ratio)}, their "
                    f"common size {factor_of(size)}"
                )
    return text


def factor_of(deviation: float) -> str:
    """How far a logarithm with a `deviation` is identified, at 95 %, as a factor."""
    reach = TWO_SIDED * deviation
    if not reach < np.log(IDENTIFIED_FACTOR):
        return "not at all"
    factor = float(np.exp(reach))
    return f"to {number(100 * (factor - 1), 2)} %" if factor < 2 else f"to a factor of {factor:.2g}"


def _power(found: StructureFit) -> str:
    """What the test would have seen."""
    if found.test is None or found.test.refused or not found.test.powers:
        return ""
    powers = sorted(found.test.powers, key=lambda item: -item.power)
    if powers[0].power < _BLIND:
        return (
            "The test is blind to cross terms here: cost weights of its features one by one make "
            "nearly every gain that cost weights of their products would make, so it cannot be "
            "said whether there are any."
        )
    most, least = powers[0], powers[-1]
    text = (
        f"A cross term of {most.first} and {most.second}, as large as half the geometric mean of "
        "their cost weights, would have been refused with a probability of "
        f"{100 * most.power:.0f} %"
    )
    if len(powers) == 1:
        return f"{text}."
    return f"{text}, one of {least.first} and {least.second} with {100 * least.power:.0f} %."


def probability(value: float) -> str:
    """A probability `value` as it is printed."""
    return "p < 0.001" if value < 1e-3 else f"p = {value:.2g}"


def ends(item: WeightInterval) -> str:
    """Where an interval ends, as it is printed."""
    low, high = np.exp(item.low), np.exp(item.high)
    if item.low == -np.inf:
        return "not identified" if item.high == np.inf else f"at most {number(float(high), 3)}"
    if item.high == np.inf:
        return f"at least {number(float(low), 3)}"
    return f"{number(float(low), 3)} to {number(float(high), 3)}"
