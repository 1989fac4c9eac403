"""Verdict, key numbers and checks of a plan."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from impc.arrays import Array
from impc.assess.covariance import TWO_SIDED
from impc.assess.expected import MULTIPLES, Expectation
from impc.levels import Level
from impc.reporting.document import Check, Copy
from impc.reporting.rendering import number, sentence_case
from impc.reporting.rules import Kind, Rules, always
from impc.reporting.shown_units import shown_unit, signal_name
from impc.reporting.verdict import Key
from impc.studies.fit.facts import with_unit
from impc.studies.fit.findings import number_name
from impc.studies.plan.designs import Design, gain_places, relative_errors
from impc.studies.plan.study import Plan

# Widest interval that is printed as a percentage of the gain.
_WIDEST = 3.0
_HELD = 0.8  # Smallest acceptable coverage of the intervals in simulated fits


def expected(plan: Plan) -> Expectation:
    """Expected standard errors of the best experiment."""
    assert plan.best.expected is not None  # ensured by `best_of`
    return plan.best.expected


class ShownGain(NamedTuple):
    """An entry of the gain that a plan shows."""

    key: str  # In names of columns: the state, with the input before it if there are several
    name: str  # In words: "seat tilt", "seat tilt to left torque"
    control: str
    state: str


def shown_gains(plan: Plan) -> list[ShownGain]:
    """Entries of the gain whose single values have a meaning."""
    plant, found = plan.person.controller.plant, []
    for i, k in np.argwhere(gain_places(plant)).tolist():
        control, state = plant.controls[i], plant.states[k]
        key = state if plant.m == 1 else f"{control}_{state}"
        name = number_name(plant, f"K.{control}.{state}")
        found.append(ShownGain(key, name, control, state))
    return found


def gain_names(plan: Plan) -> list[str]:
    """Names of these in words."""
    return [one.name for one in shown_gains(plan)]


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


def halves(plan: Plan) -> Array:
    """Half widths of the 95 % intervals relative to the gains that are shown (k,)."""
    return TWO_SIDED * relative_errors(plan.person, expected(plan).deviations)


def target(plan: Plan) -> float:
    """Largest allowed half width, relative to the gain."""
    return plan.settings.difference / 100


def widths(plan: Plan) -> tuple[Array, Array]:
    """Numbers of trials (k,), and half widths of the intervals relative to the gains (k, count)."""
    counts = plan.settings.trials * np.array(MULTIPLES)
    kept = (counts >= 1) & (counts % 1 == 0)
    errors = np.array(expected(plan).by_trials)[kept]
    return counts[kept], TWO_SIDED * relative_errors(plan.person, errors)


def trials_needed(plan: Plan) -> float:
    """Smallest number of trials with all intervals within the target; infinite if none."""
    counts, sides = widths(plan)
    worst = np.max(sides, axis=1)
    if not worst[-1] <= target(plan):
        return math.inf
    logs = np.log(np.minimum(worst, np.finfo(float).max))
    at = np.interp(math.log(target(plan)), logs[::-1], np.log(counts[::-1]))
    needed = math.ceil(math.exp(at) - 1e-6)
    short = np.any(halves(plan) > target(plan))
    return max(needed, plan.settings.trials + 1) if short else min(needed, plan.settings.trials)


def stated_as(half: float) -> str:
    """Interval relative to the gain: "±8 %"."""
    return f"±{number(100 * half, 2)} %" if half < _WIDEST else "not determined"


class Facts:
    """Numbers and phrases of the verdict."""

    def __init__(self, plan: Plan) -> None:
        found, needed, tried = expected(plan), trials_needed(plan), len(plan.outcomes)
        sides, aim = halves(plan).tolist(), target(plan)
        self.count, self.good = len(sides), sum(side <= aim for side in sides)
        self.missed = "; ".join(
            f"{name}: {stated_as(side)}"
            for name, side in zip(gain_names(plan), sides, strict=True)
            if side > aim
        )
        self.gains = "gain" if self.count == 1 else "gains"
        self.every = {1: "the", 2: "both"}.get(self.count, f"all {self.count}")
        self.aim, self.close = f"{plan.settings.difference:g} %", stated_as(max(sides))[1:]
        ends = "s" if plan.settings.trials == 1 else ""
        self.verb = f"{sentence_case(_experiment(plan))} determine{ends}"
        which = f"best of {tried} experiments" if tried > 1 else "only simulated experiment"
        self.chosen = f"This is the {which}: {design_name(plan, plan.best.design)}."
        self.more, self.record = f"{max(widths(plan)[0]):g} trials would not be enough.", ""
        if math.isfinite(needed):
            self.more = f"{needed:.0f} trials would be enough for all."
            self.record = f"Record {needed:.0f} trials."
        self.inside, self.share = _inside(plan), f"{100 * _inside(plan):.0f} %"
        self.measure = ""
        if found.exact is not None:
            self.measure = "Measure the body more exactly; the table of the body lists the "
            self.measure += "parameters."


_WIDE = Kind[Facts](
    Level.AMBER, lambda it: it.good < it.count,
    "{verb} {good} of {count} {gains} to within {aim}.", "{more} {chosen}",
    "Some intervals are too wide", "95 % intervals, relative to the gain: {missed}.",
    "A difference of {aim} in these gains could not be detected in one person.",
    ("{record}", "{measure}",
     "Try stronger or longer perturbations, and more amplitudes and hold times.",
     "Or accept a larger difference."),
    badge="Depends",
)  # fmt: skip
RULES = Rules[Facts](
    {},
    kinds=(
        replace(
            _WIDE, level=Level.RED, when=lambda it: not it.good, title="All intervals are too wide",
            headline="{verb} no gain to within {aim}.", badge="Not enough",
        ),
        _WIDE,
        replace(
            _WIDE, when=lambda it: it.inside < _HELD, title="Fits do not confirm the intervals",
            headline="The intervals are probably too narrow.", badge="Doubtful",
            found="{share} of the fits to simulated recordings are inside the 95 % intervals.",
            means="{verb} the gains less precisely than predicted.",
            todo=("{measure}", "Try experiments that reach the limit less often."),
        ),
        Kind(Level.GREEN, always, "{verb} {every} {gains} to within {close}.", "{chosen}",
             badge="Enough"),
    ),
)  # fmt: skip


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
    within = f"for all gains to within {settings.difference:g} %"
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
    tried, inside = "None: set fits = 100 in [plan] to fit simulated recordings.", _inside(plan)
    if fits is not None:
        tried = f"{100 * inside:.0f} % of the fitted gains were inside the expected 95 % intervals "
        tried += f"in {len(fits.gains)} fits; {fits.failed} fits failed."
    good, doubt, note = Level.GREEN, Level.AMBER, Level.NOTE
    exact = "Taken as exact: state how well it is known in [plant.uncertainty]."
    stated = "The intervals include the stated uncertainty of the body."
    falls = f"{100 * plan.best.falls:.0f} % of the simulated trials; {plan.settings.falls:g} % are "
    known = found.exact is not None
    rows = [
        (good, "Falls", f"{falls}accepted."),
        (good if limit else note, "Limit", limit or "Never reached, or none is assumed."),
        (good if known else doubt, "Body", stated if known else exact),
        (note if fits is None else good if inside >= _HELD else doubt, "Simulated fits", tried),
        (note, "Noise", "Measurement noise only; noise in muscles and senses widens intervals."),
    ]
    return [Check(*row) for row in rows]


def _inside(plan: Plan) -> float:
    """Share of the gains of simulated fits inside the expected intervals; 1 without fits."""
    fits, person = plan.simulated, plan.person
    if fits is None:
        return 1.0
    if not len(fits.gains):
        return 0.0
    shown = gain_places(person.controller.plant)
    return float(np.mean(fits.inside(person, expected(plan))[shown]))


def plan_copy(plan: Plan) -> Copy | str:
    """Text on the sample size for a paper, or the reason why there is none."""
    settings = plan.settings
    needed = [
        f"{item.needed:.0f} persons per group for the gain on {name}"
        for item, name in zip(plan.groups, gain_names(plan), strict=True)
        if math.isfinite(item.needed)
    ]
    if not needed:
        return "No number of persons would be enough to detect the difference."
    return Copy(
        f"The sample size was computed for one assumed person, simulated with "
        f"{_experiment(plan)}. Persons within a group were assumed to differ by "
        f"{settings.between:g} % (standard deviation of a gain), in addition to the expected error "
        "of each estimate.",
        f"To detect a difference of {settings.difference:g} % between two groups with a power of "
        f"80 % (two-sided t-test, 5 %) requires {'; '.join(needed)}.",
    )
