"""Fits of simulated recordings of a planned experiment: what the plan foresaw, seen.

Each fit begins at the truth and searches the recordings without linearisation. So it shows how the
best answer scatters, not whether a search finds it from the default start (docs/structures.md).
See docs/planning.md.
"""

from __future__ import annotations

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
    from collections.abc import Callable

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


def simulated_fits(
    person: Person,
    problem: Problem,
    count: int,
    seed: int,
    done: Callable[[str], None] = lambda _: None,
) -> SimulatedFits:
    """Fit recordings of one experiment with fresh noise, again and again."""
    prices, gains, failed = [], [], 0
    truth = np.array(person.prices)
    for number in range(count):
        noisy = _measured(person, problem, np.random.default_rng([seed, number]))
        try:
            end = search_from(noisy, person.structure, truth)
            fitted = structured_estimate(noisy, person.structure, end)
            gain = told_gain(fitted.problem, np.array(fitted.gain), np.array(fitted.metric)).K
        except ImpcError:  # counted, and told
            failed += 1
        else:
            prices.append(np.array(end.prices))
            gains.append(np.array(gain))
        done(f"fit {number + 1}")
    shape = (-1, *person.controller.K.shape)
    return SimulatedFits(
        frozen(np.reshape(prices, (-1, len(truth)))), frozen(np.reshape(gains, shape)), failed
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
