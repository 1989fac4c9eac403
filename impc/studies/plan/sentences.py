"""Verdict, key numbers and checks of a plan."""

from __future__ import annotations

import math
from dataclasses import replace
from operator import attrgetter
from typing import TYPE_CHECKING

import numpy as np

from impc.assess.covariance import TWO_SIDED
from impc.assess.expected import MULTIPLES
from impc.reporting.document import Check, Copy
from impc.reporting.finding import Level
from impc.reporting.rendering import number, sentence_case
from impc.reporting.rules import Kind, Rules, always
from impc.reporting.shown_units import shown_unit, signal_name, words_of
from impc.reporting.verdict import Key, Verdict
from impc.studies.fit.facts import with_unit

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.assess.expected import Expectation
    from impc.assess.weight_profiles import WeightInterval
    from impc.studies.plan.designs import Design
    from impc.studies.plan.study import Plan

# Intervals within this factor are printed in percent; widest (log) that is printed in percent.
_NARROW, _FACTOR = 1.5, math.log(3)
_PARTS = {"half": 1 / 2, "a third": 1 / 3, "a quarter": 1 / 4, "a fifth": 1 / 5, "a tenth": 1 / 10}
_NEAR = 0.1  # Relative distance within which a share is called by its fraction
_HELD = 0.8  # Smallest acceptable coverage of the intervals in simulated fits


def expected(plan: Plan) -> Expectation:
    """Expected intervals of the best experiment."""
    assert plan.best.expected is not None  # ensured by `best_of`
    return plan.best.expected


def weight_names(plan: Plan) -> list[str]:
    """Names of the cost weights in words: "seat tilt", "trunk tilt - seat tilt"."""
    person = plan.person
    return [words_of(person.controller.plant, name) for name in person.structure.unknowns]


def design_name(plan: Plan, design: Design) -> str:
    """An experiment in words: "5 N m, held for 0.25 s"."""
    if math.isnan(design.dwell):
        return f"{design.amplitude:g} times the recorded perturbation"
    plant = plan.person.controller.plant
    factor, unit = shown_unit(plant, plant.disturbances[0])
    amplitude = with_unit(number(factor * design.amplitude), unit)
    return f"{amplitude}, held for {design.dwell:g} s"


def listed(plan: Plan, names: tuple[str, ...], values: Array) -> str:
    """List of signals with values: "seat tilt 0.1°, trunk tilt 0.2°"."""
    plant, parts = plan.person.controller.plant, []
    for name, value in zip(names, values, strict=True):
        factor, unit = shown_unit(plant, name)
        shown = with_unit(number(factor * float(value)), unit)
        parts.append(f"{signal_name(plant, name)} {shown}")
    return ", ".join(parts)


def target(plan: Plan) -> float:
    """Largest allowed distance of interval ends, in the logarithm of a cost weight."""
    return math.log1p(plan.settings.difference / 100)


def half(item: WeightInterval) -> float:
    """Longer side of an interval of the logarithm."""
    return max(item.high - item.value, item.value - item.low)


def widths(plan: Plan) -> tuple[Array, Array]:
    """Numbers of trials (k,), and longer sides of the intervals (k, count)."""
    found = expected(plan)
    sides, errors = np.array([half(item) for item in found.intervals]), np.array(found.deviations)
    usable = np.isfinite(sides) & np.isfinite(errors)
    factors = np.where(usable, sides / np.where(usable, errors, 1.0), TWO_SIDED)
    counts = plan.settings.trials * np.array(MULTIPLES)
    kept = (counts >= 1) & (counts % 1 == 0)
    return counts[kept], np.array(found.by_trials)[kept] * factors


def trials_needed(plan: Plan) -> float:
    """Smallest number of trials with all intervals within the target; infinite if none."""
    counts, sides = widths(plan)
    worst = np.max(sides, axis=1)
    if not worst[-1] <= target(plan):
        return math.inf
    at = np.interp(math.log(target(plan)), np.log(worst[::-1]), np.log(counts[::-1]))
    needed = math.ceil(math.exp(at) - 1e-6)
    short = np.any([half(item) > target(plan) for item in expected(plan).intervals])
    return max(needed, plan.settings.trials + 1) if short else min(needed, plan.settings.trials)


def stated_as(item: WeightInterval) -> str:
    """Interval relative to the assumed value: "-7 to +8 %", "between a third and 2.1 times"."""
    low, high = (math.exp(end - item.value) for end in (item.low, item.high))
    if math.isinf(item.high):
        return "not determined" if low == 0 else f"{_part(low)} of the assumed value or more"
    if low > 1 / _NARROW and high < _NARROW:
        ends = [f"{100 * (end - 1):+.2g}".replace("-", "\u2212") for end in (low, high)]
        return f"{ends[0]} to {ends[1]} %"
    return f"between {_part(low)} and {number(high, 2)} times"


def _part(share: float) -> str:
    """A share in words if it is near a simple fraction, otherwise its number."""
    near = (word for word, part in _PARTS.items() if abs(share / part - 1) < _NEAR)
    return next(near, number(share, 2))


class _Facts:
    """Numbers and phrases of the verdict."""

    def __init__(self, plan: Plan) -> None:
        found, needed, tried = expected(plan), trials_needed(plan), len(plan.outcomes)
        sides, aim = [half(item) for item in found.intervals], target(plan)
        self.count, self.good = len(sides), sum(side <= aim for side in sides)
        self.missed = "; ".join(
            f"{name}: {stated_as(item)}"
            for name, item, side in zip(weight_names(plan), found.intervals, sides, strict=True)
            if side > aim
        )
        self.weights = "cost weight" if self.count == 1 else "cost weights"
        self.every = {1: "the", 2: "both"}.get(self.count, f"all {self.count}")
        self.aim, worst = f"{plan.settings.difference:g} %", max(sides)
        self.close = f"a factor of {number(math.exp(worst), 2)}"
        if worst < _FACTOR:
            self.close = f"{number(100 * math.expm1(worst), 2)} %"
        ends = "ies" if plan.settings.trials == 1 else "y"
        self.verb = f"{sentence_case(_experiment(plan))} identif{ends}"
        which = f"best of {tried} experiments" if tried > 1 else "only simulated experiment"
        self.chosen = f"This is the {which}: {design_name(plan, plan.best.design)}."
        self.more, self.record = f"{max(widths(plan)[0]):g} trials would not be enough.", ""
        if math.isfinite(needed):
            self.more = f"{needed:.0f} trials would be enough for all."
            self.record = f"Record {needed:.0f} trials."
        self.measure = ""
        if found.body is not None:
            self.measure = "Measure the body more exactly; the table of the body lists the "
            self.measure += "parameters."


_WORDS = ("count", "good", "missed", "weights", "every", "aim", "close", "verb", "chosen", "more",
          "record", "measure")  # fmt: skip
_WIDE = Kind[_Facts](
    Level.AMBER, lambda it: it.good < it.count,
    "{verb} {good} of {count} {weights} to within {aim}.", "{more} {chosen}",
    "Some intervals are too wide", "95 % intervals, relative to the assumed cost weight: {missed}.",
    "A difference of {aim} in these cost weights could not be detected in one person.",
    ("{record}", "{measure}",
     "Try stronger or longer perturbations, and more amplitudes and hold times.",
     "Assign cost weights to fewer features, or accept a larger difference."),
    badge="Depends",
)  # fmt: skip
RULES = Rules[_Facts](
    {name: attrgetter(name) for name in _WORDS},
    kinds=(
        replace(
            _WIDE, level=Level.RED, when=lambda it: not it.good, title="All intervals are too wide",
            headline="{verb} no cost weight to within {aim}.", badge="Not enough",
        ),
        _WIDE,
        Kind(Level.GREEN, always, "{verb} {every} {weights} to within {close}.", "{chosen}",
             badge="Enough"),
    ),
)  # fmt: skip


def plan_verdict(plan: Plan) -> Verdict:
    """Verdict: whether the intervals of the experiment are narrow enough."""
    return RULES.verdict(_Facts(plan))


def _experiment(plan: Plan) -> str:
    settings, name = plan.settings, design_name(plan, plan.best.design)
    words = ("one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
    count, s = settings.trials, "" if settings.trials == 1 else "s"
    many = words[count - 1] if count <= len(words) else str(count)
    if settings.files:
        return f"{many} trial{s} with {name}"
    return f"{many} {settings.duration:g}-s trial{s} at {name.partition(',')[0]}"


def plan_keys(plan: Plan) -> list[Key]:
    """Key numbers: trials needed, risk of a fall, time at the limit."""
    settings, best, needed = plan.settings, plan.best, trials_needed(plan)
    trials = f"{needed:.0f}" if math.isfinite(needed) else f"> {max(widths(plan)[0]):g}"
    length = "as long as recorded" if settings.files else f"of {settings.duration:g} s"
    within = f"for all cost weights to within {settings.difference:g} %"
    simulated = f"in {max(settings.draws, settings.trials)} simulated trials"
    peaks = listed(plan, plan.person.controller.plant.outputs, best.peaks)
    return [
        Key(trials, f"trials {length}", "trials needed", within),
        Key(number(100 * best.falls), "%", "risk of a fall in a trial", simulated),
        Key(number(100 * best.at_limit), "% of the time", "at the limit", f"largest {peaks}"),
    ]


def plan_checks(plan: Plan) -> list[Check]:
    """Assumptions of the plan, and tests of them."""
    found, fits, controller = expected(plan), plan.simulated, plan.person.controller
    limit = ", ".join(
        f"{signal_name(controller.plant, name)} to ±{number(100 * TWO_SIDED * error, 2)} %"
        for name, error in zip(controller.plant.controls, map(float, found.limits), strict=True)
        if math.isfinite(error)
    )
    tried, inside = "None: set fits = 100 in [plan] to fit simulated recordings.", math.nan
    if fits is not None:
        inside = float(np.mean(fits.inside(found))) if len(fits.cost_weights) else 0.0
        tried = f"{100 * inside:.0f} % of the fitted cost weights were inside the expected 95 % "
        tried += f"intervals in {len(fits.cost_weights)} fits; {fits.failed} fits failed."
    size, own = found.gain.entries.size, int(np.sum(found.gain.individually_identified))
    good, doubt, note = Level.GREEN, Level.AMBER, Level.NOTE
    exact = "Taken as exact: state how well it is known in [plant.uncertainty]."
    stated = "The intervals include the stated uncertainty of the body."
    falls = f"{100 * plan.best.falls:.0f} % of the simulated trials; {plan.settings.falls:g} % are "
    free = f"Assumed. Without it {own} of {size} gains would be determined one by one."
    rows = [
        (good, "Falls", f"{falls}accepted."),
        (good if limit else note, "Limit", limit or "Never reached, or none is assumed."),
        (good if found.body else doubt, "Body", stated if found.body else exact),
        (note if fits is None else good if inside >= _HELD else doubt, "Simulated fits", tried),
        (note, "Form of the cost", free),
        (note, "Noise", "Measurement noise only; noise in muscles and senses widens intervals."),
    ]
    return [Check(*row) for row in rows]


def plan_copy(plan: Plan) -> Copy | str:
    """Text on the sample size for a paper, or the reason why there is none."""
    settings = plan.settings
    needed = [
        f"{item.needed:.0f} persons per group for the cost weight of {name}"
        for item, name in zip(plan.groups, weight_names(plan), strict=True)
        if math.isfinite(item.needed)
    ]
    if not needed:
        return "No number of persons would be enough to detect the difference."
    return Copy(
        f"The sample size was computed for one assumed person, simulated with "
        f"{_experiment(plan)}. Persons within a group were assumed to differ by "
        f"{settings.between:g} % (standard deviation of the logarithm of a cost weight), in "
        "addition to the expected error of each estimate.",
        f"To detect a difference of {settings.difference:g} % between two groups with a power of "
        f"80 % (two-sided t-test, 5 %) requires {'; '.join(needed)}.",
    )
