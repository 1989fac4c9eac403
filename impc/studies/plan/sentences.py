"""What a plan says in sentences.

See docs/planning.md.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from impc.reporting.rendering import number
from impc.reporting.shown_units import shown_unit
from impc.studies.plan.study import spread

if TYPE_CHECKING:
    from impc.assess.weight_profiles import WeightInterval
    from impc.studies.plan.designs import Design, Outcome
    from impc.studies.plan.study import Plan

# Wider than this, from end to end of an interval, a cost weight is not called identified.
_WIDE = math.log(100)
# So many parameters of the body are named; a smaller share of a width is no floor.
_NAMED, _FLOOR = 3, 0.1
# Nearer to one on both sides, an interval is printed in percent.
_NARROW = 1.5


def design_name(plan: Plan, design: Design) -> str:
    """An experiment in words: "5 N m, each value held for 0.25 s"."""
    if math.isnan(design.dwell):
        return f"the recorded perturbation times {design.amplitude:g}"
    plant = plan.person.controller.plant
    unit = plant.unit(plant.disturbances[0])
    return f"{design.amplitude:g} {unit}, each value held for {design.dwell:g} s"


def stated_as(item: WeightInterval) -> str:
    """An interval about the presumed value: "-7 to +8 %", "0.4 to 2.1 times", "0 to 3 times"."""
    if math.isinf(item.high):
        least = math.exp(item.low - item.value)
        return "not at all" if least == 0 else f"{number(least, 2)} times and more"
    low, high = (math.exp(end - item.value) for end in (item.low, item.high))
    if low > 1 / _NARROW and high < _NARROW:
        return f"{100 * (low - 1):+.2g} to {100 * (high - 1):+.2g} %"
    return f"{number(low, 2)} to {number(high, 2)} times"


def plan_sentences(plan: Plan) -> tuple[str, ...]:
    """The answer first, then what stands behind it."""
    best, settings = plan.best, plan.settings
    count = len(plan.outcomes)
    which = "The experiment" if count == 1 else f"The best of {count} experiments"
    trials = "trial" if settings.trials == 1 else "trials"
    length = "their recorded length" if settings.files else f"{settings.duration:g} s"
    return (
        f"{which}, {settings.trials} {trials} of {length}: {design_name(plan, best.design)}.",
        _cost_weights(plan),
        *_body(plan),
        _limits(plan),
        _how_it_goes(plan, best),
        _groups(plan),
        *_seen(plan),
        "Computed for the presumed person, who senses without error, and for noise in the recorder "
        "alone: noise in the loop, or a body farther from the plant than stated, makes all worse.",
    )


def _cost_weights(plan: Plan) -> str:
    expected = plan.best.expected
    if expected is None:
        return "Nothing is identified."
    named = dict(zip(plan.person.structure.unknowns, expected.intervals, strict=True))
    parts = [f"{name} {stated_as(item)}" for name, item in named.items()]
    wide = [name for name, item in named.items() if item.high - item.low > _WIDE]
    text = (
        f"Beside the presumed cost weight, an interval of 95 % would be for {'; for '.join(parts)}."
    )
    return f"{text} That says next to nothing of {', '.join(wide)}." if wide else text


def _body(plan: Plan) -> tuple[str, ...]:
    """What comes from the body, and what would help: to measure it, or to record more."""
    expected = plan.best.expected
    if expected is None:
        return ()
    if expected.body is None:
        return (
            "The body is taken as exact: these intervals contain noise, and not what is uncertain "
            "of masses, lengths, delay, and limit ([plant.uncertainty] states it).",
        )
    body, names = expected.body, plan.person.structure.unknowns
    known = np.isfinite(expected.deviations)
    if not np.any(known):
        return ("It contains the stated uncertainty of the body.",)
    exact, tenfold, *measured = (
        100 * float(np.mean(expected.narrower(one)[known]))
        for one in (body.exact, body.tenfold, *body.measured)
    )
    best = sorted(zip(measured, body.names, strict=True), reverse=True)[:_NAMED]
    (most, first), *others = [(f"{share:.0f} %", name) for share, name in best]
    also = "".join(f", {name} by {share}" for share, name in others if share != "0 %")
    least = np.where(known, expected.narrower(body.floor), 1.0)
    worst = int(np.argmin(least))
    trials = f"Ten times as many trials would narrow them by {tenfold:.0f} % on average"
    if least[worst] < 1 - _FLOOR:
        most_by = f"{100 * least[worst]:.0f} %"
        trials += f"; no number of them narrows that of {names[worst]} by more than {most_by}"
    return (
        "These intervals contain the stated uncertainty of the body; if it were known exactly, "
        f"they would be {exact:.0f} % narrower on average.",
        f"Measuring {first} exactly would narrow them by {most}{also}. {trials}.",
    )


def _limits(plan: Plan) -> str:
    expected, controller = plan.best.expected, plan.person.controller
    if expected is None or not np.any(np.isfinite(controller.bounds.u_max)):
        return "The presumed person has no limit of the command."
    lines = []
    for name, deviation in zip(controller.plant.controls, expected.limits, strict=True):
        if np.isfinite(deviation):
            lines.append(f"the limit of {name} to ±{number(196 * float(deviation), 2)} %")
        else:
            lines.append(f"nothing on the limit of {name}, which is never met")
    return f"It would identify {'; '.join(lines)}."


def _how_it_goes(plan: Plan, best: Outcome) -> str:
    plant = plan.person.controller.plant
    peaks = []
    for name, value in zip(plant.outputs, best.peaks, strict=True):
        factor, unit = shown_unit(plant, name)
        peaks.append(f"{name} {number(factor * float(value), 2)} {unit}")
    return (
        f"The person falls in {100 * best.falls:.0f} % of {plan.settings.draws} simulated trials "
        f"and stands at the limit for {100 * best.at_limit:.1f} % of the time; the largest motion: "
        f"{', '.join(peaks)}. The noise leaves a VAF of at most {np.min(best.vaf):.1f} %."
    )


def _groups(plan: Plan) -> str:
    settings = plan.settings
    needed = ", ".join(
        f"{item.feature} {item.needed:.0f}"
        if math.isfinite(item.needed)
        else f"{item.feature} (no number is enough)"
        for item in plan.groups
    )
    return (
        f"To see a difference of {settings.difference:g} % between two groups, whose persons "
        f"differ by {settings.between:g} % themselves, with a probability of 80 %, each group "
        f"needs so many persons, by cost weight: {needed}."
    )


def _seen(plan: Plan) -> tuple[str, ...]:
    fits, expected = plan.simulated, plan.best.expected
    if fits is None or expected is None or len(fits.cost_weights) == 0:
        return ()
    held = fits.inside(expected)
    names = plan.person.structure.unknowns
    worst = int(np.argmin(held))
    ratios = spread(fits.cost_weights) / np.array(expected.deviations)
    known = ratios[np.isfinite(ratios)]
    text = (
        f"Of {len(fits.cost_weights)} fits of simulated recordings {100 * np.mean(held):.0f} % of "
        f"the cost weights lay in these intervals ({100 * held[worst]:.0f} % of {names[worst]})"
    )
    if len(known):
        text += f", and they scattered {known.min():.2f} to {known.max():.2f} times as foreseen"
    return (f"{text}; {fits.failed} fits failed.",)
