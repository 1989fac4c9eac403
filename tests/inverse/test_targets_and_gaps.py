"""Recordings with targets, disturbances, commands, gaps and offsets are recovered."""

from __future__ import annotations

from typing import Any

import control
import numpy as np
import pytest

import impc
from impc.arrays import Array
from impc.checking import replace
from impc.errors import SolverError
from impc.inverse.metric_family import metric_family
from impc.inverse.residuals import evaluate, residual_only
from impc.model.plant import Plant
from impc.model.structure import Structure
from tests.control.hanging_body import pendulum

STEPS, HORIZON = 80, 6
TRUE = np.diag([4.0, 0.3])


def cart(**more: Any) -> Plant:
    """Mass on a weak spring with a push and wind as disturbances."""
    system = control.ss(
        [[1, 0.1], [-0.02, 0.97]], [[0, 0], [0.1, 0.1]], np.eye(2), 0, 0.1,
        states=["x", "v"], inputs=["push", "wind"], outputs=["x", "v"],
    )  # fmt: skip
    return impc.Plant(system, controls=["push"], **more)


def recorded(
    plant: Plant, limit: float, target: dict[str, Any], wind: Any, weights: impc.Weights
) -> tuple[impc.Controller, Any]:
    bounds = impc.Bounds(plant, u_min=-limit, u_max=limit)
    law = impc.Controller(plant, weights, bounds, HORIZON, terminal_set=False)
    return law, law.simulate([0.5, 0.0], disturbance=wind, target=target)


def steps(seed: int) -> Array:
    """Target with occasional steps."""
    rng = np.random.default_rng(seed)
    return np.cumsum((rng.random(STEPS + 1) < 0.1) * rng.normal(size=STEPS + 1)) * 0.3


WIND = 0.3 + 0.1 * np.sin(np.arange(STEPS) / 7)


@pytest.mark.parametrize("limit", [0.6, 9.0])
@pytest.mark.parametrize("kind", ["target", "push", "known push", "preview"])
def test_exact_recordings_give_gain_and_weights(kind: str, limit: float) -> None:
    """Recovers the gain, a set of weights that contains the true ones, and structured weights."""
    plant = cart()
    if kind == "preview":
        plant = impc.with_preview(plant, ["x"], 3)
    elif kind != "target":
        plant = impc.with_observer(plant, 1.5 if kind == "push" else np.inf)
    Q = np.zeros((plant.n, plant.n))
    Q[:2, :2] = TRUE
    weights = impc.Weights(Q + 1e-12 * np.eye(plant.n), 1)
    target, wind = {"x": steps(1)}, WIND if "push" in kind else 0 * WIND
    law, run = recorded(plant, limit, target, wind, weights)
    assert bool(np.any(run.status == 1)) == (limit < 1)
    trial = impc.Recording(plant, run.x[:, :2], wind, x0=[0.5, 0.0], target=target)
    costed = Structure(plant, ["x", "v"])
    problem = impc.Problem(
        plant, law.bounds, HORIZON, [trial], unknown_start=False, structure=costed
    )
    found = impc.fit(problem)
    assert found.explained
    assert found.gain == pytest.approx(np.array(law.K), abs=1e-6)
    assert found.fit.rank == plant.n
    assert pytest.approx(np.array(law.K), abs=1e-6) == impc.solve_lqr(plant, found.stage_weights).K
    fibre = impc.gain_fibre(plant, found.gain)
    X, basis = fibre.to_natural(weights), fibre.natural_basis()
    within = np.tensordot(np.tensordot(basis, X, 2), basis, 1)
    assert np.linalg.norm(X - within) < 1e-6 * np.linalg.norm(X)
    structured = impc.fit(problem, "structured", start=found)
    assert np.diag(structured.stage_weights.Q)[:2] == pytest.approx([4.0, 0.3], abs=1e-6)


def test_the_rate_of_an_observer_is_a_parameter() -> None:
    def known(values: Array) -> Plant:
        return impc.with_observer(cart(), values[0])

    law, run = recorded(known(np.array([1.5])), 0.6, {"x": steps(1)}, WIND, impc.Weights(TRUE, 1))
    family = impc.PlantFamily(known, ["rate"], [0.8])
    plant = known(np.array([0.8]))
    trial = impc.Recording(plant, run.x, WIND, target={"x": steps(1)})
    found = impc.fit(
        impc.Problem(plant, law.bounds, HORIZON, [trial], family=family, unknown_start=False)
    )
    assert found.gain == pytest.approx(np.array(law.K), abs=1e-6)
    table = found.intervals()
    assert table.loc["rate", "value"] == pytest.approx(1.5, abs=1e-5)


@pytest.mark.parametrize("limit", [0.6, 9.0])
def test_gaps_offsets_and_commands(limit: float) -> None:
    """Half of the positions missing, one offset per trial, recorded commands with gaps."""
    plant = cart()
    weights, rng, trials = impc.Weights(TRUE, 1), np.random.default_rng(0), []
    for seed in (1, 2):
        law, run = recorded(plant, limit, {"x": steps(seed)}, WIND, weights)
        y = run.x + np.array([0.02 * seed, 0.0])
        y[rng.random(len(y)) < 0.5, 0] = np.nan
        commands = np.array(run.u)
        commands[10:20] = np.nan
        trials.append(impc.Recording(plant, y, WIND, target={"x": steps(seed)}, commands=commands))
    problem = impc.Problem(plant, law.bounds, HORIZON, trials, offsets=["x"])
    assert problem.recorded_numbers == sum(
        int(np.isfinite(trial.outputs).sum()) + STEPS - 10 for trial in trials
    )
    found = impc.fit(problem)
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
    law, run = recorded(plant, limit, {"x": steps(1)}, WIND, impc.Weights(TRUE, 1))
    if seen == "x":
        plant = replace(plant, C=plant.C[:1], outputs=("x",))
    y = run.x[:, : len(plant.outputs)]
    trial = impc.Recording(plant, y, WIND, target={"x": steps(1)}, commands=run.u)
    problem = impc.Problem(plant, law.bounds, HORIZON, [trial])
    found = impc.fit(problem)
    shown = impc.command_regression(found)
    assert shown["regression"].to_numpy() == pytest.approx(np.ravel(law.K), abs=1e-6)
    regression = impc.fit(problem, "command_regression", start=found)
    assert regression.gain == pytest.approx(np.array(law.K), abs=1e-6)
    if seen == "x v":  # recorded states are used directly
        return
    wrong = replace(trial, commands=-3 * trial.commands)
    with pytest.raises(SolverError, match="does not reproduce the recorded outputs"):
        impc.command_regression(replace(found, problem=replace(problem, recordings=(wrong,))))


def test_slopes_with_gaps_offsets_and_commands_are_differences() -> None:
    plant, rng = impc.with_observer(cart(), 2.0), np.random.default_rng(3)
    law, run = recorded(plant, 0.6, {"x": steps(1)}, WIND, impc.Weights(TRUE, 1))
    y = run.x + 0.05 * rng.normal(size=run.x.shape)
    y[5:9] = np.nan
    trial = impc.Recording(plant, y, WIND, target={"x": steps(1)}, commands=run.u)
    problem = impc.Problem(
        plant, law.bounds, HORIZON, [trial], offsets=["v"], unknown_start=True, terminal_set=False
    )
    K, S = np.array(law.K), np.eye(1)
    found = evaluate(problem, K, S)
    assert found.residual == pytest.approx(residual_only(problem, K, S))
    assert found.residual.reshape(-1, 3)[5:9, :2] == pytest.approx(0.0)
    h = 1e-6
    for place in range(2):
        step = h * np.eye(2)[place][None]
        wanted = (residual_only(problem, K + step, S) - residual_only(problem, K - step, S)) / 2 / h
        assert found.dK[:, 0, place] == pytest.approx(wanted, abs=1e-6)
        ends = [
            residual_only(problem.at(problem.starts + sign * step, problem.logarithms), K, S)
            for sign in (1, -1)
        ]
        assert found.own[:, place] == pytest.approx((ends[0] - ends[1]) / 2 / h, abs=1e-6)
    offset = np.zeros_like(problem.errors)
    offset[0, 0, plant.outputs.index("v")] = 1.0
    ends = [
        residual_only(problem.at(problem.starts, problem.logarithms, sign * offset), K, S)
        for sign in (1, -1)
    ]
    assert found.own[:, 2] == pytest.approx((ends[0] - ends[1]) / 2, abs=1e-9)


def test_a_nonlinear_body_is_regulated_to_its_target() -> None:
    plant = impc.with_observer(pendulum(), 2.0)
    bounds = impc.Bounds(plant, u_min=-3, u_max=3)
    law = impc.Controller(plant, impc.Weights(TRUE, 1), bounds, HORIZON, terminal_set=False)
    drive = {"angle": 0.5 * steps(1)}
    run = law.simulate([0.3, 0.0], disturbance=0.3 * WIND, target=drive)
    trial = impc.Recording(plant, run.x[:, :1], 0.3 * WIND, target=drive, commands=run.u)
    found = impc.fit(impc.Problem(plant, bounds, HORIZON, [trial]))
    assert found.gain == pytest.approx(np.array(law.K), abs=1e-6)


def test_a_start_that_exact_states_contradict_is_searched() -> None:
    law, run = recorded(cart(), 9.0, {"x": steps(1)}, WIND, impc.Weights(TRUE, 1))
    trial = impc.Recording(cart(), run.x, WIND, [0.0, 0.0], target={"x": steps(1)})
    problem = impc.Problem(cart(), law.bounds, HORIZON, [trial])
    assert problem.unknown_start
    assert impc.fit(problem).explained


def test_the_metric_of_two_inputs_is_found_from_targets() -> None:
    rng = np.random.default_rng(5)
    A = np.array([[1.0, 0.1, 0.0], [0.0, 0.9, 0.1], [0.1, 0.0, 0.95]])
    system = control.ss(A, rng.normal(size=(3, 2)) * 0.3, np.eye(3), 0, 0.1)
    plant = impc.Plant(system)
    weights = impc.Weights(np.diag([1.0, 2.0, 0.5]), [[1.0, 0.3], [0.3, 0.7]])
    bounds = impc.Bounds(plant, u_min=-0.4, u_max=0.4)
    law = impc.Controller(plant, weights, bounds, 5, terminal_set=False)
    target = {plant.states[0]: steps(4), plant.states[1]: -steps(6)}
    run = law.simulate([1, -1, 0.5], steps=STEPS, target=target)
    trial = impc.Recording(plant, run.x, target=target)
    found = impc.fit(impc.Problem(plant, bounds, 5, [trial]))
    assert found.explained
    assert found.gain == pytest.approx(np.array(law.K), abs=1e-6)
    assert metric_family(plant, found.gain) is not None


def test_a_saved_estimate_keeps_targets_and_offsets(tmp_path: Any) -> None:
    plant = impc.with_observer(cart(), 2.0)
    law, run = recorded(plant, 0.6, {"x": steps(1)}, WIND, impc.Weights(TRUE, 1))
    y = run.x + np.array([0.1, 0.0])
    y[3, 1] = np.nan
    trial = impc.Recording(plant, y, WIND, target={"x": steps(1)}, commands=run.u)
    found = impc.fit(impc.Problem(plant, law.bounds, HORIZON, [trial], offsets=["x"]))
    again = impc.load(found.save(tmp_path / "found.json"))
    assert isinstance(again, impc.Estimate)
    assert again.misfit == found.misfit
    for one, other in zip(again.states, found.states, strict=True):
        assert np.array_equal(one, other)
    assert np.array_equal(again.problem.errors, found.problem.errors)
