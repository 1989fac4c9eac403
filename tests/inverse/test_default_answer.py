"""The default search on problems with known solutions, in any units."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import count, islice

import control
import numpy as np
import pytest

import impc
from experiments.search_problems import Known, random_problem, stick_problem
from experiments.search_study import is_right, warned
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.residuals import residual_only
from impc.inverse.search import refine_gain
from impc.inverse.table31 import inverse_mpc_reduced
from impc.model.plant import change_coordinates
from tests.support import (
    example_plant,
    example_problem,
    plant_of,
    posed,
    present,
    regulator,
)
from tests.support import random_problem as saturated_problem

HELD = plant_of([[1.1, 0.2], [0, 0.9]], [[0], [1]])
#: Maker by seed; numbers of problems in the fast and in the slow test; of the latter, at most so
#: many are wrong, and at most so many of these carry no warning.
KINDS: dict[str, tuple[Callable[[int], Known | None], int, int, int, int]] = {
    "stick": (stick_problem, 3, 100, 2, 0),
    "one input": (random_problem, 20, 200, 2, 2),
    "two inputs": (lambda seed: random_problem(seed, 2), 3, 100, 1, 1),
    "three inputs": (lambda seed: random_problem(seed, 3), 3, 100, 1, 1),
    # From an unknown state.
    "half": (lambda seed: random_problem(seed, half=True), 3, 67, 6, 0),
    "half, two inputs": (lambda seed: random_problem(seed, 2, half=True), 1, 50, 5, 0),
}


def first_of(make: Callable[[int], Known | None], wanted: int) -> Iterator[Known]:
    """First problems of a kind with 5 to 45 % of the samples at the limit."""
    made = map(make, count())
    return islice((one for one in made if one and 0.05 <= one.saturated < 0.45), wanted)


@pytest.mark.parametrize("slow", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", KINDS)
def test_known_problems(kind: str, slow: bool) -> None:
    make, few, many, wrong, silent = KINDS[kind]
    pairs = [(known, fit_controller(known.problem))
             for known in first_of(make, many if slow else few)]  # fmt: skip
    missed = [found for known, found in pairs if not is_right(known, found)]
    assert len(missed) <= (wrong if slow else 0)
    assert sum(not warned(found) for found in missed) <= silent


def test_a_stick_that_falls_with_any_other_gain_ends_at_its_gain() -> None:
    """50 samples a second, error 0.02 degrees; no other regulator can be simulated."""
    known = present(stick_problem(418))
    found, (trial,) = fit_controller(known.problem), known.problem.recordings
    assert found.noise <= refine_gain(known.problem, known.K, known.S).misfit * (1 + 1e-4)
    for one in (found, inverse_mpc_reduced(known.problem)):
        assert np.allclose(one.gain, known.K, rtol=2e-3)
    assert found.converged
    assert found.fit.white
    residual = found.misfit**2 / trial.samples
    assert residual == pytest.approx(np.radians(0.02) ** 2 / np.mean(trial.outputs**2), rel=0.1)


def test_a_command_always_at_its_bound_identifies_nothing() -> None:
    """Any larger gain gives the same recording."""
    law = regulator(HELD, np.eye(2), 0.1, 4)
    run = law.simulate([5.0, 5.0], 10)
    assert np.all(np.abs(np.abs(run.u) - 0.1) < 1e-9)
    found = impc.fit(posed(law, impc.Recording(HELD, run.x), unknown_start=False))
    assert found.explained
    assert found.fit.rank == 0
    assert impc.identifiability(found.problem, found.stage_weights).rank == 0
    assert any("identify 0 of the 2 directions" in doubt for doubt in found.doubts)


@pytest.mark.parametrize(("limit", "rank"), [(50.0, 0), (0.25, 2)])
def test_directions_of_the_metric_are_counted_and_said(limit: float, rank: int) -> None:
    """Exact trials from eight states; the limit decides how often inputs are saturated."""
    rng = np.random.default_rng(3)
    plant = plant_of(rng.normal(size=(3, 3)) / 2, rng.normal(size=(3, 2)))
    weights = impc.Weights(np.eye(3), [[1.0, 0.3], [0.3, 2.0]])
    law = regulator(plant, weights.Q, limit, 5, weights.R)
    starts = np.random.default_rng(1).normal(size=(8, 3))
    trials = [impc.Recording(plant, law.simulate(x0, 15).x) for x0 in starts]
    problem = posed(law, *trials, terminal_set=False)
    found = impc.fit(problem)
    assert found.explained
    assert found.fit.metric_rank == rank
    said = f"identify {rank} of the 2 directions of the metric S"
    assert (said in found.summary()) == (rank < 2)
    # Independent: whether another metric with this gain gives another movement.
    other = np.array(found.metric) + np.diag([0.0, np.trace(found.metric) / 4])
    moved = residual_only(found.problem, np.array(found.gain), other)
    assert (np.linalg.norm(moved) > 1e-6) == (rank > 0)
    free = impc.fit(problem, "feedback_gain", start=found)
    assert not any("metric" in text for text in free.doubts)  # without bounds
    begun = np.linalg.norm(residual_only(problem, np.array(law.K), np.array(law.S)))
    assert impc.fit(problem, start=weights).misfit <= begun + 1e-9


@pytest.mark.parametrize(("x0", "horizon"), [((-1.9, -2.6), 2), ((0.6, 1.4), 1)])
def test_the_terminal_set_is_decided_by_the_recordings(x0: list[float], horizon: int) -> None:
    """Controllers with and without a terminal set differ, and each is found."""
    plant, runs = example_plant(), []
    for kept in (False, True):
        law = regulator(plant, np.eye(2), 1, horizon, 0.01, terminal_set=kept)
        runs.append(law.simulate(x0, 20).x)
        found = impc.fit(posed(law, impc.Recording(plant, runs[-1])))
        assert found.explained
        assert found.problem.terminal_set == kept
        assert ("has a terminal set" in str(found)) == kept
        assert np.allclose(found.gain, law.K, atol=1e-6)
    assert np.max(np.abs(runs[0] - runs[1])) > 0.01


UNITS = [1e-12, 1e-5, 1e5, 1e12]


@pytest.mark.parametrize(
    ("states", "inputs"),
    [*((one, one) for one in UNITS), (np.array([1e-3, 1.0, 1e3, 10.0]), np.array([100.0, 0.01]))],
)
def test_two_inputs_do_not_depend_on_units(states: np.ndarray, inputs: np.ndarray) -> None:
    """With x = diag(states) z and u = diag(inputs) v the gain becomes G^-1 K T."""
    controller, problem = saturated_problem(2, 2)
    T, G, (trial,) = np.eye(4) * states, np.eye(2) * inputs, problem.recordings
    moved = change_coordinates(problem.plant, T, G)
    B = np.hstack([moved.B, moved.E])
    plant = impc.Plant(control.ss(moved.A, B, np.eye(4), 0, True, inputs=["u0", "u1", "d0"]),
                       ["u0", "u1"])  # fmt: skip
    again = impc.Recording(plant, trial.outputs @ np.linalg.inv(T), trial.disturbance)
    limit = 1 / np.diag(G)
    bounds = impc.Bounds(plant, u_min=-limit, u_max=limit)
    other = impc.Problem(plant, bounds, problem.horizon, (again,), terminal_set=False)
    found, expected = inverse_mpc_reduced(other), np.linalg.solve(G, controller.K @ T)
    assert found.explained
    np.testing.assert_allclose(found.gain / expected, np.ones((2, 4)), rtol=1e-9)
    allowed = inverse_mpc_reduced(problem).evaluations * (1 if np.isscalar(states) else 2)
    assert found.evaluations <= allowed
    fitted = fit_controller(other).gain
    np.testing.assert_allclose(fitted / expected, np.ones((2, 4)), rtol=1e-8)


def test_output_scale_is_the_size_of_each_output() -> None:
    problem = example_problem("A")
    size = np.sqrt(np.mean(problem.recordings[0].outputs ** 2, axis=0))
    np.testing.assert_allclose(problem.output_scale, size, rtol=1e-12)
    silent = impc.Recording(problem.plant, np.array([[0.0, 3.0], [0.0, 4.0]]))
    quiet = impc.Problem(problem.plant, problem.bounds, 3, (silent,))
    np.testing.assert_allclose(quiet.output_scale, [np.sqrt(12.5)] * 2, rtol=1e-12)
