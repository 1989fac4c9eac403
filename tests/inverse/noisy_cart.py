"""A cart whose driver senses with noise, at a limit or far from it."""

from __future__ import annotations

import numpy as np

from impc.control.controller import Controller
from impc.control.noisy_person import simulate_person
from impc.inverse.problem import Problem
from impc.model.bounds import Bounds
from impc.model.observer import Observer
from impc.model.recordings import Recording
from impc.model.weights import Weights
from tests.inverse.test_likelihood_fit import cart


def person(**levels: float) -> Observer:
    """Somebody with noise in motor and senses."""
    return Observer(cart(), ["x", "v"], motor=0.2, sensory=[0.1, 0.2], **levels)


def problem(limit: float, *, horizon: int = 5) -> Problem:
    """Three trials; with .7 N the limit is met in a third of the samples, with 50 N never."""
    bounds = Bounds(cart(), u_min=-limit, u_max=limit)
    law = Controller(cart(), Weights(np.diag([8.0, 1.0]), 1), bounds, horizon, terminal_set=False)
    rng, trials = np.random.default_rng(0), []
    for seed in range(3):
        push = np.repeat(rng.choice([-0.7, 0.0, 0.7], 30), 10)
        found = simulate_person(law, person(), push, recorder=0.01, seed=seed)
        trials.append(Recording(cart(), found.outputs, push))
    return Problem(cart(), bounds, horizon, trials, terminal_set=False)
