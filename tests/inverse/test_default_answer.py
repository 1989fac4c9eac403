"""The default search on problems with known solutions."""

from __future__ import annotations

from itertools import count, islice
from typing import TYPE_CHECKING

import control
import numpy as np
import pytest

import impc
from experiments.search_problems import Known, random_problem, stick_problem
from experiments.search_study import is_right, warned
from impc.checking import replace
from impc.control.closed_loop import simulate
from impc.control.simulation import scenario
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.search import refine_gain
from impc.inverse.table31 import inverse_mpc_reduced

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


def posed(make: Callable[[int], Known | None], wanted: int, low: float = 0.05) -> Iterator[Known]:
    """First problems of a kind with 5 to 45 % of the samples at the limit."""
    made = (make(seed) for seed in count())
    return islice((one for one in made if one and low <= one.saturated < 0.45), wanted)


def score(problems: Iterator[Known]) -> tuple[int, int]:
    """Number of wrong results, and how many of them carry no warning."""
    wrong = silent = 0
    for known in problems:
        found = fit_controller(known.problem)
        if not is_right(known, found):
            wrong, silent = wrong + 1, silent + (not warned(found))
    return wrong, silent


def recorded_stick() -> tuple[control.StateSpace, np.ndarray, np.ndarray]:
    """Stick on a fingertip, 50 samples per second: plant, noisy angle in degrees, pushes."""
    states = {"states": ["angle", "rate"], "inputs": ["finger", "push"], "outputs": ["angle"]}
    continuous = control.ss(
        [[0, 1], [9.81 * 1.5, 0]], [[0, 0], [-1.5, 1]], [[1, 0]], [[0, 0]], **states
    )
    system, rng = control.c2d(continuous, 0.02), np.random.default_rng(1)
    push = np.repeat(rng.choice([-1.5, 0.0, 1.5], 60), 10)
    x, angle = np.zeros(2), []
    for d in push:
        finger = np.clip(25 * x[0] + 7 * x[1], -1.2, 1.2)
        angle.append(np.degrees(x[0]) + 0.02 * rng.standard_normal())
        x = system.A @ x + system.B @ [finger, d]
    return system, np.array(angle), push


def test_a_noisy_stick_ends_at_its_gain() -> None:
    system, angle, push = recorded_stick()
    plant = impc.Plant(system, ["finger"])
    trial = impc.Recording(plant, np.radians(angle), push)
    settings = impc.FitSettings(horizon=15, u_max=1.2)
    found = impc.fit(impc.fit_problem(plant, [trial], settings))
    assert np.allclose(found.gain, [[-25, -7]], rtol=2e-3)
    assert found.converged
    assert found.fit.white
    residual = found.misfit**2 / len(angle)
    assert residual == pytest.approx(np.radians(0.02) ** 2 / np.var(trial.outputs), rel=0.1)


@pytest.mark.parametrize("wanted", [3, pytest.param(100, marks=pytest.mark.slow)])
def test_sticks_at_their_limit(wanted: int) -> None:
    wrong, silent = score(posed(stick_problem, wanted))
    assert wrong <= wanted // 50
    assert silent == 0


def test_a_stick_that_falls_with_any_other_gain_has_its_weights() -> None:
    """No starting regulator, nor weights near one, can be simulated."""
    known = stick_problem(418)
    assert known is not None
    found = fit_controller(known.problem)
    assert is_right(known, found)
    assert np.allclose(found.gain, known.K, rtol=2e-3)
    reduced = inverse_mpc_reduced(known.problem)
    assert np.allclose(reduced.gain, known.K, rtol=2e-3)


@pytest.mark.parametrize("wanted", [20, pytest.param(200, marks=pytest.mark.slow)])
def test_exact_recordings_of_one_input(wanted: int) -> None:
    assert score(posed(random_problem, wanted))[0] <= wanted // 100


@pytest.mark.parametrize("inputs", [2, 3])
@pytest.mark.parametrize("wanted", [3, pytest.param(100, marks=pytest.mark.slow)])
def test_exact_recordings_of_several_inputs(inputs: int, wanted: int) -> None:
    assert score(posed(lambda seed: random_problem(seed, inputs), wanted))[0] <= wanted // 100


@pytest.mark.parametrize("wanted", [3, pytest.param(67, marks=pytest.mark.slow)])
def test_half_of_the_outputs_from_an_unknown_state(wanted: int) -> None:
    wrong, silent = score(posed(lambda seed: random_problem(seed, half=True), wanted))
    assert wrong <= wanted // 10
    assert silent == 0


@pytest.mark.slow
def test_half_of_the_outputs_of_two_inputs() -> None:
    wrong, _ = score(posed(lambda seed: random_problem(seed, 2, half=True), 50))
    assert wrong <= 5


def test_a_command_always_at_its_bound_identifies_nothing() -> None:
    """Any larger gain gives the same recording."""
    plant = impc.Plant(control.ss([[1.1, 0.2], [0, 0.9]], [[0], [1]], np.eye(2), 0, True))
    bounds = impc.Bounds(plant, u_min=-0.1, u_max=0.1)
    law = impc.Controller(plant, impc.Weights(np.eye(2), 1), bounds, 4, terminal_set=False)
    run = simulate(law, scenario(plant, [5.0, 5.0], 10))
    assert np.all(np.abs(np.abs(run.u) - 0.1) < 1e-9)
    problem = impc.Problem(plant, bounds, 4, [impc.Recording(plant, run.x)], unknown_start=False)
    found = impc.fit(problem)
    assert found.explained
    assert found.fit.rank == 0
    assert impc.identifiability(found.problem, found.stage_weights).rank == 0
    assert any("identify 0 of the 2 directions" in doubt for doubt in found.doubts)


@pytest.mark.full
def test_the_rank_is_that_of_the_derivative() -> None:
    """One trial with two inputs and 12 outputs, against singular values of finite differences."""
    known = next(posed(lambda seed: random_problem(seed, 2, half=True, samples=12), 1))
    found = fit_controller(known.problem)

    def residual(K: np.ndarray, x0: np.ndarray) -> np.ndarray:
        trial = replace(found.problem.recordings[0], x0=x0)
        law = impc.Controller.from_gain(
            found.problem.plant,
            K,
            found.problem.bounds,
            found.problem.horizon,
            metric=found.metric,
            terminal_set=False,
        )
        drive = scenario(found.problem.plant, x0, len(trial.outputs) - 1)
        return (simulate(law, drive).x @ found.problem.plant.C.T).ravel()

    K, x0 = np.array(found.gain), np.array(found.problem.recordings[0].x0)
    columns = []
    for index in range(K.size + x0.size):
        step = np.zeros(K.size + x0.size)
        step[index] = 1e-6
        ends = [
            residual(K + sign * step[: K.size].reshape(K.shape), x0 + sign * step[K.size :])
            for sign in (1, -1)
        ]
        columns.append((ends[0] - ends[1]) / 2e-6)
    J = np.array(columns).T
    on_gain, on_start = J[:, : K.size], J[:, K.size :]
    left = on_gain - on_start @ np.linalg.lstsq(on_start, on_gain)[0]
    values = np.linalg.svd(left, compute_uv=False)
    assert found.fit.rank <= np.count_nonzero(values > 1e-7 * values[0])
    assert found.fit.rank >= np.count_nonzero(values > 1e-3 * values[0])


def test_two_motors_of_one_joint() -> None:
    """B has equal columns: Q = I and R = I explain the recordings."""
    plant = impc.Plant(control.ss([[1, 0.1], [0.2, 1]], [[0, 0], [1, 2]], np.eye(2), 0, 1))
    bounds = impc.Bounds(plant, u_min=-0.3, u_max=0.3)
    law = impc.Controller(plant, impc.Weights(np.eye(2), np.eye(2)), bounds, 10)
    rng = np.random.default_rng(0)
    trials = [
        impc.Recording(plant, law.simulate(rng.uniform(-0.5, 0.5, 2), 40).x) for _ in range(4)
    ]
    for method in ("inverse_mpc", "inverse_mpc_reduced"):
        found = impc.fit(impc.Problem(plant, bounds, 10, trials), method)
        assert found.explained
        assert np.allclose(found.stage_weights.Q, np.eye(2), atol=1e-4)
        assert np.allclose(found.stage_weights.R, np.eye(2), atol=1e-4)


@pytest.mark.full
def test_a_start_that_is_not_the_first_sample_is_searched() -> None:
    """The initial state is free if the first output is noisy, and fixed if it is exact."""
    plant = impc.Plant(control.ss([[1.1, 0.2], [0, 0.9]], [[0], [1]], [[1, 0]], 0, 1))
    bounds = impc.Bounds(plant, u_min=-1, u_max=1)
    law = impc.Controller(plant, impc.Weights(np.eye(2), 1), bounds, 4, terminal_set=False)
    x = law.simulate([1.5, 0.5], 40).x
    noisy = x[:, :1] + 0.01 * np.random.default_rng(4).standard_normal((41, 1))
    problem = impc.Problem(plant, bounds, 4, [impc.Recording(plant, noisy)])
    assert problem.unknown_start
    found = impc.fit(problem)
    assert np.allclose(found.problem.recordings[0].x0, [1.5, 0.5], atol=0.05)
    assert np.allclose(found.gain, law.K, rtol=0.1)
    every = impc.Plant(control.ss(plant.A, plant.B, np.eye(2), 0, 1))
    assert not impc.Problem(every, bounds, 4, [impc.Recording(every, x)]).unknown_start


@pytest.mark.parametrize(("x0", "horizon"), [((-1.9, -2.6), 2), ((0.6, 1.4), 1)])
def test_the_terminal_set_is_decided_by_the_recordings(x0: list[float], horizon: int) -> None:
    """Controllers with and without a terminal set differ, and each is found."""
    plant = impc.Plant(control.ss([[2, -1], [1, 0.2]], [[1], [0]], np.eye(2), 0, 1))
    bounds = impc.Bounds(plant, u_min=-1, u_max=1)
    runs = []
    for kept in (False, True):
        weights = impc.Weights(np.eye(2), 0.01)
        law = impc.Controller(plant, weights, bounds, horizon, terminal_set=kept)
        runs.append(law.simulate(x0, 20).x)
        found = impc.fit(impc.Problem(plant, bounds, horizon, [impc.Recording(plant, runs[-1])]))
        assert found.explained
        assert found.problem.terminal_set == kept
        assert ("has a terminal set" in str(found)) == kept
        assert np.allclose(found.gain, law.K, atol=1e-6)
    assert np.max(np.abs(runs[0] - runs[1])) > 0.01


def test_an_infeasible_terminal_set_is_named() -> None:
    plant = impc.Plant(control.ss([[2, -1], [1, 0.2]], [[1], [0]], np.eye(2), 0, 1))
    bounds = impc.Bounds(plant, u_min=-1, u_max=1)
    law = impc.Controller(plant, impc.Weights(np.eye(2), 1), bounds, 2)
    with pytest.warns(match="terminal set.*terminal_set=False"):
        law.simulate([3.0, 3.0], 3)


def test_weights_are_those_of_the_gain_that_fits_best() -> None:
    """Noisy optimal controller: a search from the truth finds no smaller misfit."""
    known = next(posed(stick_problem, 1))
    found = fit_controller(known.problem)
    best = refine_gain(known.problem, known.K, known.S)
    assert found.noise <= best.misfit * (1 + 1e-4)
