"""Fits of simulated recordings of a planned experiment: what the plan foresaw, seen.

Each fit begins at the truth and searches the recordings without linearisation. So it shows how the
best answer scatters, not whether a search finds it from the default start (docs/structures.md).
See docs/planning.md.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.signal

from impc.arrays import Array, Frozen, frozen
from impc.assess.printed_gain import told_gain
from impc.checking import replace
from impc.errors import ImpcError
from impc.inverse.structured_fit import structured_estimate
from impc.inverse.structured_search import search_from
from impc.model.recordings import Recording

if TYPE_CHECKING:
    from impc.assess.expected import Expectation
    from impc.inverse.problem import Problem
    from impc.studies.plan.designs import Person

# Correlation left of the noise before the first sample: 1e-6.
_FORGOTTEN = 14.0
# Of a normal distribution, one deviation to each side.
_MIDDLE = (15.866, 84.134)


@dataclass(frozen=True)
class SimulatedFits(Frozen):
    """What so many fits found."""

    prices: Array  # Unknowns of the structure (fits, count); minus infinity for a price of zero
    gains: Array  # Gain without a structure, as it is printed with intervals (fits, m, n)
    failed: int  # Fits that ended without an answer

    def inside(self, expected: Expectation) -> Array:
        """Share of the fits whose unknowns lie in the expected intervals (count,)."""
        ends = np.array([[item.low, item.high] for item in expected.intervals])
        held = (self.prices >= ends[:, 0]) & (self.prices <= ends[:, 1])
        return np.asarray(np.mean(held, axis=0))


def spread(values: Array) -> Array:
    """Half of what the middle 68 % span (k,), of values (fits, k): a deviation without tails."""
    low, high = np.percentile(values, _MIDDLE, axis=0, method="inverted_cdf")
    return np.asarray((high - low) / 2)


@dataclass(frozen=True)
class OneFit(Frozen):
    """What one of them found; both empty where it ended without an answer."""

    prices: Array
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
    truth = np.array(person.prices)

    def fit(number: int) -> OneFit:
        noisy = _measured(person, problem, np.random.default_rng([seed, number]))
        try:
            end = search_from(noisy, person.structure, truth)
            fitted = structured_estimate(noisy, person.structure, end)
            gain = told_gain(fitted.problem, np.array(fitted.gain), np.array(fitted.metric)).K
        except ImpcError:  # counted, and told
            return OneFit(frozen([]), frozen([]))
        return OneFit(frozen(end.prices), frozen(gain))

    found = []
    for number in range(count):
        found.append(remember(f"fit {number + 1}", functools.partial(fit, number)))
        done(f"fit {number + 1}")
    ended = [one for one in found if len(one.prices)]
    return SimulatedFits(
        frozen(np.reshape([one.prices for one in ended], (-1, len(truth)))),
        frozen(np.reshape([one.gain for one in ended], (-1, *person.controller.K.shape))),
        count - len(ended),
    )


def _measured(person: Person, problem: Problem, rng: np.random.Generator) -> Problem:
    trials = [
        Recording(
            problem.plant,
            trial.outputs + recorded_noise(person, trial.samples, rng),
            trial.disturbance,
            trial.x0,
        )
        for trial in problem.recordings
    ]
    return replace(problem, recordings=trials, output_scale=person.deviation)


def recorded_noise(person: Person, samples: int, rng: np.random.Generator) -> Array:
    """Stationary first-order noise of the recorder of a person (samples, p), drawn from `rng`."""
    root = person.root
    before = 0 if root == 0 else int(np.ceil(-_FORGOTTEN / np.log(root)))
    white = rng.standard_normal((samples + before, len(person.deviation)))
    noise = scipy.signal.lfilter([np.sqrt(1 - root**2)], [1.0, -root], white, axis=0)[before:]
    return np.asarray(noise * person.deviation)
