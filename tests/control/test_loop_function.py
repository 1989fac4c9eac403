"""The closed loop and one step of the controller as CasADi functions, with their derivatives."""

from __future__ import annotations

import importlib
import runpy
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from impc.checking import replace
from impc.control.casadi_controller import mpc_function
from impc.control.closed_loop import simulate, simulate_and_differentiate
from impc.control.constraint_rows import directions
from impc.control.controller import Controller
from impc.control.loop_function import closed_loop_function
from impc.errors import DataError, InputError
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights
from tests.control.test_closed_loop import problem
from tests.documents.blocks import ROOT
from tests.support import extrapolated_slope, random_weights


def columns(values: np.ndarray) -> np.ndarray:
    """Derivatives (samples, n, p) in CasADi's layout, (n samples, p)."""
    return np.moveaxis(values, 1, 0).reshape(-1, values.shape[2])


def scale_free(S: np.ndarray) -> np.ndarray:
    """Derivatives of the scaled metric by the entries of S, in column order (m, m, m * m).

    The controller takes m S / tr S, and of S the symmetric part.
    """
    m, found = len(S), []
    for column in range(m):
        for row in range(m):
            unit = np.zeros((m, m))
            unit[row, column] += 0.5
            unit[column, row] += 0.5
            found.append(m * unit / np.trace(S) - m * S * np.trace(unit) / np.trace(S) ** 2)
    return np.stack(found, axis=-1)


@pytest.mark.parametrize("block", range(5))
@pytest.mark.parametrize("softening", [None, 50.0])
def test_jacobian_and_reverse_are_those_of_the_loop(block: int, softening: float | None) -> None:
    """Fifty random loops: one to three inputs, input bounds, terminal sets, half of them boxes."""
    for seed in range(5 * block, 5 * block + 5):
        controller, drive, run = problem(seed, softening)
        n, m, steps = controller.plant.n, controller.plant.m, drive.steps
        count = m * n + m * m + n
        # Column after column of K, of S, and the initial state.
        order = np.eye(m * n).reshape(m, n, m * n).transpose(1, 0, 2).reshape(m * n, m, n)
        dK = np.zeros((m, n, count))
        dK[..., : m * n] = np.moveaxis(order, 0, -1)
        dS = np.zeros((m, m, count))
        dS[..., m * n : m * n + m * m] = scale_free(controller.S)
        along = directions(controller, count, K=dK, S=dS, x0=np.eye(n, count, m * n + m * m))
        _, exact = simulate_and_differentiate(controller, drive, along)
        loop = closed_loop_function(controller, steps)
        K, S, x0 = ca.MX.sym("K", m, n), ca.MX.sym("S", m, m), ca.MX.sym("x0", n)
        outputs = loop(K, S, x0, drive.disturbance)
        both = ca.veccat(*outputs)
        unknown = ca.veccat(K, S, x0)
        weigh = np.random.default_rng(seed).normal(size=both.numel())
        at = ca.Function(
            "at",
            [K, S, x0],
            [*outputs, ca.jacobian(both, unknown), ca.gradient(ca.dot(weigh, both), unknown)],
        )
        x, u, jacobian, gradient = (
            part.full() for part in at(controller.K, controller.S, drive.x0)
        )
        np.testing.assert_allclose(x, run.x, atol=1e-12)
        np.testing.assert_allclose(u, run.u, atol=1e-12)
        expected = np.concatenate([columns(exact.x), columns(exact.u)])
        size = np.max(np.abs(expected))
        assert np.max(np.abs(jacobian - expected)) <= 1e-8 * size, seed  # measured: 1e-13
        adjoint = weigh @ expected
        assert np.max(np.abs(gradient.ravel() - adjoint)) <= 1e-8 * size * np.sqrt(len(weigh)), seed


def test_weights_move_the_loop_as_differences_say() -> None:
    controller, drive, _ = problem(4, None)
    rng = np.random.default_rng(1)
    Q, R = random_weights(rng, controller.plant.n), random_weights(rng, controller.plant.m)
    start = replace(drive, x0=0.2 * drive.x0)  # another regulator, whose terminal set is smaller
    dQ = rng.normal(size=Q.shape)
    dQ += dQ.T

    def moved(step: float) -> np.ndarray:
        weights = Weights(Q + step * dQ, R)
        given = controller.plant, weights, controller.bounds, controller.horizon
        return simulate(Controller(*given), start).x

    assert np.any(
        simulate(Controller(controller.plant, Weights(Q, R), controller.bounds, 3), start).status
    )
    loop = closed_loop_function(controller, drive.steps, of="weights")
    t = ca.MX.sym("t")
    x, _ = loop(Q + t * dQ, R, start.x0, start.disturbance)
    slope = ca.Function("slope", [t], [x, ca.jacobian(x, t)])
    value, found = slope(0)
    np.testing.assert_allclose(value.full(), moved(0.0), atol=1e-12)
    expected = extrapolated_slope(moved, 1e-4)
    np.testing.assert_allclose(
        found.full().reshape(expected.shape, order="F"),
        expected,
        atol=1e-6 * np.abs(expected).max(),
    )


def test_a_given_disturbance_is_no_input() -> None:
    """The same states and gradients as with the disturbance as an input."""
    controller, drive, _ = problem(5, None)
    open_one = closed_loop_function(controller, drive.steps)
    given = closed_loop_function(controller, disturbance=drive.disturbance)
    assert given.name_in() == ["K", "S", "x0"]
    K, S = ca.MX.sym("K", *controller.K.shape), ca.MX.sym("S", *controller.S.shape)
    slopes = []
    for x, u in (open_one(K, S, drive.x0, drive.disturbance), given(K, S, drive.x0)):
        both = ca.veccat(x, u)
        parts = [ca.jacobian(both, K), ca.gradient(ca.sumsqr(both), S)]
        slopes.append(ca.Function("slope", [K, S], parts)(controller.K, controller.S))
    for one, other in zip(*slopes, strict=True):
        np.testing.assert_array_equal(one.full(), other.full())
    with pytest.raises(DataError, match=r"^steps: is missing, without a disturbance"):
        closed_loop_function(controller)


def test_what_is_no_controller_is_nan(example_plant: Plant) -> None:
    bounds = Bounds(example_plant, u_min=-1, u_max=1)
    law = Controller(example_plant, Weights(np.eye(2), 1), bounds, 3)
    loop = closed_loop_function(law, 5)
    still = ca.DM(5, 0)
    x, u = loop(np.zeros((1, 2)), 1, [1, 3], still)  # does not stabilise
    assert np.isnan(x.full()).all()
    assert np.isnan(u.full()).all()
    x, u = loop(law.K, 1, [30, 1], still)  # no input keeps the bounds
    np.testing.assert_array_equal(x.full()[0], [30, 1])
    assert np.isnan(x.full()[1:]).all()
    assert np.isnan(u.full()).all()
    weights = closed_loop_function(law, 5, of="weights")
    assert np.isnan(weights(-np.eye(2), 1, [1, 3], still)[0].full()).all()
    slope = weights.jacobian()(-np.eye(2), 1, [1, 3], still, 0, 0)[0].full()
    assert np.isnan(slope.reshape(2, 6, 4)[:, 1:]).all()  # the first state is x0 all the same
    with pytest.raises(InputError, match=r"^of: got 'price'; choose .gain. or .weights.$"):
        closed_loop_function(law, 5, of="price")


def test_a_bilevel_program_of_ones_own_finds_the_weights(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The example of the dissertation, whose solution is Q = I."""
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    monkeypatch.setattr(importlib.import_module("terminal"), "RESULTS", tmp_path)
    runpy.run_path(str(ROOT / "docs/examples/loop_in_casadi.py"))
    printed = capsys.readouterr().out
    assert "Q = [[1.0, 0.0], [0.0, 1.0]]\n" in printed
    assert "residual (3.10) below 1e-6: True" in printed


def test_one_step_is_the_controllers_and_so_are_its_slopes(tmp_path: Path) -> None:
    """From states of random loops, for the new function and after saving and loading."""
    for seed in (1, 2, 6):
        controller, drive, run = problem(seed, None)
        step = mpc_function(controller)
        step.save(str(tmp_path / "step.casadi"))
        loaded = ca.Function.load(str(tmp_path / "step.casadi"))
        n, jacobian, reverse = controller.plant.n, step.jacobian(), step.reverse(1)
        for sample in range(0, 12, 3):
            state = replace(drive, x0=run.x[sample], disturbance=drive.disturbance[:1])
            along = directions(controller, n, x0=np.eye(n))
            here, slope = simulate_and_differentiate(controller, state, along)
            for made in (step, loaded):
                np.testing.assert_allclose(made(state.x0).full().ravel(), here.u[0], atol=1e-7)
            np.testing.assert_allclose(jacobian(state.x0, 0).full(), slope.u[0], atol=1e-6)
            back = np.ones(controller.plant.m)
            found = reverse(state.x0, 0, back).full().ravel()
            np.testing.assert_allclose(found, back @ slope.u[0], atol=1e-6)
    text = ca.CodeGenerator("step.c")
    text.add(step)
    assert "daqp" in text.dump()


def test_one_step_where_there_is_none_or_nothing_is_bounded(example_plant: Plant) -> None:
    bounds = Bounds(example_plant, u_min=-1, u_max=1)
    weights = Weights(np.eye(2), 1)
    assert np.isnan(float(mpc_function(Controller(example_plant, weights, bounds, 3))([30, 1])))
    free = Controller(example_plant, weights, Bounds(example_plant), 3, terminal_set=False)
    K = solve_lqr(example_plant, weights).K
    np.testing.assert_allclose(mpc_function(free)([30, 1]).full(), -K @ [[30], [1]])
