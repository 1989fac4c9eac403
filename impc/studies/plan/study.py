"""A plan as a value: every experiment tried, the best of them, and what groups would show.

Beside it fits of simulated recordings, which show what the plan foresaw. Each begins at the truth
and searches without linearisation: it shows how the best answer scatters, not whether a search
finds it from the default start. See docs/planning.md, docs/structures.md.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.optimize
import scipy.signal

from impc.arrays import Array, Frozen, frozen
from impc.assess.covariance import TWO_SIDED
from impc.assess.printed_gain import identified_gain
from impc.checking import replace
from impc.errors import ImpcError, SolverError
from impc.inverse.residuals import verify_hard
from impc.inverse.structured_fit import structured_estimate
from impc.inverse.structured_search import search_from
from impc.studies.effort import SECONDS_A_SAMPLE, Effort
from impc.studies.plan.designs import Design, Outcome, best_of, designs, try_design

if TYPE_CHECKING:
    from impc.assess.expected import Expectation
    from impc.inverse.problem import Problem
    from impc.studies.plan.designs import Person, Perturbation
    from impc.studies.plan.settings import PlanSettings

_SIZE, _POWER = 0.05, 0.8
# Persons in a group: a t-test needs two, and nobody measures more.
_SMALLEST, _LARGEST = 2.0, 1e6
# Simulations with derivatives of a fit that begins at the truth: 20 to 40 with limits.
_A_FIT = 40


@dataclass(frozen=True)
class GroupPower(Frozen):
    """Whether two groups can be distinguished by one cost weight."""

    feature: str  # Whose cost weight
    # Of the logarithm of an estimate within a group: of persons and of the estimate, by its
    # interval; infinite where that has no end
    deviation: float
    powers: Array  # How often a t-test at 5 % sees the difference, for each size of group (g,)
    needed: float  # Persons in each group for 80 %; infinite beyond a million


@dataclass(frozen=True)
class Plan(Frozen):
    """What experiments would identify of a presumed person."""

    person: Person
    settings: PlanSettings
    outcomes: tuple[Outcome, ...]  # One an experiment, in the order of `designs`
    best: Outcome  # With the least mean variance of the logarithms of cost weights (A-optimal)
    sharpest: Outcome  # With the least determinant of their covariance (D-optimal)
    groups: tuple[GroupPower, ...]  # For the best one, one a cost weight
    simulated: SimulatedFits | None  # Of the best one


def _grid(settings: PlanSettings) -> tuple[Design, ...]:
    return designs(settings.amplitude, [math.nan] if settings.files else settings.dwell)


def steps_of(settings: PlanSettings) -> int:
    """Count of the steps that `make_plan` says of."""
    return len(_grid(settings)) + settings.fits


def make_plan(
    person: Person,
    settings: PlanSettings,
    perturbation: Perturbation,
    done: Callable[[str], None] = lambda _: None,
    remember: RememberFit = lambda _, compute: compute(),
) -> Plan:
    """Try every experiment on the person; `perturbation` (samples, d)."""
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
    """Two groups whose weights differ by `settings.difference`, each estimated once a person."""
    if outcome.expected is None:
        return ()
    from statsmodels.stats.power import TTestIndPower  # noqa: PLC0415  # a second to load

    test, apart = TTestIndPower(), math.log1p(settings.difference / 100)
    found = []
    for name, own in zip(person.structure.unknowns, outcome.expected.intervals, strict=True):
        deviation = math.hypot((own.high - own.low) / (2 * TWO_SIDED), settings.between / 100)
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


# Correlation left of the noise before the first sample: 1e-6.
_FORGOTTEN = 14.0


@dataclass(frozen=True)
class SimulatedFits(Frozen):
    """What so many fits found."""

    cost_weights: Array  # Unknowns (fits, count); minus infinity for a cost weight of zero
    gains: Array  # Gain without a structure, as it is printed with intervals (fits, m, n)
    failed: int  # Fits that ended without an answer, and bodies that fell

    def inside(self, expected: Expectation) -> Array:
        """Share of the fits whose unknowns lie in the expected intervals (count,)."""
        ends = np.array([[item.low, item.high] for item in expected.intervals])
        held = (self.cost_weights >= ends[:, 0]) & (self.cost_weights <= ends[:, 1])
        return np.asarray(np.mean(held, axis=0))


def spread(values: Array) -> Array:
    """Half of what the middle 68 % span (k,), of values (fits, k): a deviation without tails."""
    low, high = np.percentile(values, (15.866, 84.134), axis=0, method="inverted_cdf")
    return np.asarray((high - low) / 2)


@dataclass(frozen=True)
class OneFit(Frozen):
    """What one of them found; both empty where it ended without an answer."""

    cost_weights: Array
    gain: Array


#: (name, compute) -> a fit: from memory, or computed now.
RememberFit = Callable[[str, Callable[[], OneFit]], OneFit]


def simulated_fits(
    person: Person,
    problem: Problem,
    count: int,
    seed: int,
    done: Callable[[str], None] = lambda _: None,
    remember: RememberFit = lambda _, compute: compute(),
) -> SimulatedFits:
    """Fit recordings of one experiment with fresh noise, again and again."""
    truth = np.array(person.cost_weights)

    def fit(number: int) -> OneFit:
        try:
            noisy = _measured(person, problem, np.random.default_rng([seed, number]))
            end = search_from(noisy, person.structure, truth)
            fitted = structured_estimate(noisy, person.structure, end)
            gain = identified_gain(fitted.problem, np.array(fitted.gain), np.array(fitted.metric)).K
        except ImpcError:  # counted, and identified
            return OneFit(frozen([]), frozen([]))
        return OneFit(frozen(end.cost_weights), frozen(gain))

    found = []
    for number in range(count):
        found.append(remember(f"fit {number + 1}", functools.partial(fit, number)))
        done(f"fit {number + 1}")
    ended = [one for one in found if len(one.cost_weights)]
    return SimulatedFits(
        frozen(np.reshape([one.cost_weights for one in ended], (-1, len(truth)))),
        frozen(np.reshape([one.gain for one in ended], (-1, *person.controller.K.shape))),
        count - len(ended),
    )


def _measured(person: Person, problem: Problem, rng: np.random.Generator) -> Problem:
    """Recordings of the presumed weights in a body drawn from what is stated of it."""
    unknown = np.where(problem.stated, problem.parameter_units, 0.0)
    drawn = problem.at(problem.starts, unknown * rng.standard_normal(len(unknown)))
    weights, trials = person.structure.weights(person.cost_weights), []
    for trial, run in zip(problem.recordings, verify_hard(drawn, weights), strict=True):
        if not run.complete:
            raise SolverError("simulation", "the person falls", "lower amplitude")
        noise = recorded_noise(person, trial.samples, rng)
        trials.append(replace(trial, outputs=run.x @ drawn.plant.C.T + noise))
    return replace(problem, recordings=trials, output_scale=person.deviation)


def recorded_noise(person: Person, samples: int, rng: np.random.Generator) -> Array:
    """Stationary first-order noise of the recorder of a person (samples, p), drawn from `rng`."""
    root = person.root
    before = 0 if root == 0 else int(np.ceil(-_FORGOTTEN / np.log(root)))
    white = rng.standard_normal((samples + before, len(person.deviation)))
    noise = scipy.signal.lfilter([np.sqrt(1 - root**2)], [1.0, -root], white, axis=0)[before:]
    return np.asarray(noise * person.deviation)
