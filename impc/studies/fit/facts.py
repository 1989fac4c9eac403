"""Numbers and phrases shared by verdict, sections, checks and the text for a paper."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from impc.arrays import Array
from impc.assess.covariance import TWO_SIDED
from impc.assess.printed_gain import Interval, entry_names, follows_command
from impc.assess.weights_ranges import Statement
from impc.model.foresight import physical_disturbances
from impc.model.plant import Plant
from impc.model.signal_errors import KINDS
from impc.reporting.rendering import fixed, number, sentence_case
from impc.reporting.shown_units import error_unit, shown_unit, signal_name
from impc.studies.fit.asked import OBSERVER
from impc.studies.fit.result import LITTLE, FitResult, LimitFound
from impc.studies.methods_figure import explained

#: Ratio of unexplained variances from which a limit is said to matter.
MATTERS = 2.0
# Longest recordings that are proposed, s.
_LONGEST = 600.0


class GainRow(NamedTuple):
    """An entry of the gain in shown units: opposing command per unit of a state."""

    state: str  # Name in words
    control: str
    per: str  # For example "1° of seat tilt"
    unit: str  # Unit of the command
    value: float
    low: float
    high: float
    interval: Interval  # In units of the plant
    inner: bool  # State of nerves or muscles, whose single gain has no meaning

    @property
    def ends(self) -> str:
        """The interval in words."""
        return between(self.low, self.high)

    @property
    def text(self) -> str:
        """The gain with its interval, in words."""
        return f"{number(self.value)} {self.unit} for {self.per} (95 % CI {self.ends})"

    @property
    def determined(self) -> bool:
        """Whether it may be reported (`Interval.determined`)."""
        return self.interval.determined


def between(low: float, high: float) -> str:
    """Both ends of an interval, with enough digits to distinguish them."""
    if not (np.isfinite(low) and np.isfinite(high)):
        return "not determined"
    size = max(abs(low), abs(high), 1e-300)
    digits = int(np.clip(1 + np.ceil(np.log10(size / max(high - low, 1e-6 * size))), 3, 5))
    return f"{fixed(low, digits)} to {fixed(high, digits)}"


def limit_ends(found: LimitFound) -> str:
    """Interval of an estimated limit."""
    return f"95 % CI {between(found.low, found.high)}"


def with_unit(value: str, unit: str) -> str:
    """A number with its unit: "1°", "1 N m", "1"."""
    return f"{value}{unit}" if unit[:1] == "°" else value if unit == "-" else f"{value} {unit}"


def gain_rows(result: FitResult) -> list[GainRow]:
    """All entries of the gain, row by row, in shown units."""
    plant, found = result.given.plant, result.preferred
    inner, rows = follows_command(result.fitted.problem.plant), []
    for control in plant.controls:
        scale, unit = shown_unit(plant, control)
        for state, own in zip(plant.states, inner, strict=True):
            item = found.get(f"K.{control}.{state}")
            if item is None:
                continue
            factor, of = shown_unit(plant, state)
            ratio, words = scale / factor, signal_name(plant, state)
            per = f"{with_unit('1', of)} of {words}"
            value = np.nan if item.value is None else ratio * item.value
            ends = ratio * item.low, ratio * item.high
            name = signal_name(plant, control)
            rows.append(GainRow(words, name, per, unit, value, *ends, item, bool(own)))
    return rows


def named_gains(result: FitResult) -> list[tuple[str, GainRow]]:
    """Entries whose single values have a meaning, with their names."""
    several = result.given.plant.m > 1
    rows = [row for row in gain_rows(result) if not row.inner] or gain_rows(result)
    return [(f"{row.state} by {row.control}" if several else row.state, row) for row in rows]


def ends_words(result: FitResult) -> str:
    """How far apart searches from different starts end, for the first gain; empty for one end."""
    row = next((row for _, row in named_gains(result)), None)
    if row is None or not result.estimate.rivals or not row.interval.value:
        return ""
    place = entry_names(result.given.plant).index(row.interval.name)
    values = [float(np.ravel(one.K)[place]) for one in (result.estimate, *result.estimate.rivals)]
    low, high = sorted(row.value / row.interval.value * np.array([min(values), max(values)]))
    return (
        f" Searches from {len(values)} starts explain the recordings equally well, with "
        f"{number(low)} to {number(high)} {row.unit} for {row.per}."
    )


def enough_words(result: FitResult) -> str:
    """Time for which a gain would be determined, if errors fall with its root; else empty."""
    wide = [(row.high - row.low) / abs(row.value) for _, row in named_gains(result) if row.value]
    seconds = sum(one.samples for one in result.given.recordings) * result.given.plant.dt
    needed = seconds * min(wide, default=np.inf) ** 2
    if not needed < _LONGEST:
        return ""
    return f" (about {max(2, int(np.ceil(needed / 30)))} trials of 30 s would determine a gain)"


def first_gain(result: FitResult) -> GainRow | None:
    """The first entry that may be reported; None if there is none."""
    return next((row for _, row in named_gains(result) if row.determined), None)


def example_gain(result: FitResult) -> str:
    """Sentence with one gain and its interval as an example."""
    row = first_gain(result)
    return "" if row is None else f"For example {row.text}."


def outside_offset(result: FitResult) -> str:
    """Sentence on a fitted offset that lies outside its recorded signal; empty if none does."""
    plant, trials = result.given.plant, result.given.recordings
    for kind, name, values in result.estimate.problem.fitted_errors:
        if kind != "offset" or name not in plant.outputs:
            continue
        factor, unit = shown_unit(plant, name)
        column = plant.outputs.index(name)
        for trial, value in zip(trials, values, strict=True):
            low, high = np.nanmin(trial.outputs[:, column]), np.nanmax(trial.outputs[:, column])
            if not low <= value <= high:
                ends = f"{number(factor * low)} to {number(factor * high)}"
                return (
                    f"The offset of the {signal_name(plant, name)} was fitted as "
                    f"{with_unit(number(factor * value), unit)}; the recording has {ends}."
                )
    return ""


def limits(plant: Plant, low: Array, high: Array) -> list[str]:
    """Finite limits of the inputs in words, from the bounds (m,)."""
    found = []
    for k, name in enumerate(plant.controls):
        factor, unit = shown_unit(plant, name)
        if np.isfinite(high[k]):
            of = f" of {signal_name(plant, name)}" if plant.m > 1 else ""
            found.append(f"{with_unit(number(float(factor * high[k]), 4), unit)}{of}")
        elif np.isfinite(low[k]):
            found.append(f"{with_unit(number(float(factor * low[k]), 4), unit)} downwards")
    return found


def given_limit(result: FitResult) -> str | None:
    """The given limit, for example "6 N m"; None if there is none."""
    plant, bounds = result.given.plant, result.given.bounds
    parts = limits(plant, np.array(bounds.u_min), np.array(bounds.u_max))
    most = dict(zip(plant.states, bounds.x_max, strict=True))
    for name in plant.commands:
        if np.isfinite(most[name]):
            factor, unit = shown_unit(plant, name)
            parts.insert(0, f"{number(float(factor * most[name]), 4)} {unit}")
    if not parts and any(np.isfinite(value) for value in most.values()):
        return "a state"
    return " and ".join(parts) or None


def amount(result: FitResult, values: Array) -> str:
    """The value of the first command in `values` (m,) with its unit."""
    plant = result.given.plant
    factor, unit = shown_unit(plant, plant.controls[0])
    return f"{number(float(factor * values[0]))} {unit}"


def shift_halves(result: FitResult) -> dict[str, Array]:
    """Half widths of the 95 % intervals of the time shifts (trials,) in s, by signal."""
    problem = result.estimate.problem
    names = [name for kind, name in problem.signal_errors if kind == "shift"]
    found = TWO_SIDED * problem.plant.dt * np.array(result.estimate.covariance.shifts)
    return dict(zip(names, found, strict=True)) if found.size else {}


def shifted(plant: Plant, name: str, much: str, *, late: bool) -> str:
    """What a time shift means for the recording of a signal."""
    if name in plant.disturbances:
        return f"acts {much} {'later' if late else 'earlier'} than recorded"
    return f"is recorded {much} too {'late' if late else 'early'}"


def shift_words(result: FitResult) -> list[str]:
    """Sentences on signals whose time shift differs from zero in a trial."""
    plant, halves, said = result.given.plant, shift_halves(result), []
    for kind, name, values in result.estimate.problem.fitted_errors:
        if kind != "shift" or name not in halves or not np.any(np.abs(values) > halves[name]):
            continue
        value, half = 1e3 * float(np.mean(values)), 1e3 * float(np.mean(halves[name]))
        ends = f"{abs(value):.2g} ms ({max(abs(value) - half, 0):.2g} to {abs(value) + half:.2g})"
        differ = float(np.ptp(values)) > 2 * float(np.max(halves[name]))
        each = " on average; trials differ (see the table of errors)" if differ else ""
        how = shifted(plant, name, ends, late=value > 0)
        said.append(f"The {signal_name(plant, name)} {how}{each}.")
    return said


def shares(result: FitResult, values: Array, digits: int = 2) -> str:
    """VAF (p,) with output names: 99.99 % (seat tilt) and 99.98 % (trunk tilt)."""
    plant = result.given.plant
    parts = [
        f"{value:.{digits}f} % ({signal_name(plant, name)})" if np.isfinite(value)
        else f"not available ({signal_name(plant, name)}; a simulation stops early)"
        for name, value in zip(plant.outputs, values, strict=True)
    ]  # fmt: skip
    return " and ".join(parts)


def held_out(result: FitResult) -> Array | None:
    """Mean VAF of left-out trials (p,); None if there are none."""
    each = result.inverse_mpc.held_out
    return np.mean(each, axis=0) if len(each) else None


def left_out_text(result: FitResult) -> str:
    """VAF in left-out trials if there are any, else in fitted trials."""
    where = ", in fitted trials" if held_out(result) is None else " in left-out trials"
    return f"{shares(result, explained(result.inverse_mpc))} of the variance{where}."


def reported_shares(result: FitResult) -> tuple[Array, str]:
    """VAF (p,) that counts: of left-out trials if there are any and the fitted are explained."""
    own, held = result.inverse_mpc.vaf, held_out(result)
    if result.weights_test.rejected:
        own = result.gain_shares
    if held is None or np.any(own < LITTLE) or np.any(np.isnan(own)):
        return own, "the recordings"
    return held, "left-out trials"


def explained_words(result: FitResult) -> str:
    """The shares of `reported_shares`, output by output."""
    plant, (found, _) = result.given.plant, reported_shares(result)
    said = []
    for name, value in zip(plant.outputs, found, strict=True):
        words = signal_name(plant, name)
        if np.isnan(value):
            said.append(f"an unknown part of the {words} (the simulation stops early)")
        elif value < 0:
            said.append(f"nothing of the {words} (it is further off than no movement at all)")
        else:
            said.append(f"{value:.0f} % of the {words}")
    return " and ".join(said)


def unlimited_ratio(result: FitResult) -> tuple[float, str]:
    """Largest ratio of unexplained variances, best method without limit over model, in words."""
    others = [
        item.vaf
        for item in result.methods[:-1]
        if not np.any(np.isfinite(item.estimate.problem.bounds.u_max))
    ]
    left = [100 - vaf for vaf in others if not np.any(np.isnan(vaf))]
    if not left:
        return float("nan"), ""
    own = np.maximum(100 - result.inverse_mpc.vaf, 1e-9)
    ratios = min((np.asarray(one) / own for one in left), key=lambda one: float(np.max(one)))
    place = int(np.argmax(ratios))
    if ratios[place] < MATTERS:
        return float(ratios[place]), " A controller without a limit explains nearly as much."
    name = signal_name(result.given.plant, result.given.plant.outputs[place])
    much = number(float(ratios[place]), 2)
    said = f" Without a limit, {much} times as much variance of the {name} is left unexplained."
    return float(ratios[place]), said


def no_limit(result: FitResult) -> str:
    """Reason why no statement about the limit is possible."""
    limit = given_limit(result)
    if limit is None:
        return "No limit was given."
    if not result.met:
        return "The limit was never reached."
    return f"The limit of {limit} is in doubt."


def decided(result: FitResult) -> list[Statement]:
    """Decided comparisons of cost: they hold for all weights and (almost) all gains tried."""
    summary = result.uncertainty.weights
    return [] if summary is None else [item for item in summary.statements if item.made]


def statement_text(plant: Plant, item: Statement) -> str:
    """A comparison of cost in words."""
    one, other = signal_name(plant, item.first), signal_name(plant, item.second)
    more = "less" if item.holds is False else "more"
    if item.kind == "order":
        return f"A typical {one} costs {more} than a typical {other}."
    pair = f"{sentence_case(one)} and {other}"
    return f"{pair} to the same side cost {more} than to opposite sides."


def aim_data(result: FitResult) -> dict[str, Any]:
    """`aim` in result.json: targets, observer rates (1/s), errors of signals, recorded commands."""
    problem = result.fitted.problem
    plant, trials = problem.plant, problem.recordings
    count = physical_disturbances(plant)
    learned = zip(plant.disturbances[:count], plant.observer[:count], strict=True)
    controls = plant.commands or plant.controls
    recorded = [np.any(np.isfinite(trial.commands), axis=0) for trial in trials]
    return {
        "targets": tuple(dict.fromkeys(name for trial in trials for name in trial.signals)),
        "ahead": plant.ahead,
        "observer_rate": {name: float(rate) for name, rate in learned if rate > 0},
        "errors": [
            {"kind": kind, "signal": name, "values": [float(one) for one in values]}
            for kind, name, values in problem.fitted_errors
        ],
        "commands": tuple(np.array(controls)[np.any(recorded, axis=0)].tolist()),
    }


def aim_sentences(result: FitResult) -> list[str]:
    """The contents of `aim_data` as a sentence; empty if the controller regulates to rest."""
    aim, plant = aim_data(result), result.fitted.problem.plant
    said = []
    if aim["targets"]:
        ahead = f", known {plant.ahead * plant.dt:.3g} s ahead" if plant.ahead else ""
        targets = " and ".join(signal_name(plant, name) for name in aim["targets"])
        said.append(f"the controller regulates to the target of {targets}{ahead}")
    for name, rate in aim["observer_rate"].items():
        how = "knows it at once"
        if np.isfinite(rate):
            fitted = (result.preferred.get(key) for key in (f"{OBSERVER}.{name}", OBSERVER))
            interval = next((item for item in fitted if item is not None), None)
            between = (
                f" (fitted, 95 %: {number(interval.low, 3)} to {number(interval.high, 3)})"
                if interval is not None
                else ""
            )
            how = f"learns it at a rate of {number(rate, 3)} 1/s{between}"
        said.append(f"it assumes that the {signal_name(plant, name)} persists and {how}")
    for kind, name, values in result.fitted.problem.fitted_errors:
        if kind == "shift":  # `shift_words`, with its interval
            continue
        factor, unit = error_unit(plant, kind, name)
        ends = f"{number(factor * min(values), 3)} to {number(factor * max(values), 3)} {unit}"
        said.append(f"the {signal_name(plant, name)} has {KINDS[kind][0]} in each trial, {ends}")
    if aim["commands"]:
        names = ", ".join(signal_name(plant, name) for name in aim["commands"])
        said.append(f"recorded commands ({names}) are fitted in addition to the outputs")
    text = "; ".join(said)
    return [f"{text[0].upper()}{text[1:]}."] if said else []
