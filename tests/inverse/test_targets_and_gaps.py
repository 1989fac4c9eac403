"""Recordings with targets, disturbances, commands, gaps and offsets are recovered."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import impc
from experiments.coverage import true_controller
from impc.arrays import Array
from tests.control.hanging_body import pendulum
from tests.support import named_plant, plant_of, posed, regulator

STEPS, HORIZON = 80, 6
TRUE = np.diag([4.0, 0.3])


def cart() -> impc.Plant:
    """Mass on a weak spring with a push and wind as disturbances."""
    A, B = [[1, 0.1], [-0.02, 0.97]], [[0, 0], [0.1, 0.1]]
    return named_plant(A, B, np.eye(2), 0.1, "x v", "push wind", "x v")


def steps(seed: int) -> Array:
    """Target with occasional steps."""
    rng = np.random.default_rng(seed)
    return np.cumsum((rng.random(STEPS + 1) < 0.1) * rng.normal(size=STEPS + 1)) * 0.3


WIND = 0.3 + 0.1 * np.sin(np.arange(STEPS) / 7)
TARGET = {"x": steps(1)}


def recorded(
    plant: impc.Plant, limit: float, target: dict[str, Any] = TARGET, wind: Any = WIND,
    Q: Any = TRUE,
) -> tuple[impc.Controller, Any]:  # fmt: skip
    law = regulator(plant, Q, limit, HORIZON)
    return law, law.simulate([0.5, 0.0], disturbance=wind, target=target)


@pytest.mark.parametrize("limit", [0.6, 9.0])
@pytest.mark.parametrize("kind", ["target", "push", "known push", "preview"])
def test_exact_recordings_give_gain_and_weights(kind: str, limit: float) -> None:
    """The gain, a set of weights that contains the true ones, and structured weights."""
    plant = cart()
    if kind == "preview":
        plant = impc.with_preview(plant, ["x"], 3)
    elif kind != "target":
        plant = impc.with_observer(plant, 1.5 if kind == "push" else np.inf)
    Q = 1e-12 * np.eye(plant.n)
    Q[:2, :2] += TRUE
    wind = WIND if "push" in kind else 0 * WIND
    law, run = recorded(plant, limit, TARGET, wind, Q)
    K = pytest.approx(np.array(law.K), abs=1e-6)
    assert bool(np.any(run.status == 1)) == (limit < 1)
    trial = impc.Recording(plant, run.x[:, :2], wind, x0=[0.5, 0.0], target=TARGET)
    problem = posed(law, trial, unknown_start=False, structure=impc.Structure(plant, ["x", "v"]))
    found = impc.fit(problem)
    assert found.explained
    assert found.gain == K
    assert found.fit.rank == plant.n
    assert impc.solve_lqr(plant, found.stage_weights).K == K
    fibre = impc.gain_fibre(plant, found.gain)
    X, basis = fibre.to_natural(impc.Weights(Q, 1)), fibre.natural_basis()
    within = np.tensordot(np.tensordot(basis, X, 2), basis, 1)
    assert np.linalg.norm(X - within) < 1e-6 * np.linalg.norm(X)
    structured = impc.fit(problem, "structured", start=found)
    assert np.diag(structured.stage_weights.Q)[:2] == pytest.approx([4.0, 0.3], abs=1e-6)


@functools.cache
def gapped(limit: float) -> tuple[impc.Controller, impc.Estimate]:
    """Half of the positions missing, one offset per trial, recorded commands with gaps."""
    plant, rng, trials = cart(), np.random.default_rng(0), []
    for seed in (1, 2):
        law, run = recorded(plant, limit, {"x": steps(seed)})
        y = run.x + np.array([0.02 * seed, 0.0])
        y[rng.random(len(y)) < 0.5, 0] = np.nan
        commands = np.array(run.u)
        commands[10:20] = np.nan
        trials.append(impc.Recording(plant, y, WIND, target={"x": steps(seed)}, commands=commands))
    return law, impc.fit(posed(law, *trials, offsets=["x"]))


@pytest.mark.parametrize("limit", [0.6, 9.0])
def test_gaps_offsets_and_commands(limit: float) -> None:
    law, found = gapped(limit)
    assert found.problem.recorded_numbers == sum(
        int(np.isfinite(trial.outputs).sum()) + STEPS - 10 for trial in found.problem.recordings
    )
    assert found.gain == pytest.approx(np.array(law.K), abs=1e-6)
    assert found.problem.errors[:, 0, 0] == pytest.approx([0.02, 0.04], abs=1e-7)
    assert found.vaf == pytest.approx([100.0, 100.0], abs=1e-6)
    assert np.all(np.isfinite(found.intervals()[["low", "high"]]))
    assert "Errors:     x has an offset, 0.02, 0.04" in found.summary()


@pytest.mark.parametrize("seen", ["x v", "x"])
@pytest.mark.parametrize("limit", [0.6, 9.0])
def test_commands_give_the_gain_by_regression(limit: float, seen: str) -> None:
    """From recorded states, and from the plant driven by the commands."""
    plant = impc.with_observer(cart(), 2.0)
    law, run = recorded(plant, limit)
    if seen == "x":
        plant = impc.replace(plant, C=plant.C[:1], outputs=("x",))
    y = run.x[:, : len(plant.outputs)]
    trial = impc.Recording(plant, y, WIND, target=TARGET, commands=run.u)
    problem = impc.Problem(plant, law.bounds, HORIZON, [trial])
    found = impc.fit(problem)
    shown = impc.command_regression(found)
    assert shown["regression"].to_numpy() == pytest.approx(np.ravel(law.K), abs=1e-6)
    regression = impc.fit(problem, "command_regression", start=found)
    assert regression.gain == pytest.approx(np.array(law.K), abs=1e-6)
    if seen == "x v":  # recorded states are used directly
        return
    wrong = impc.replace(problem, recordings=(impc.replace(trial, commands=-3 * trial.commands),))
    with pytest.raises(impc.SolverError, match="does not reproduce the recorded outputs"):
        impc.command_regression(impc.replace(found, problem=wrong))


def observer_rate() -> tuple[impc.Controller, impc.Problem]:
    """The rate of the observer is a parameter, which begins at half of its value."""

    def known(values: Any) -> impc.Plant:
        return impc.with_observer(cart(), values[0])

    law, run = recorded(known([1.5]), 0.6)
    family = impc.PlantFamily(known, ["rate"], [0.8])
    trial = impc.Recording(known([0.8]), run.x, WIND, target=TARGET)
    given = known([0.8]), law.bounds, HORIZON, [trial]
    return law, impc.Problem(*given, family=family, unknown_start=False)


def nonlinear_body() -> tuple[impc.Controller, impc.Problem]:
    plant = impc.with_observer(pendulum(), 2.0)
    law, drive = regulator(plant, TRUE, 3, HORIZON), {"angle": 0.5 * steps(1)}
    run = law.simulate([0.3, 0.0], disturbance=0.3 * WIND, target=drive)
    trial = impc.Recording(plant, run.x[:, :1], 0.3 * WIND, target=drive, commands=run.u)
    return law, posed(law, trial)


def contradicted_start() -> tuple[impc.Controller, impc.Problem]:
    """A stated start that exact states contradict is searched."""
    law, run = recorded(cart(), 9.0)
    return law, posed(law, impc.Recording(cart(), run.x, WIND, [0.0, 0.0], target=TARGET))


def two_inputs() -> tuple[impc.Controller, impc.Problem]:
    rng = np.random.default_rng(5)
    A = np.array([[1.0, 0.1, 0.0], [0.0, 0.9, 0.1], [0.1, 0.0, 0.95]])
    plant = plant_of(A, rng.normal(size=(3, 2)) * 0.3, dt=0.1)
    law = regulator(plant, np.diag([1.0, 2.0, 0.5]), 0.4, 5, [[1.0, 0.3], [0.3, 0.7]])
    target = {plant.states[0]: steps(4), plant.states[1]: -steps(6)}
    run = law.simulate([1, -1, 0.5], steps=STEPS, target=target)
    return law, posed(law, impc.Recording(plant, run.x, target=target))


def releases() -> tuple[impc.Controller, impc.Problem]:
    """Trials that only their unknown initial states drive."""
    law, trials = true_controller(), []
    for x0 in ([0.4, 0.0], [-0.2, 0.3], [0.3, 0.1]):
        trials.append(impc.Recording(law.plant, law.simulate(x0, 100).outputs[:100]))
    settings = impc.FitSettings(horizon=10, u_max=1.0)
    return law, impc.fit_problem(law.plant, trials, settings)


@pytest.mark.parametrize(
    "made", [observer_rate, nonlinear_body, contradicted_start, two_inputs, releases]
)
def test_the_gain_is_found(made: Callable[[], tuple[impc.Controller, impc.Problem]]) -> None:
    law, problem = made()
    assert problem.unknown_start == (made in {nonlinear_body, contradicted_start, releases})
    found = impc.fit(problem)
    assert found.explained
    assert found.gain == pytest.approx(np.array(law.K), abs=1e-6)
    if made is observer_rate:
        assert found.intervals().loc["rate", "value"] == pytest.approx(1.5, abs=1e-5)
    if made is releases:
        np.testing.assert_allclose(found.problem.recordings[1].x0, [-0.2, 0.3], atol=1e-7)
