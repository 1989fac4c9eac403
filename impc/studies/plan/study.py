"""Compute a plan: experiments, the best one, power of comparisons, simulated fits.

Fits to simulated recordings check the expected intervals. They start at the truth and use the
full nonlinear search: they show the scatter of the best solution, not whether a search from the
default start finds it (docs/howto/plan.md).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from impc.arrays import Array, Frozen, frozen
from impc.assess.covariance import TWO_SIDED
from impc.checking import replace
from impc.errors import ImpcError, SolverError
from impc.inverse.problem import simulated
from impc.inverse.refit import refit
from impc.studies.effort import SECONDS_A_SAMPLE, Effort
from impc.studies.plan.designs import Design, Outcome, best_of, designs, relative_errors, try_design

if TYPE_CHECKING:
    from impc.assess.expected import Expectation
    from impc.inverse.problem import Problem
    from impc.studies.plan.designs import Person, Perturbation
    from impc.studies.plan.settings import PlanSettings

_SIZE, _POWER = 0.05, 0.8
# Range of the number of persons per group; a t-test needs two.
_SMALLEST, _LARGEST = 2.0, 1e6
# Simulations with derivatives of a fit that starts at the true weights: 20 to 40 with limits.
_A_FIT = 40


@dataclass(frozen=True)
class GroupPower(Frozen):
    """Power of a comparison of two groups by one gain."""

    # SD of estimates within a group relative to the gain, between persons and by estimation
    deviation: float
    powers: Array  # Power of a t-test at 5 % for each group size (g,)
    needed: float  # Persons per group for a power of 80 %; infinite above a million


@dataclass(frozen=True)
class Plan(Frozen):
    """Result of `make_plan`."""

    person: Person
    settings: PlanSettings
    outcomes: tuple[Outcome, ...]  # One per experiment, in the order of `designs`
    best: Outcome  # Smallest mean variance of the gains (A-optimal)
    groups: tuple[GroupPower, ...]  # For the best experiment, one per gain that is shown
    simulated: SimulatedFits | None  # For the best experiment


def _grid(settings: PlanSettings) -> tuple[Design, ...]:
    return designs(settings.amplitude, [math.nan] if settings.files else settings.dwell)


def steps_of(settings: PlanSettings) -> int:
    """Number of steps that `make_plan` reports."""
    return len(_grid(settings)) + settings.fits


def make_plan(
    person: Person,
    settings: PlanSettings,
    perturbation: Perturbation,
    done: Callable[[str], None] = lambda _: None,
    remember: RememberFit = lambda _, compute: compute(),
) -> Plan:
    """Simulate all experiments, choose the best, and check it by simulated fits if requested."""
    outcomes = []
    for design in _grid(settings):
        outcomes.append(
            try_design(person, design, perturbation, trials=settings.trials, draws=settings.draws)
        )
        done(f"amplitude {design.amplitude:g}")
    best, fits = best_of(person, outcomes, settings.falls / 100), None
    if settings.fits and best.problem is not None:
        fits = simulated_fits(person, best.problem, settings.fits, settings.seed, done, remember)
    return Plan(person, settings, tuple(outcomes), best, group_powers(person, best, settings), fits)


def group_powers(
    person: Person, outcome: Outcome, settings: PlanSettings
) -> tuple[GroupPower, ...]:
    """Power to detect `settings.difference` between two groups, one estimate per person."""
    if outcome.expected is None:
        return ()
    from statsmodels.stats.power import TTestIndPower  # noqa: PLC0415  # a second to load

    test, found = TTestIndPower(), []
    for error in relative_errors(person, outcome.expected.deviations).tolist():
        deviation = math.hypot(error, settings.between / 100)
        if not math.isfinite(deviation) or deviation == 0:
            nothing = frozen(np.full(len(settings.groups), _SIZE))
            found.append(GroupPower(deviation, nothing, math.inf))
            continue
        effect = settings.difference / 100 / deviation
        powers = [float(test.power(effect, size, _SIZE)) for size in settings.groups]
        found.append(GroupPower(deviation, frozen(powers), _needed(test, effect)))
    return tuple(found)


def _needed(test: Any, effect: float) -> float:
    """Smallest group size that detects an effect (in SDs) with `_POWER`."""

    def lacking(size: float) -> float:
        return float(test.power(effect, size, _SIZE)) - _POWER

    # Start from below: for large sizes the noncentral t distribution is not computable.
    size = _SMALLEST
    while lacking(size) < 0:
        if size > _LARGEST:
            return math.inf
        size *= 2
    if size == _SMALLEST:
        return size
    return math.ceil(scipy.optimize.brentq(lacking, size / 2, size, xtol=1e-6))


def plan_effort(person: Person, settings: PlanSettings) -> Effort:
    """Effort of `make_plan`: simulations, and simulations with derivatives for the fits."""
    plant, m = person.controller.plant, person.controller.plant.m
    samples = settings.duration / plant.dt
    once = samples * plant.n * person.controller.horizon * SECONDS_A_SAMPLE
    tried = len(_grid(settings)) * (max(settings.draws, settings.trials) + 4 * settings.trials)
    along = plant.n * (m + 1) + m**2
    numbers = 4 * samples * settings.trials * (plant.n + m) * along
    return Effort(once * (tried + _A_FIT * settings.trials * settings.fits), 8e-9 * numbers)


# Length of the noise's transient that is dropped, in correlation times: exp(-14) is 1e-6.
_FORGOTTEN = 14.0


@dataclass(frozen=True)
class SimulatedFits(Frozen):
    """Results of the fits to simulated recordings."""

    gains: Array  # (fits, m, n)
    failed: int  # Number of fits without a solution, including simulations with a fall

    def inside(self, person: Person, expected: Expectation) -> Array:
        """Share of the fits whose gains are inside the expected intervals (m, n)."""
        apart = np.abs(self.gains - np.array(person.controller.K))
        return np.asarray(np.mean(apart <= TWO_SIDED * expected.deviations, axis=0))


def spread(values: Array) -> Array:
    """Half the range (...) of the middle 68 % of values (fits, ...): a robust SD."""
    low, high = np.percentile(values, (15.866, 84.134), axis=0, method="inverted_cdf")
    return np.asarray((high - low) / 2)


#: (name, compute) -> the gain of a fit (m, n), stored or computed; empty if it failed.
RememberFit = Callable[[str, Callable[[], Array]], Array]


def simulated_fits(
    person: Person,
    problem: Problem,
    count: int,
    seed: int,
    done: Callable[[str], None] = lambda _: None,
    remember: RememberFit = lambda _, compute: compute(),
) -> SimulatedFits:
    """Fit recordings of one experiment `count` times, each with new noise."""
    K, S = np.array(person.controller.K), np.array(person.controller.S)

    def fit(number: int) -> Array:
        try:
            noisy = _measured(person, problem, np.random.default_rng([seed, number]))
            return np.array(refit(noisy, K, S).K)
        except ImpcError:  # counted as failed
            return np.empty(0)

    gains = []
    for number in range(count):
        found = remember(f"fit {number + 1}", functools.partial(fit, number))
        gains += [found] if len(found) else []
        done(f"fit {number + 1}")
    return SimulatedFits(frozen(np.reshape(gains, (-1, *K.shape))), count - len(gains))


def _measured(person: Person, problem: Problem, rng: np.random.Generator) -> Problem:
    """Noisy recordings with the assumed gain, in a body drawn from its stated uncertainty."""
    unknown = np.where(problem.stated, problem.parameter_units, 0.0)
    moved, trials = unknown * rng.standard_normal(len(unknown)), []
    drawn = problem.at(problem.starts, moved)
    runs = simulated(drawn, np.array(person.controller.K), np.array(person.controller.S))
    for trial, run in zip(problem.recordings, runs, strict=True):
        if not run.complete:
            raise SolverError("simulation", "the simulated subject falls", "reduce amplitude")
        noise = recorded_noise(person, trial.samples, rng)
        trials.append(replace(trial, outputs=run.x @ drawn.plant.C.T + noise))
    noisy = replace(problem, recordings=trials, output_scale=person.deviation)
    return noisy.at(noisy.starts, moved)


def recorded_noise(person: Person, samples: int, rng: np.random.Generator) -> Array:
    """Draw stationary first-order recording noise (samples, p)."""
    root = person.root
    before = 0 if root == 0 else int(np.ceil(-_FORGOTTEN / np.log(root)))
    white = rng.standard_normal((samples + before, len(person.deviation)))
    noise = scipy.signal.lfilter([np.sqrt(1 - root**2)], [1.0, -root], white, axis=0)[before:]
    return np.asarray(noise * person.deviation)
