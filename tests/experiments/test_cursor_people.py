"""The sensorimotor model of followers, on simulated subjects with known parameters."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import scipy.stats

import plants
from experiments.cursor_data import RATE, Condition
from experiments.cursor_people import FIRST, Follower, fit_follower, judged, nats, regression_nats
from impc.control.controller import Controller
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.structure import Structure
from impc.output_feedback.intervals import level_interval, person_covariance
from impc.output_feedback.observer import Observer
from impc.output_feedback.simulation import simulate_person
from tests.support import nelder_mead

pytestmark = pytest.mark.full

DELAY, LAG, OFFSET, COST_WEIGHT = 8, 0.03, 3.0, 20.0
#: True noise SDs and tolerances of their logarithms, about four standard errors: the noise that is
#: drawn depends on the eigenvectors of the processor.
LEVELS = {"motor command": (50.0, 0.4), "sensory error": (10.0, 1.0)}
#: The first second of a trial is conditioned on.
COUNTED = 60


@functools.cache
def simulated() -> Condition:
    """Four trials of 15 s; the target moves by random steps of one pixel (SD) a sample."""
    plant = Plant(plants.pursuit_plant(DELAY, LAG), ["command"])
    law = Controller(
        plant,
        Structure(plant, ["error"]).weights(np.log([COST_WEIGHT])),
        Bounds(plant),
        20,
        terminal_set=False,
    )
    person = Observer(
        plant, ["error", "velocity"], motor=50.0, sensory=[10.0, 20.0], walk=RATE, persistence=0
    )
    targets, responses = [], []
    for seed in range(4):
        rate = RATE * np.random.default_rng([seed, 1]).standard_normal(900)
        run = simulate_person(law, person, rate, recorder=0.2, seed=seed)
        target = np.concatenate([[0.0], np.cumsum(rate[:-1]) / RATE])
        targets.append(target)
        responses.append(run.outputs[:, 0] + target + OFFSET)
    return Condition(13.0, np.array(targets), np.array(responses))


@functools.cache
def fitted() -> Follower:
    return fit_follower(simulated(), np.arange(4), (DELAY,), COUNTED)


def test_what_a_follower_senses_is_found() -> None:
    follower = fitted()
    levels = follower.fit.levels
    found = dict(zip(follower.fit.space.names, levels, strict=True))
    identified = person_covariance(follower.fit, "expected")
    deviations = dict(zip(follower.fit.space.names, identified.levels, strict=True))
    assert follower.offset == pytest.approx(OFFSET, abs=1.5)
    for name, (value, near) in LEVELS.items():
        assert abs(np.log(found[name] / value)) < min(near, 3.5 * deviations[name]), name
    assert found["process error"] < 0.1
    assert follower.fit.converged


def test_the_interval_of_an_sd_near_zero_ends_at_the_profile_fall() -> None:
    """Compared with another search; along the ridge the process noise moves by powers of e.

    A search from the ridge alone can end a thousand nats too low, and the interval too early.
    """
    fit = fitted().fit
    index = fit.space.own + fit.space.names.index("recorder error")
    value = float(np.log(level_interval(fit, index - fit.space.own)[0]))
    prior = fit.space.freed(np.eye(len(fit.theta))[index])

    def lower(rest: np.ndarray) -> float:
        place = prior.tried(np.insert(rest, index, value))
        return 1e6 if place is None else fit_value - place.value

    fit_value = prior.placed(np.array(fit.theta), fit.identified).value
    rest = np.delete(np.array(fit.theta), index)
    # Half of 1.96^2; the root of the fall is found to 0.04 of 1.39.
    assert nelder_mead(lower, rest, 400) == pytest.approx(1.92, abs=0.15)


def test_a_free_regression_is_that_of_its_normal_equations() -> None:
    """Compared with rows written out one by one; and no better than the truth."""
    condition, mine, others = simulated(), np.array([0, 1]), np.array([2, 3])

    def row(trial: int, t: int) -> list[float]:
        before = condition.response[trial, t - 20 : t]
        return [*before, *condition.target[trial, t - 59 : t + 1], 1.0]

    def table(which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pairs = [(row(k, t), condition.response[k, t]) for k in which for t in range(FIRST, 900)]
        return np.array([pair[0] for pair in pairs]), np.array([pair[1] for pair in pairs])

    X, y = table(mine)
    found = np.linalg.solve(X.T @ X, X.T @ y)
    deviation = float(np.sqrt(np.mean((y - X @ found) ** 2)))
    X, y = table(others)
    expected = float(np.mean(scipy.stats.norm(X @ found, deviation).logpdf(y)))
    identified = regression_nats(condition, mine, others)
    assert identified == pytest.approx(expected, abs=1e-6)
    assert identified < nats(judged(fitted(), condition, others))
