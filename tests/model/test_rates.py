"""Changes of commands as controls: against a program in u and du, and in the inverse problem."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import casadi as ca
import control
import numpy as np
import pytest
import scipy.linalg

import impc
from impc.control.closed_loop import prepare_loop
from impc.control.simulation import Scenario, Status
from impc.inverse.methods import METHODS
from impc.inverse.residuals import along_bounds, residual_only
from impc.model.bounds import bound_rows
from impc.output_feedback.likelihood import unclipped
from tests.control.test_closed_loop import check_jacobian
from tests.support import random_plant, random_weights

HORIZON, U, DU = 6, 0.3, 0.23
either = pytest.mark.parametrize("inputs", [1, 2])


def plant_of(inputs: int) -> impc.Plant:
    """Plant of three states and a disturbance; its loops reach limits in 5 to 37 of 60 samples."""
    return random_plant(np.random.default_rng({1: 38, 2: 100}[inputs]), 3, inputs, 1.0, d=1)


def costs(inputs: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Q of the states, R of the commands, V of their changes."""
    rng = np.random.default_rng(30 + inputs)
    return random_weights(rng, 3), 0.3 * random_weights(rng, inputs), random_weights(rng, inputs)


def controller_of(
    inputs: int, u: float = U, du: float = DU, weights: Any = None, **settings: Any
) -> impc.Controller:
    """Controller with commands in -0.8 u to u and changes in -du to 0.9 du."""
    rates = impc.with_rates(plant_of(inputs))
    low, high = dict.fromkeys(rates.commands, -0.8 * u), dict.fromkeys(rates.commands, u)
    bounds = impc.Bounds(rates, x_min=low, x_max=high, u_min=-du, u_max=0.9 * du)
    Q, R, V = costs(inputs)
    weights = weights or impc.Weights(scipy.linalg.block_diag(Q, R), V)
    settings = {"terminal_set": False} | settings
    return impc.Controller(rates, weights, bounds, HORIZON, **settings)


def driven(law: impc.Controller, seed: int) -> tuple[Scenario, impc.Simulation]:
    """Scenario from three states of size one, pushed for 60 samples."""
    rng = np.random.default_rng(seed)
    x0 = np.concatenate([rng.choice([-1.0, 1.0], 3), np.zeros(law.plant.m)])
    push = np.repeat(rng.choice([-0.2, 0.2], 12), 5)
    drive, run = impc.scenario(law.plant, x0, disturbance=push), law.simulate(x0, None, push)
    assert run.complete
    return drive, run


def first_command(inputs: int, x: np.ndarray, last: np.ndarray, u: float, du: float) -> Any:
    """The command that minimises sum x'Qx + u'Ru + du'V du, in CasADi and solved by DAQP."""
    plant, (Q, R, V) = plant_of(inputs), costs(inputs)
    end = scipy.linalg.solve_discrete_are(  # of that same sum, which has a cross term
        np.block([[plant.A, plant.B], [np.zeros((inputs, 3)), np.eye(inputs)]]),
        np.vstack([plant.B, np.eye(inputs)]),
        scipy.linalg.block_diag(Q, R),
        R + V,
        s=np.vstack([np.zeros((3, inputs)), R]),
    )
    plan, changes = ca.SX.sym("u", inputs, HORIZON), []
    state, before, cost = ca.SX(x), ca.SX(last), ca.SX(0)
    for k in range(HORIZON):
        command, change = plan[:, k], plan[:, k] - before
        cost += ca.bilin(Q, state, state) + ca.bilin(R, command, command)
        cost += ca.bilin(V, change, change)
        state, before = ca.mtimes(plant.A, state) + ca.mtimes(plant.B, command), command
        changes.append(change)
    final = ca.vertcat(state, before)
    cost = (cost + ca.bilin(end, final, final)) / 2
    program = ca.qpsol("p", "daqp", {"x": ca.vec(plan), "f": cost, "g": ca.vertcat(*changes)})
    found = program(lbx=-0.8 * u, ubx=u, lbg=-du, ubg=0.9 * du)
    return found["x"].full().ravel()[:inputs]


@either
@pytest.mark.parametrize(("u", "du"), [(np.inf, np.inf), (U, np.inf), (np.inf, DU), (U, DU)])
def test_commands_are_those_of_a_program_in_u_and_du(inputs: int, u: float, du: float) -> None:
    plant, (drive, run) = plant_of(inputs), driven(controller_of(inputs, u, du), 0)
    x, c = run.x[:, :3], run.x[:, 3:]
    assert np.any(run.status == Status.ACTIVE) == np.isfinite(min(u, du))
    for k in range(30):
        wanted = first_command(inputs, x[k], c[k], u, du)
        np.testing.assert_allclose(c[k + 1], wanted, rtol=0, atol=1e-8)
    for low, high, values in ((-0.8 * u, u, c[1:]), (-du, 0.9 * du, np.diff(c, axis=0))):
        if np.isfinite(high):  # each kind is reached, and kept
            assert np.max(np.maximum(values / low, values / high)) == pytest.approx(1, abs=1e-9)
    moved = x[:-1] @ plant.A.T + c[1:] @ plant.B.T + drive.disturbance @ plant.E.T
    np.testing.assert_allclose(x[1:], moved, rtol=0, atol=1e-12)


@either
def test_in_the_terminal_set_the_gain_keeps_commands_and_changes(inputs: int) -> None:
    law = controller_of(inputs, terminal_set=True)
    assert law.terminal is not None
    for direction in np.random.default_rng(0).normal(size=(50, 3 + inputs)):
        x, peaks = direction / np.max(law.terminal.H @ direction / law.terminal.h), []
        for _ in range(200):
            change = -law.K @ x
            x = law.plant.A @ x + law.plant.B @ change
            sides = x[3:] / U, -x[3:] / (0.8 * U), change / (0.9 * DU), -change / DU
            peaks.append(np.max(sides))
        assert max(peaks) == pytest.approx(1.0, abs=1e-6)  # the edge of the set is that of a limit


@either
def test_derivatives_are_central_differences(inputs: int) -> None:
    law = controller_of(inputs)
    drive, run = driven(law, 0)
    assert np.count_nonzero(run.status == Status.ACTIVE) >= 5
    assert run.weakly_active == 0
    check_jacobian(law, drive, "A", "B")  # in which the commands' rows are constants


def posed(law: impc.Controller, **given: Any) -> impc.Problem:
    """Problem with two noise-free recordings of the plant's states, without the commands."""
    trials = []
    for drive, run in (driven(law, 0), driven(law, 1)):
        assert 5 <= np.count_nonzero(run.status == Status.ACTIVE) <= 37
        trials.append(impc.Recording(law.plant, run.outputs, drive.disturbance, drive.x0))
    given |= {"terminal_set": False, "unknown_start": False}
    return impc.Problem(law.plant, law.bounds, HORIZON, trials, **given)


@either
def test_exact_recordings_give_gain_and_weights(inputs: int, tmp_path: Path) -> None:
    law = controller_of(inputs)
    found = impc.fit(posed(law))
    assert found.explained
    assert found.fit.rank == law.K.size
    np.testing.assert_allclose(found.gain, law.K, rtol=0, atol=1e-6 * np.max(np.abs(law.K)))
    fibre, truth = impc.gain_fibre(law.plant, found.gain, found.metrics), costs(inputs)
    pairs = zip(fibre.Q, fibre.R, strict=True)
    basis = np.array([scipy.linalg.block_diag(*pair).ravel() for pair in pairs]).T
    wanted = scipy.linalg.block_diag(*truth).ravel()
    left = wanted - basis @ np.linalg.lstsq(basis, wanted)[0]
    assert np.linalg.norm(left) <= 1e-5 * np.linalg.norm(wanted)
    assert basis.shape[1] < (3 + inputs) * (4 + inputs) / 2  # by far not all weights are in it
    again: Any = impc.load(found.save(tmp_path / "found.json"))
    assert again.problem.plant.commands == law.plant.commands
    np.testing.assert_array_equal(again.outputs[0], found.outputs[0])


@either
def test_cost_weights_of_a_structure_are_found(inputs: int) -> None:
    shape = impc.Structure(impc.with_rates(plant_of(inputs)))
    assert shape.labels[3:] == plant_of(inputs).controls
    z = np.log(np.geomspace(0.3, 4.0, shape.count))
    law = controller_of(inputs, weights=shape.weights(z))
    found = impc.fit(posed(law, structure=shape), method="structured")
    assert found.explained
    np.testing.assert_allclose(np.array(found.cost_weights), z, rtol=0, atol=1e-6)


def test_limits_of_changes_are_not_those_of_commands() -> None:
    """Limits of commands and of changes are fitted, removed or clipped separately."""
    law = controller_of(1, 0.9 * DU / 0.8)
    problem, at = impc.replace(posed(controller_of(1)), bounds=law.bounds), (law.K, law.S)

    def residual(share: float) -> np.ndarray:
        u_max, u_min = share * law.bounds.u_max, share * law.bounds.u_min
        bounds = impc.replace(law.bounds, u_max=u_max, u_min=u_min)
        return residual_only(impc.replace(problem, bounds=bounds), *at)

    slope = (residual(1 + 1e-6) - residual(1 - 1e-6)) / 2e-6
    moves = bound_rows(problem.bounds, problem.plant).along_limit(0)
    found = along_bounds(problem, *at, moves[:, None])[:, 0]
    np.testing.assert_allclose(found, slope, rtol=0, atol=1e-6 * np.max(np.abs(slope)))
    cut_off = METHODS["clipped_lqr"].restrict(problem).bounds
    np.testing.assert_array_equal(cut_off.x_max, law.bounds.x_max)
    inner, clip = unclipped(prepare_loop(law, impc.directions(law, 0)))
    names = bound_rows(law.bounds, law.plant).names
    now = {names[k] for k in inner.rows.family[inner.rows.stage == 0]}
    assert (clip.used, now) == (True, {"u0 <= 0.25875", "u0 >= -0.207"})


def test_names_units_and_words_are_carried_over() -> None:
    system = control.ss(
        [[0.9]], [[1, 1]], [[1]], 0, 0.1, inputs=["torque", "push"], states=["tilt"]
    )
    plant = impc.Plant(system, ["torque"], {"torque": "N m"}, {"torque": "torque of the hip"})
    rates = impc.with_rates(plant)
    assert (rates.controls, rates.disturbances) == (("change of torque",), ("push",))
    assert rates.unit("torque") == rates.unit("change of torque") == "N m"
    assert rates.word("change of torque") == "change of torque of the hip per sample"
    twice = impc.with_rates(rates)  # the change of the change
    rows = bound_rows(impc.Bounds(twice, x_max={"torque": 2.0}), twice)
    assert (rows.names, rows.on_state.tolist()) == (("torque <= 2",), [False])
    np.testing.assert_array_equal(np.hstack([rows.E, rows.F]), [[0, 1, 1, 1]])


def test_what_has_no_changes_of_commands_is_refused() -> None:
    tilt, torque = ca.SX.sym("tilt"), ca.SX.sym("torque")
    bent = ca.Function("body", [tilt, torque], [0.9 * ca.sin(tilt) + torque])
    system = control.ss([[0.9]], [[1]], [[1]], 0, 0.1, states=["torque"], inputs=["torque"])
    with pytest.raises(impc.PlantError, match=r"nonlinear body; pass plant.linear\(\)"):
        impc.with_rates(impc.Plant(system, body=bent))
    with pytest.raises(impc.PlantError, match="two signals 'torque'"):
        impc.with_rates(impc.Plant(system))
