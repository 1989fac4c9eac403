"""Memory is linear in the number of trials; figures show the worst-explained trials."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import impc
from experiments.coverage import cart
from impc.assess.covariance import gain_covariance
from impc.control.closed_loop import simulate
from impc.inverse.search import refine_gain
from impc.studies.fit.result import shown_trials
from tests.support import posed

GAIN = np.array([[1.6, 1.4]])


def shown(explained: list[float]) -> list[int]:
    found: Any = SimpleNamespace(trials=[SimpleNamespace(vaf=np.full(2, v)) for v in explained])
    return shown_trials(found)


def test_trials_that_are_explained_least_are_drawn() -> None:
    assert shown([90.0, 20.0, 50.0]) == [0, 1, 2]
    explained = np.random.default_rng(0).uniform(0, 100, 500)
    found = shown(explained.tolist())
    assert found == sorted(found)
    assert len(found) == 24
    assert max(explained[found]) == np.sort(explained)[23]


def starts_unknown(trials: int) -> impc.Problem:
    """Short noisy trials of a cart with unknown initial states."""
    plant, rng, recordings = cart(), np.random.default_rng(1), []
    bounds = impc.Bounds(plant, u_min=-1, u_max=1)
    law = impc.Controller.from_gain(plant, GAIN, bounds, 5, terminal_set=False)
    for _ in range(trials):
        push = np.repeat(rng.choice([-0.8, 0.0, 0.8], 6), 10)
        begin = impc.scenario(plant, 0.1 * rng.standard_normal(2), disturbance=push)
        outputs = (simulate(law, begin).x @ plant.C.T)[:60]
        noise = 0.02 * rng.standard_normal((60, 1))
        recordings.append(impc.Recording(plant, outputs + noise, push))
    return posed(law, *recordings, terminal_set=False, unknown_start=True)


def peak_of(work: Callable[[], object]) -> int:
    """Peak memory of numpy during a call, bytes."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


WORK: dict[str, Callable[[impc.Problem], object]] = {
    "search": lambda problem: refine_gain(problem, GAIN, np.eye(1), max_evaluations=3, prior=2.0),
    "covariance": lambda problem: gain_covariance(problem, GAIN, np.eye(1)),
}


@pytest.mark.full
@pytest.mark.parametrize("name", WORK)
def test_memory_grows_as_the_trials_do(name: str) -> None:
    """Three times the trials need about three times the memory, not nine times."""
    few, many = (starts_unknown(count) for count in (60, 180))
    WORK[name](few)  # warm-up: compiled code and caches do not count
    assert peak_of(lambda: WORK[name](many)) < 4.5 * peak_of(lambda: WORK[name](few))
