"""A plan as a value: every experiment tried, the best of them, and what groups would show.

See docs/planning.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.optimize

from impc.arrays import Frozen, frozen
from impc.studies.effort import SECONDS_A_SAMPLE, Effort
from impc.studies.plan.designs import (
    Design,
    Outcome,
    best_of,
    designs,
    try_design,
)
from impc.studies.plan.simulated_fits import SimulatedFits, simulated_fits

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.arrays import Array
    from impc.studies.plan.designs import Person, Perturbation
    from impc.studies.plan.settings import PlanSettings
    from impc.studies.plan.simulated_fits import RememberFit

_SIZE, _POWER = 0.05, 0.8
# Persons in a group: a t-test needs two, and nobody measures more.
_SMALLEST, _LARGEST = 2.0, 1e6
# Simulations with derivatives of a fit that begins at the truth: 20 to 40 with limits.
_A_FIT = 40


@dataclass(frozen=True)
class GroupPower(Frozen):
    """Whether two groups can be told apart by one price."""

    feature: str  # Whose price
    # Of the logarithm of an estimate within a group: of persons and of the estimate
    deviation: float
    powers: Array  # How often a t-test at 5 % sees the difference, for each size of group (g,)
    needed: float  # Persons in each group for 80 %; infinite beyond a million


@dataclass(frozen=True)
class Plan(Frozen):
    """What experiments would tell of a presumed person."""

    person: Person
    settings: PlanSettings
    outcomes: tuple[Outcome, ...]  # One an experiment, in the order of `designs`
    best: Outcome  # With the least mean variance of the logarithms of prices (A-optimal)
    sharpest: Outcome  # With the least determinant of their covariance (D-optimal)
    groups: tuple[GroupPower, ...]  # For the best one, one a price
    simulated: SimulatedFits | None  # Of the best one


def _grid(settings: PlanSettings) -> tuple[Design, ...]:
    return designs(settings.amplitude, [math.nan] if settings.files else settings.dwell)


def steps_of(settings: PlanSettings) -> int:
    """Count of the steps that `make_plan` tells of."""
    return len(_grid(settings)) + settings.fits


def make_plan(
    person: Person,
    settings: PlanSettings,
    perturbation: Perturbation,
    done: Callable[[str], None] = lambda _: None,
    remember: RememberFit = lambda _, compute: compute(),
) -> Plan:
    """Try every experiment on the person.

    `perturbation` (samples, d).
    """
    outcomes = []
    for design in _grid(settings):
        outcomes.append(
            try_design(person, design, perturbation, trials=settings.trials, draws=settings.draws)
        )
        done(f"amplitude {design.amplitude:g}")
    best, sharpest = best_of(outcomes, settings.falls / 100)
    fits = None
    if settings.fits and best.problem is not None:
        fits = simulated_fits(person, best.problem, settings.fits, settings.seed, done, remember)
    groups = group_powers(person, best, settings)
    return Plan(person, settings, tuple(outcomes), best, sharpest, groups, fits)


def group_powers(
    person: Person, outcome: Outcome, settings: PlanSettings
) -> tuple[GroupPower, ...]:
    """Two groups whose prices differ by `settings.difference`, each estimated once a person."""
    if outcome.expected is None:
        return ()
    from statsmodels.stats.power import TTestIndPower  # noqa: PLC0415  # a second to load

    test, apart = TTestIndPower(), math.log1p(settings.difference / 100)
    found = []
    for name, own in zip(person.structure.unknowns, outcome.expected.deviations, strict=True):
        deviation = math.hypot(float(own), settings.between / 100)
        if not math.isfinite(deviation) or deviation == 0:
            nothing = frozen(np.full(len(settings.groups), _SIZE))
            found.append(GroupPower(name, deviation, nothing, math.inf))
            continue
        effect = apart / deviation
        powers = [float(test.power(effect, size, _SIZE)) for size in settings.groups]
        found.append(GroupPower(name, deviation, frozen(powers), _needed(test, effect)))
    return tuple(found)


def _needed(test: Any, effect: float) -> float:
    """Least size of a group that sees an effect, in deviations, with `_POWER`."""

    def lacking(size: float) -> float:
        return float(test.power(effect, size, _SIZE)) - _POWER

    # From below: far above, the noncentral t has no numbers.
    size = _SMALLEST
    while lacking(size) < 0:
        if size > _LARGEST:
            return math.inf
        size *= 2
    if size == _SMALLEST:
        return size
    return math.ceil(scipy.optimize.brentq(lacking, size / 2, size, xtol=1e-6))


def plan_effort(person: Person, settings: PlanSettings) -> Effort:
    """What `make_plan` will take: simulations, and those that are differentiated for the fits."""
    plant, m = person.controller.plant, person.controller.plant.m
    samples = settings.duration / plant.dt
    once = samples * plant.n * person.controller.horizon * SECONDS_A_SAMPLE
    tried = len(_grid(settings)) * (max(settings.draws, settings.trials) + 4 * settings.trials)
    along = plant.n * (m + 1) + m**2
    numbers = 4 * samples * settings.trials * (plant.n + m) * along
    return Effort(once * (tried + _A_FIT * settings.trials * settings.fits), 8e-9 * numbers)
