"""The default search on problems with known solutions."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import count, islice

import numpy as np
import pytest

import impc
from experiments.search_problems import Known, random_problem, stick, stick_problem
from experiments.search_study import is_right, warned
from impc.control.closed_loop import simulate
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.search import refine_gain
from impc.inverse.table31 import inverse_mpc_reduced
from tests.support import differences, example_plant, plant_of, posed, regulator

SLOW = pytest.mark.slow
HELD = plant_of([[1.1, 0.2], [0, 0.9]], [[0], [1]])
KINDS: dict[str, Callable[[int], Known | None]] = {
    "stick": stick_problem,
    "one input": random_problem,
    "two inputs": lambda seed: random_problem(seed, 2),
    "three inputs": lambda seed: random_problem(seed, 3),
    "half": lambda seed: random_problem(seed, half=True),
    "half, two inputs": lambda seed: random_problem(seed, 2, half=True),
    "half, short": lambda seed: random_problem(seed, 2, half=True, samples=12),
}


def first_of(kind: str, wanted: int) -> Iterator[Known]:
    """First problems of a kind with 5 to 45 % of the samples at the limit."""
    made = (KINDS[kind](seed) for seed in count())
    return islice((one for one in made if one and 0.05 <= one.saturated < 0.45), wanted)


@pytest.mark.parametrize(
    ("kind", "wanted", "wrong", "silent"),
    [
        ("stick", 3, 0, 0),
        pytest.param("stick", 100, 2, 0, marks=SLOW),
        ("one input", 20, 0, 0),
        pytest.param("one input", 200, 2, 2, marks=SLOW),
        ("two inputs", 3, 0, 0),
        pytest.param("two inputs", 100, 1, 1, marks=SLOW),
        ("three inputs", 3, 0, 0),
        pytest.param("three inputs", 100, 1, 1, marks=SLOW),
        # From an unknown state.
        ("half", 3, 0, 0),
        pytest.param("half", 67, 6, 0, marks=SLOW),
        pytest.param("half, two inputs", 50, 5, 5, marks=SLOW),
    ],
)
def test_known_problems(kind: str, wanted: int, wrong: int, silent: int) -> None:
    """At most `wrong` results are wrong, and at most `silent` of these carry no warning."""
    pairs = [(known, fit_controller(known.problem)) for known in first_of(kind, wanted)]
    missed = [found for known, found in pairs if not is_right(known, found)]
    assert len(missed) <= wrong
    assert sum(not warned(found) for found in missed) <= silent


def test_a_noisy_stick_ends_at_its_gain() -> None:
    """50 samples per second: the noisy angle in degrees, and pushes."""
    system, rng = stick(), np.random.default_rng(1)
    push = np.repeat(rng.choice([-1.5, 0.0, 1.5], 60), 10)
    x, angle = np.zeros(2), []
    for d in push:
        finger = np.clip(25 * x[0] + 7 * x[1], -1.2, 1.2)
        angle.append(np.degrees(x[0]) + 0.02 * rng.standard_normal())
        x = system.A @ x + system.B @ [finger, d]
    plant = impc.Plant(system, ["finger"])
    trial = impc.Recording(plant, np.radians(angle), push)
    settings = impc.FitSettings(horizon=15, u_max=1.2)
    found = impc.fit(impc.fit_problem(plant, [trial], settings))
    assert np.allclose(found.gain, [[-25, -7]], rtol=2e-3)
    assert found.converged
    assert found.fit.white
    residual = found.misfit**2 / len(angle)
    assert residual == pytest.approx(np.radians(0.02) ** 2 / np.var(trial.outputs), rel=0.1)


def test_a_stick_that_falls_with_any_other_gain_has_its_weights() -> None:
    """No starting regulator, nor weights near one, can be simulated."""
    known = stick_problem(418)
    assert known is not None
    found = fit_controller(known.problem)
    assert is_right(known, found)
    for one in (found, inverse_mpc_reduced(known.problem)):
        assert np.allclose(one.gain, known.K, rtol=2e-3)


def test_a_command_always_at_its_bound_identifies_nothing() -> None:
    """Any larger gain gives the same recording."""
    law = regulator(HELD, np.eye(2), 0.1, 4)
    run = simulate(law, impc.scenario(HELD, [5.0, 5.0], 10))
    assert np.all(np.abs(np.abs(run.u) - 0.1) < 1e-9)
    found = impc.fit(posed(law, impc.Recording(HELD, run.x), unknown_start=False))
    assert found.explained
    assert found.fit.rank == 0
    assert impc.identifiability(found.problem, found.stage_weights).rank == 0
    assert any("identify 0 of the 2 directions" in doubt for doubt in found.doubts)


@pytest.mark.full
def test_the_rank_is_that_of_the_derivative() -> None:
    """One trial with two inputs and 12 outputs, against singular values of finite differences."""
    known = next(first_of("half, short", 1))
    found = fit_controller(known.problem)
    problem, K = found.problem, np.array(found.gain)
    plant, x0 = problem.plant, np.array(problem.recordings[0].x0)

    def outputs(unknowns: np.ndarray) -> np.ndarray:
        gain, start = unknowns[: K.size].reshape(K.shape), unknowns[K.size :]
        law = impc.Controller.from_gain(
            plant, gain, problem.bounds, problem.horizon, metric=found.metric, terminal_set=False
        )
        drive = impc.scenario(plant, start, len(problem.recordings[0].outputs) - 1)
        return np.asarray(simulate(law, drive).x @ plant.C.T)

    on_gain, on_start = np.split(differences(outputs, [*K.ravel(), *x0]), [K.size], axis=1)
    left = on_gain - on_start @ np.linalg.lstsq(on_start, on_gain)[0]
    values = np.linalg.svd(left, compute_uv=False)
    assert found.fit.rank <= np.count_nonzero(values > 1e-7 * values[0])
    assert found.fit.rank >= np.count_nonzero(values > 1e-3 * values[0])


@pytest.mark.full
def test_a_start_that_is_not_the_first_sample_is_searched() -> None:
    """The initial state is free if the first output is noisy, and fixed if it is exact."""
    plant = plant_of(HELD.A, HELD.B, [[1, 0]])
    law = regulator(plant, np.eye(2), 1, 4)
    x = law.simulate([1.5, 0.5], 40).x
    noisy = x[:, :1] + 0.01 * np.random.default_rng(4).standard_normal((41, 1))
    problem = posed(law, impc.Recording(plant, noisy))
    assert problem.unknown_start
    found = impc.fit(problem)
    assert np.allclose(found.problem.recordings[0].x0, [1.5, 0.5], atol=0.05)
    assert np.allclose(found.gain, law.K, rtol=0.1)
    exact = impc.Problem(HELD, impc.Bounds(HELD, u_min=-1, u_max=1), 4, [impc.Recording(HELD, x)])
    assert not exact.unknown_start


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


def test_an_infeasible_terminal_set_is_named() -> None:
    law = regulator(example_plant(), np.eye(2), 1, 2, terminal_set=True)
    with pytest.warns(match="terminal set.*terminal_set=False"):
        law.simulate([3.0, 3.0], 3)


def test_weights_are_those_of_the_gain_that_fits_best() -> None:
    """Noisy optimal controller: a search from the truth finds no smaller misfit."""
    known = next(first_of("stick", 1))
    found = fit_controller(known.problem)
    best = refine_gain(known.problem, known.K, known.S)
    assert found.noise <= best.misfit * (1 + 1e-4)
