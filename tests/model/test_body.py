"""Nonlinear bodies: how they are read, and which are rejected."""

from __future__ import annotations

import itertools
import pickle
from typing import Any

import casadi as ca
import control
import numpy as np
import pytest

from impc.errors import PlantError
from impc.files.digests import digest
from impc.model.plant import Plant
from tests.control.hanging_body import pendulum

X, W = ca.SX.sym("x", 2), ca.SX.sym("w", 2)
A, B = np.array([[1.0, 0.1], [0.2, 0.97]]), np.array([[0.0, 0.0], [0.1, 0.1]])
LINEAR = ca.DM(A) @ X + ca.DM(B) @ W


def system(dt: float = 0.1) -> Any:
    return control.ss(A, B, [[1.0, 0.0]], 0, dt, inputs=["push", "torque"])


def solved_inside() -> ca.Function:
    """A body that is no expression: it solves an equation."""
    x, w, z, known = ca.MX.sym("x", 2), ca.MX.sym("w", 2), ca.MX.sym("z"), ca.MX.sym("known")
    equation = {"x": z, "p": known, "g": z - ca.sin(known)}
    solved = ca.rootfinder("solved", "newton", equation)(p=x[0])["x"]
    return ca.Function("f", [x, w], [ca.DM(A) @ x + ca.DM(B) @ w + solved**2])


@pytest.mark.parametrize(
    ("dt", "body", "words"),
    [
        (0.1, 3.0, "expected a casadi.Function"),
        (0.1, ca.Function("f", [X], [X]), r"make it \(states \(2, 1\), inputs \(2, 1\)\)"),
        (0.1, ca.Function("f", [X, W], [LINEAR, W]), "maps"),
        (0.1, ca.Function("f", [X, W], [LINEAR + 1e-6]), "does not have the linearisation"),
        (0.1, ca.Function("f", [X, W], [LINEAR + 0.01 * X[0]]), "does not have the linearisation"),
        (0.1, ca.Function("f", [X, W], [LINEAR + ca.erf(X[0]) * X[0]]), "unknown operation ERF"),
        (0.1, solved_inside(), "uses the unknown operation CALL"),
        (0.0, ca.Function("f", [X, W], [LINEAR]), "is continuous"),
    ],
)
def test_what_is_no_body_is_refused(dt: float, body: Any, words: str) -> None:
    with pytest.raises(PlantError, match=words):
        Plant(system(dt), ["torque"], body=body)


def test_the_order_of_the_inputs_is_that_of_the_system() -> None:
    """The push is first in the body and last in the plant; exchanged, the slopes differ."""
    tilted = np.array([[0.0, 0.0], [0.1, 0.3]])
    given = control.ss(A, tilted, [[1.0, 0.0]], 0, 0.1, inputs=["push", "torque"])
    ahead = ca.DM(A) @ X + ca.DM(tilted) @ W
    assert Plant(given, ["torque"], body=ca.Function("f", [X, W], [ahead])).moves == "nonlinear"
    exchanged = ca.DM(A) @ X + ca.DM(tilted[:, ::-1]) @ W
    with pytest.raises(PlantError, match="its order of states and inputs"):
        Plant(given, ["torque"], body=ca.Function("f", [X, W], [exchanged]))


def test_a_body_is_a_value() -> None:
    """It can be pickled and compared; parameters matter; without it the plant is linear."""
    plant = pendulum()
    sent = pickle.loads(pickle.dumps(plant))
    assert digest(sent) == digest(plant) != digest(pendulum(2.1)) != digest(plant.linear())
    assert plant.body is not None
    assert not plant.body.constants.flags.writeable
    assert not sent.body.code.flags.writeable
    assert (plant.moves, plant.linear().moves) == ("nonlinear", "linear")


def drawn(draw: Any) -> Plant:
    made = system()
    made.drawing = draw
    return Plant(made)


def test_lines_of_a_body_at_every_state() -> None:
    plant = drawn(lambda x: [[[0, 0], [x[0], 1.0]], np.array([[x[1], x[0]]])])
    one, other = plant.drawing(np.array([[1.0, 2.0], [3.0, 4.0]]))
    np.testing.assert_array_equal(one, [[[0, 0], [1, 1]], [[0, 0], [3, 1]]])
    np.testing.assert_array_equal(other, [[[2, 1]], [[4, 3]]])
    assert digest(plant) == digest(Plant(system()))  # it is neither compared nor sent
    for plain in (Plant(system()), pickle.loads(pickle.dumps(plant))):
        assert plain.drawing(np.eye(2)) == ()
    with pytest.raises(PlantError, match="fails: "):
        drawn(lambda x: [np.zeros((1 + int(x[0]), 2))]).drawing(np.eye(2))


@pytest.mark.parametrize(
    "draw",
    [3, lambda x: x[9], lambda _: [[[0, 1, 2]]], lambda _: [[[0, np.nan]]], lambda _: [],
     lambda _: [np.zeros((10**6, 2))], lambda _: itertools.repeat([[0, 0]]), lambda _: "ab"],
)  # fmt: skip
def test_what_is_no_drawing(draw: Any) -> None:
    with pytest.raises(PlantError, match=r"^plant\.drawing: .*; return lines .*\Z"):
        drawn(draw)
