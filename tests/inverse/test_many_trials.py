"""Memory is linear in the number of trials; figures show the worst-explained trials."""

from __future__ import annotations

import tracemalloc
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from experiments.coverage import cart
from impc.assess.covariance import gain_covariance
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.simulation import scenario
from impc.inverse.problem import Problem
from impc.inverse.search import refine_gain
from impc.model.bounds import Bounds
from impc.model.recordings import Recording
from impc.studies.fit.result import shown_trials

if TYPE_CHECKING:
    from collections.abc import Callable

GAIN = np.array([[1.6, 1.4]])


def of_trials(explained: list[float]) -> Any:
    return SimpleNamespace(trials=[SimpleNamespace(vaf=np.array([v, v])) for v in explained])


def test_few_trials_are_all_drawn() -> None:
    assert shown_trials(of_trials([90.0, 20.0, 50.0])) == [0, 1, 2]


def test_of_500_those_that_are_explained_least() -> None:
    explained = np.random.default_rng(0).uniform(0, 100, 500).tolist()
    shown = shown_trials(of_trials(explained))
    assert shown == sorted(shown)
    assert len(shown) == 24
    assert max(explained[index] for index in shown) == np.sort(explained)[23]


def starts_unknown(trials: int) -> Problem:
    """Short noisy trials of a cart with unknown initial states."""
    plant, rng = cart(), np.random.default_rng(1)
    bounds = Bounds(plant, u_min=-1, u_max=1)
    controller = Controller.from_gain(plant, GAIN, bounds, 5, terminal_set=False)
    recordings = []
    for _ in range(trials):
        push = np.repeat(rng.choice([-0.8, 0.0, 0.8], 6), 10)
        begin = scenario(plant, 0.1 * rng.standard_normal(2), disturbance=push)
        outputs = (simulate(controller, begin).x @ plant.C.T)[:60]
        recordings.append(Recording(plant, outputs + 0.02 * rng.standard_normal((60, 1)), push))
    return Problem(plant, bounds, 5, tuple(recordings), terminal_set=False, unknown_start=True)


def peak_of(work: Callable[[], object]) -> int:
    """Peak memory of numpy during a call, bytes."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


WORK: dict[str, Callable[[Problem], object]] = {
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
