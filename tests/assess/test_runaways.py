"""Who runs away now and then: against a simulation written anew, and where nobody can."""

from __future__ import annotations

import control
import numpy as np
import pytest

import impc
from impc.assess.runaways import SIMULATED, runaways, running_away
from impc.checking import replace
from impc.control.noisy_person import simulate_person
from impc.inverse.likelihood_fit import PersonFit

pytestmark = pytest.mark.full

SAMPLES, POLE, LIMIT, MOTOR = 1200, 1.04, 0.5, 1.1


def unstable() -> impc.Plant:
    """x+ = 1.04 x + .1 (u + d): beyond x = .1 .5 / .04 = 1.25 no command brings it back."""
    system = control.ss([[POLE]], [[0.1, 0.1]], [[1]], 0, 0.1, states=["x"], inputs=["u", "push"])
    return impc.Plant(system, ["u"])


def push() -> np.ndarray:
    return np.repeat(np.random.default_rng(3).choice([-0.1, 0.0, 0.1], SAMPLES // 10), 10)


def fitted(limit: float) -> PersonFit:
    """Of the first trial of somebody who sees all and does not run away in it."""
    plant = unstable()
    bounds = impc.Bounds(plant, u_min=-limit, u_max=limit)
    law = impc.Controller.from_gain(plant, [[1.6]], bounds, 1, terminal_set=False)
    person = impc.Observer(plant, motor=MOTOR)
    made = (
        simulate_person(law, person, push(), recorder=0.01, seed=seed).outputs for seed in range(99)
    )
    outputs = next(each for each in made if np.max(np.abs(each)) < 1)
    trial = impc.Recording(plant, outputs, push())
    problem = impc.Problem(plant, bounds, 1, [trial], terminal_set=False)
    return impc.fit_person(impc.estimate(problem), person)


def test_as_many_run_away_as_in_a_simulation_written_anew() -> None:
    fit = fitted(LIMIT)
    gain, motor = float(fit.K[0, 0]), float(fit.observer.motor[0])
    far = 10 * np.max(np.abs(fit.problem.recordings[0].outputs))
    rng, count = np.random.default_rng(0), 4000
    x, largest = np.full(count, fit.problem.recordings[0].x0[0]), np.zeros(count)
    for d in push():
        largest = np.maximum(largest, np.abs(x))
        u = np.clip(-gain * x, -LIMIT, LIMIT)
        x = POLE * x + 0.1 * (u + motor * rng.standard_normal(count) + d)
    share = np.mean(largest > far)
    assert 0.05 < share < 0.95
    assert abs(runaways(fit) / SIMULATED - share) < 4 * np.sqrt(share * (1 - share) / SIMULATED)


def test_with_two_inputs_it_is_counted_as_well() -> None:
    """Two copies of the plant side by side: a trial runs away where either does."""
    system = control.ss(
        POLE * np.eye(2), np.hstack([0.1 * np.eye(2), [[0.1], [0.1]]]), np.eye(2), 0, 0.1,
        states=["x", "y"], inputs=["u", "v", "push"],
    )  # fmt: skip
    plant = impc.Plant(system, ["u", "v"])
    bounds = impc.Bounds(plant, u_min=[-LIMIT, -LIMIT], u_max=[LIMIT, LIMIT])
    law = impc.Controller.from_gain(plant, 1.6 * np.eye(2), bounds, 1, terminal_set=False)
    person = impc.Observer(plant, motor=MOTOR)
    driven = [(push(), np.zeros(2))]
    both = running_away(law, person, driven, np.array([5.0, 5.0]), 0)
    first = running_away(law, person, driven, np.array([5.0, np.inf]), 0)
    second = running_away(law, person, driven, np.array([np.inf, 5.0]), 0)
    assert 0 < max(first, second) < both <= first + second < 2 * SIMULATED


def test_an_output_that_never_moved_is_never_left_behind() -> None:
    fit = fitted(LIMIT)
    still = impc.Recording(fit.problem.plant, np.zeros((SAMPLES, 1)), push())
    assert runaways(replace(fit, problem=replace(fit.problem, recordings=(still,)))) == 0


def test_where_no_bound_is_met_nobody_runs_away() -> None:
    assert runaways(fitted(50.0)) == 0
