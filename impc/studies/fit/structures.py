"""What a fit says of structures of the weights: tables, a picture, numbers (docs/structures.md)."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.assess.long_run_covariance import residual_noise
from impc.assess.other_models import residuals_of
from impc.assess.structured_weights import TOLD_FACTOR
from impc.assess.structures import criterion_of
from impc.reporting.document import Block, Details, Heading, Picture, Section, TextTable, table_of
from impc.reporting.rendering import number
from impc.reporting.style import BLUE, INK, VERMILLION, new_figure
from impc.studies.fit.structure_words import ends, factor_of, probability

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from impc.arrays import Array
    from impc.assess.price_profiles import PriceInterval
    from impc.assess.structures import StructureFit
    from impc.studies.fit.result import FitResult

_WIDTH = 4.2  # inches, so that its words can be read on a phone
# Parts of a combination below this are not named.
_NAMED = 0.15
_PICTURE = Picture(
    "structured-weights",
    "Prices of the features with their intervals, one row each, on a logarithmic axis",
    "Prices within the structure, at a price of one for the first input, with intervals of 95 % "
    "for the colour of the residuals. An arrow: no lower end, the price may be zero.",
    narrow=True,
)


def structure_section(result: FitResult) -> Section:
    """Section of the page."""
    found = result.structures[0]
    blocks: list[Block] = []
    if found.estimate is not None:
        powers = _power_table(found)
        inside = [
            *([_ratio_table(found)] if found.ratios else []),
            _combination_table(found),
            *([] if powers is None else [powers]),
        ]
        blocks += [*([_PICTURE] if found.ratios else []), _price_table(found)]
        blocks.append(Details("Ratios and combinations of prices", inside))
    blocks += [Heading("Structures side by side"), _comparison(result)]
    return Section(f"Within the structure: {found.structure.name}", blocks, "Structure")


def structure_data(result: FitResult) -> list[dict[str, Any]]:
    """Of every structure, for result.json."""
    return [_data(found) for found in result.structures]


def price_figure(result: FitResult) -> Figure:
    """Prices of the first structure with their intervals."""
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
    ax.set_xlabel("price over that of the first input (SI)")
    ax.grid(visible=True, axis="x", color=INK, alpha=0.15, linewidth=0.5)
    return figure


def _price_table(found: StructureFit) -> TextTable:
    structure = found.structure
    rows = []
    for index, label in enumerate(structure.unknowns):
        item, price = found.intervals[index], bool(structure.is_price[index])
        shown = np.exp(item.value) if price else item.value
        cost = "-"
        if price and index < len(structure.labels):
            cost = number(float(shown * found.sizes[index] ** 2 / found.effort), 3)
        told = ends(item) if price else _plain_ends(item)
        rows.append(
            (label, "price" if price else "correlation", number(float(shown), 4), told, cost)
        )
    caption = (
        f"Unknowns of the structure “{structure.name}”: prices over that of "
        f"{structure.input_labels[0]}, in SI units, with intervals of 95 % for the colour of the "
        "residuals. Last: what the feature costs at the size that it has in the recordings, over "
        "what the command costs."
    )
    return TextTable(caption, ("feature", "", "value", "95 %", "cost over the command's"), rows)


def _ratio_table(found: StructureFit) -> TextTable:
    return table_of(
        "What one feature costs over another, both at the size that they have in the recordings.",
        found.ratios,
        {
            "feature": lambda item: item.first,
            "over": lambda item: item.second,
            "ratio": lambda item: number(float(np.exp(item.interval.value)), 3),
            "95 %": lambda item: ends(item.interval),
        },
    )


def _combination_table(found: StructureFit) -> TextTable:
    covariance = found.covariance
    assert covariance is not None
    values = covariance.singular_values
    return table_of(
        f"Combinations of the unknowns (sums of logarithms), best told first: {covariance.rank} of "
        f"{found.structure.count} above rounding, {found.told} told to a factor of "
        f"{TOLD_FACTOR:g} at 95 %.",
        range(len(values)),
        {
            "": lambda k: str(k + 1),
            "combination": lambda k: _combination(
                covariance.directions[k], found.structure.unknowns
            ),
            "singular value / largest": lambda k: f"{values[k] / values[0]:.1e}",
            "told": lambda k: factor_of(float(covariance.deviations[k])),
        },
    )


def _combination(direction: Array, names: tuple[str, ...]) -> str:
    order = np.argsort(-np.abs(direction), kind="stable")
    return " ".join(
        f"{direction[index]:+.2f} {names[index]}"
        for index in order
        if abs(direction[index]) >= _NAMED
    )


def _power_table(found: StructureFit) -> TextTable | None:
    if found.test is None or not found.test.powers:
        return None
    return table_of(
        "What the test of the structure would see: how probably it refuses a cross term as large "
        "as half the geometric mean of two prices, at a level of 5 %.",
        found.test.powers,
        {
            "cross term": lambda item: f"{item.first} with {item.second}",
            "refused, %": lambda item: f"{100 * item.power:.0f}",
        },
    )


def _comparison(result: FitResult) -> TextTable:
    outputs = result.fitted.problem.plant.outputs
    roots = np.asarray(residual_noise(residuals_of(result.fitted, result.fitted.problem)).root)
    told = int(np.count_nonzero(result.estimate.covariance.told))
    free = criterion_of(result.fitted, roots, told)
    least = min([free, *(item.aic for item in result.structures)])
    held = [item.vaf for item in result.held_out]
    rows = [
        (
            "weights of any kind",
            str(result.identifiability.free),
            str(told),
            *(number(float(value), 5) for value in result.inverse_mpc.vaf),
            *(
                number(float(value), 5)
                for value in (np.mean(held, axis=0) if held else [np.nan] * len(outputs))
            ),
            number(free - least, 3),
            "-",
            "-",
        )
    ]
    for item in result.structures:
        test = item.test
        rows.append(
            (
                item.structure.name,
                str(item.structure.count),
                str(item.told),
                *(number(float(value), 5) for value in item.vaf),
                *(number(float(value), 5) for value in item.held_out),
                number(item.aic - least, 3),
                "-" if test is None or not test.freedom else probability(test.probability)[4:],
                _outcome(item),
            )
        )
    heads = (
        "structure",
        "unknowns",
        "told",
        *(f"VAF {name} %" for name in outputs),
        *(f"left out {name} %" for name in outputs),
        "AIC above the least",
        "p",
        "the recordings",
    )
    caption = (
        "Every structure on the same recordings. p: of what its weights leave, if it holds, for "
        "residuals of their colour; below 0.05 the recordings refuse it. AIC: of the innovations "
        "of the residuals, two for each combination that is told."
    )
    return TextTable(caption, heads, rows)


def _outcome(item: StructureFit) -> str:
    if item.test is None:
        return item.reason
    if item.test.refused:
        return "refuse it"
    return "do not refuse it" if item.test.freedom else "cannot test it"


def _data(found: StructureFit) -> dict[str, Any]:
    covariance, structure = found.covariance, found.structure
    told: dict[str, Any] = {
        "name": structure.name,
        "unknowns": structure.unknowns,
        "features": structure.features,
        "input_features": structure.input_features,
        "refused": found.refused,
        "reason": found.reason,
    }
    if covariance is None or found.estimate is None:
        return told
    return told | {
        "prices": [
            {
                "label": label,
                "is_price": bool(price),
                "value": np.exp(item.value) if price else item.value,
                "low": np.exp(item.low) if price else item.low,
                "high": np.exp(item.high) if price else item.high,
                "level": item.level,
            }
            for label, price, item in zip(
                structure.unknowns, structure.is_price, found.intervals, strict=True
            )
        ],
        "ratios": [
            {
                "first": item.first,
                "second": item.second,
                "value": np.exp(item.interval.value),
                "low": np.exp(item.interval.low),
                "high": np.exp(item.interval.high),
            }
            for item in found.ratios
        ],
        "Q": found.estimate.stage_weights.Q,
        "R": found.estimate.stage_weights.R,
        "K": found.estimate.gain,
        "rank": covariance.rank,
        "told": found.told,
        "singular_values": covariance.singular_values,
        "directions": covariance.directions,
        "deviations": covariance.deviations,
        "test": None if found.test is None else asdict(found.test),
        "vaf": found.vaf,
        "held_out_vaf": found.held_out,
        "aic": found.aic,
    }


def _plain_ends(item: PriceInterval) -> str:
    if not np.isfinite(item.high - item.low) or item.high - item.low > 2:
        return "not told"
    return f"{item.low:.2f} to {item.high:.2f}"
