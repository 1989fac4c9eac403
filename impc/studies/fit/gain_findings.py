"""What a fit says of the gain: its entries, directions, physical parameters, limit and horizon.

And of simulated recordings the true gain, from truth.json beside them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from impc.assess.covariance import IDENTIFIED, TWO_SIDED
from impc.assess.printed_gain import entry_names
from impc.assess.variance_accounted_for import verdict
from impc.files.disk import truth_beside
from impc.model.plant import UNKNOWN, gain_unit
from impc.reporting.finding import Finding, Picture, table_of
from impc.reporting.rendering import number
from impc.studies.fit.verdict import direction_name

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from impc.arrays import Array
    from impc.assess.printed_gain import Interval
    from impc.model.plant import Plant
    from impc.studies.fit.result import FitResult

_FIGURE = Picture(
    "gain",
    "Every entry of the gain with its interval, one row a state",
    "Entries of the gain, each as the command that it gives at the state's typical size, with 95 % "
    "intervals. Grey: not identified by itself. An arrow: the interval goes on.",
    narrow=True,
)
# Columns of intervals by other methods than that of low and high.
_OTHER = ("block", "profile")


def gain_finding(result: FitResult) -> Finding:
    """Every number with its intervals, beside the gain of the weights."""
    uncertainty, plant = result.uncertainty, result.fitted.problem.plant
    of_weights = dict(zip(entry_names(plant), np.ravel(result.fitted.gain), strict=True))
    found = {(item.name, item.method): item for item in uncertainty.intervals}
    units, rows = number_units(plant), []
    alone = result.estimate.exact
    deviations = np.zeros(0) if alone is None else np.ravel(alone.entries)
    exact = dict(zip(entry_names(plant), deviations, strict=False))
    for name, item in result.preferred.items():
        row = {
            "number": number_name(plant, name),
            "unit": units.get(name, UNKNOWN),
            "value": np.nan if item.value is None else float(item.value),
            "low": float(item.low),
            "high": float(item.high),
            "identified": item.identified,
            "excludes_zero": item.excludes_zero,
        }
        if alone is not None:
            half, middle = TWO_SIDED * exact.get(name, np.nan), (item.low + item.high) / 2
            row |= {"exact_body_low": middle - half, "exact_body_high": middle + half}
        for method in _OTHER:
            other = found.get((name, method))
            if any(key == method for _, key in found):
                row[f"{method}_low"] = np.nan if other is None else float(other.low)
                row[f"{method}_high"] = np.nan if other is None else float(other.high)
        rows.append(row | {"gain_of_the_weights": float(of_weights.get(name, np.nan))})
    level = 100 * uncertainty.intervals[0].level if rows else 95
    return Finding(
        "gain",
        pd.DataFrame(rows),
        f"Intervals of {level:.0f} %. Low and high allow for autocorrelated residuals, as those of "
        "people are. An entry that is not identified takes part in directions that hardly show in "
        "the recordings: values within its interval cannot be distinguished, and the table of "
        "directions says which combinations can. Exact body: what they would be if the body were "
        "known exactly as it was found. The gain of the reported weights follows from a "
        "rule that chose them, so it has no interval; outside the estimate's interval these "
        "weights do not quite behave as recorded.",
        figure=_FIGURE,
        folded="Every number with its intervals",
    )


def direction_finding(result: FitResult) -> Finding:
    """Combinations of entries that the recordings determine, best first."""
    plant, covariance = result.fitted.problem.plant, result.estimate.covariance
    names = tuple(
        state if plant.m == 1 else f"{state} to {control}"
        for control in plant.controls
        for state in plant.states
    )
    back = np.kron(np.array(covariance.G), np.linalg.inv(covariance.T).T)
    moved = (covariance.directions @ back.T) * np.tile(np.array(result.intent.sizes), plant.m)
    values, deviations = covariance.singular_values, covariance.deviations
    table = table_of(
        range(len(values)),
        {
            "direction": lambda k: direction_name(moved[k] / np.linalg.norm(moved[k]), names),
            "relative_singular_value": lambda k: float(values[k] / values[0]),
            "standard_error": lambda k: float(deviations[k]),
            "identified": lambda k: bool(deviations[k] < IDENTIFIED),
        },
    )
    return Finding(
        "directions",
        table,
        "Directions of the gain, best determined first, as commands at typical states. The "
        "standard error is relative to the natural size of a gain: 1 means practically unknown. "
        f"Above {IDENTIFIED:g} a direction is not identified, and the estimate stays near that of "
        "the weights.",
        folded="Combinations of entries: directions of the gain",
        digits=2,
    )


def parameter_findings(result: FitResult) -> list[Finding]:
    """Physical parameters that were fitted with the gain, where there are any."""
    if not result.parameters:
        return []
    table = table_of(
        result.parameters,
        {
            "parameter": lambda item: item.name,
            "nominal": lambda item: float(item.nominal),
            "fitted": lambda item: float(item.value),
            "standard_error": lambda item: float(item.deviation),
            "stated_deviation": lambda item: np.nan if item.stated is None else item.stated,
            "moved_by_deviations": lambda item: float(item.pull),
            "share_of_the_gains_variance_percent": lambda item: 100 * float(item.share),
            "identified": lambda item: item.determined,
        },
    )
    caption = (
        "Physical parameters fitted with the gain, in SI units. One with a stated deviation keeps "
        "to its nominal value as far as that says; its share is by how much the variance of the "
        "gain's entries would fall if it were measured exactly. A free one that is not identified, "
        "to a factor of e at 95 %, stays near its nominal value whatever the true one is."
    )
    return [Finding("parameters", table, caption, folded="Physical parameters")]


def limit_findings(result: FitResult) -> list[Finding]:
    """What the recordings say of the limit of the command and of the horizon, where asked."""
    found = []
    if result.uncertainty.limits:
        limits = result.uncertainty.limits
        table = table_of(
            zip(result.given.plant.controls, limits, strict=True),
            {
                "input": lambda pair: pair[0],
                "limit": lambda pair: np.nan if pair[1].value is None else float(pair[1].value),
                "low": lambda pair: float(pair[1].low),
                "high": lambda pair: float(pair[1].high),
                "distance_of_no_limit": lambda pair: float(pair[1].against_none),
                "threshold": lambda pair: float(pair[1].quantile),
            },
        )
        said = [f"{item.reason[0].upper()}{item.reason[1:]}." for item in limits]
        found.append(Finding("limits", table, "Limits of the command as unknowns, 95 %.", said))
    if result.uncertainty.alternatives:
        first = result.uncertainty.alternatives[0]
        table = table_of(
            result.uncertainty.alternatives,
            {
                "fit": lambda item: item.name,
                "horizon": lambda item: int(item.horizon),
                "aic_above_the_least": lambda item: float(item.aic),
                "left_out_vaf": lambda item: float(item.held_out),
                "the_recordings_say": lambda item: "" if item is first else verdict(first, item),
            },
        )
        caption = (
            "The same recordings with other horizons and without limit. AIC is above the least, "
            "for the innovations of the residuals; VAF (%) is of trials left out."
        )
        found.append(Finding("alternatives", table, caption))
    return found


def number_name(plant: Plant, name: str) -> str:
    """What a reader calls a number of a fit by its `name`, such as K.command.theta1."""
    kind, _, rest = name.partition(".")
    if name not in number_units(plant):
        return name
    if kind == "u_max":
        return f"limit of {rest}"
    control = next(one for one in plant.controls if rest.startswith(f"{one}."))
    state = rest.removeprefix(f"{control}.")
    return f"gain of {state}" if plant.m == 1 else f"gain of {state} to {control}"


def number_units(plant: Plant) -> dict[str, str]:
    """Units of the numbers of a fit by their names: K.<control>.<state>, u_max.<control>."""
    return {
        f"K.{control}.{state}": gain_unit(plant, control, state)
        for control in plant.controls
        for state in plant.states
    } | {f"u_max.{control}": plant.unit(control) for control in plant.controls}


def read_truth(recordings: Iterable[Path], plant: Plant) -> Array | None:
    """The gain of the truth.json that lies beside recordings. Returns (m, n)."""
    folders = {path.absolute().parent for path in recordings}
    said = truth_beside(folders.pop()) if len(folders) == 1 else {}
    try:
        states, gain = tuple(said["states"]), np.array(said["K"], dtype=np.float64)
    except (ValueError, KeyError, TypeError):  # none, or another program's file
        return None
    return gain if states == plant.states and gain.shape == (plant.m, plant.n) else None


def truth_sentence(result: FitResult, truth: Array) -> str:
    """How many entries of a `truth` (m, n) lie inside their intervals, and which is farthest off.

    Of the gain of a `result`, and of that of its person who senses with noise.
    """
    pairs = _pairs(result, truth)
    level = pairs[0][0].level
    off = [pair for pair in pairs if not _inside(*pair)]
    text = (
        f"The recordings are simulated: {len(pairs) - len(off)} of the {len(pairs)} entries of "
        f"their true gain lie inside their {100 * level:.0f} % intervals"
    )
    person = _of_person(result, truth)
    if not off:
        return f"{text}.{person}"
    item, value = max(off, key=lambda pair: _distance(*pair))
    name = number_name(result.given.plant, item.name)
    return (
        f"{text}; farthest off is the {name}, {number(item.low, 4)} to {number(item.high, 4)} "
        f"where the truth is {number(value, 4)}.{person}"
    )


def _of_person(result: FitResult, truth: Array) -> str:
    """The same of the person who senses with noise, where one was found."""
    if result.person is None or result.person.fit is None:
        return ""
    ends = np.array(result.person.entries)  # NaN of what is not individually identified
    identified = ~np.isnan(ends[:, 0])
    inside = np.count_nonzero((ends[:, 0] <= truth.ravel()) & (truth.ravel() <= ends[:, 1]))
    return (
        f" Of the gain of the person who senses with noise {inside} of "
        f"{np.count_nonzero(identified)} "
        "lie inside theirs."
    )


def truth_finding(result: FitResult, truth: Array) -> Finding:
    """Every entry of the gain of a `result` with its interval beside the `truth` (m, n)."""
    table = table_of(
        _pairs(result, truth),
        {
            "number": lambda pair: number_name(result.given.plant, pair[0].name),
            "estimate": lambda pair: np.nan if pair[0].value is None else float(pair[0].value),
            "low": lambda pair: float(pair[0].low),
            "high": lambda pair: float(pair[0].high),
            "truth": lambda pair: float(pair[1]),
            "inside": lambda pair: _inside(*pair),
        },
    )
    caption = "The truth that lies beside the recordings (truth.json), and what the fit says of it."
    said = [truth_sentence(result, truth)]
    return Finding("truth", table, caption, said, folded="The true gain, entry by entry")


def _pairs(result: FitResult, truth: Array) -> list[tuple[Interval, float]]:
    """The interval of each entry, that for the residuals' colour, with its true value."""
    first = result.preferred
    values = zip(entry_names(result.given.plant), truth.ravel(), strict=True)
    return [(first[name], float(value)) for name, value in values]


def _inside(item: Interval, value: float) -> bool:
    return item.low <= value <= item.high


def _distance(item: Interval, value: float) -> float:
    """From the middle of the interval, in its halves."""
    half = (item.high - item.low) / 2
    return abs(value - (item.low + item.high) / 2) / half if half else np.inf
