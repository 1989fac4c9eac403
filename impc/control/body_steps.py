"""One sample of whatever moves, a plant's body or its matrices; slopes along a trajectory.

docs/nonlinear.md has the equations.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array
from impc.control.compiled_body import BodyTape, move_along, states_along
from impc.control.native_body import address

if TYPE_CHECKING:
    from impc.control.constraint_rows import Directions
    from impc.model.body import Body
    from impc.model.plant import Plant

__all__ = ["body_tape", "next_state", "pushes", "slopes_along"]


def body_tape(body: Body | None, n: int, given: int, *, moving: bool) -> BodyTape:
    """A body for the compiled loop, empty where there is none.

    With arrays of its own each time, because trials are simulated side by side.
    """
    if body is None:
        return BodyTape(0, np.zeros(0), np.zeros(0), np.zeros(0), np.zeros((0, 0)))
    found = np.zeros(n * (1 + given))
    code = address(body, n, moving=moving)
    constants = np.array(body.constants)
    return BodyTape(code, constants, np.zeros(given), found, found[n:].reshape(n, given))


def next_state(plant: Plant, x: Array, u: Array, d: Array) -> Array:
    """State (n,) after one sample from x (n,) with u (m,) and d (d,)."""
    if plant.body is None:
        linear: Array = plant.A @ x + plant.B @ u + plant.E @ d
        return linear
    return np.array(_ahead(plant.body, x[None], u[None], d[None])[0])


def pushes(along: Directions, x: Array, u: Array, d: Array) -> Array:
    """What the parameters in the body add to each derivative of the next state.

    `x` (steps, n); `u` (steps, m); `d` (steps, d); returns (steps, n, p).
    """
    found = np.zeros((*x.shape, along.count))
    for index, bodies in enumerate(along.bodies):
        for factor, body in bodies:
            found[..., index] += factor * _ahead(body, x, u, d)
    return found


def _ahead(body: Body, x: Array, u: Array, d: Array) -> Array:
    ahead = np.empty(x.shape)
    given = x.shape[1] + u.shape[1] + d.shape[1]
    tape = body_tape(body, x.shape[1], given, moving=False)
    states_along(tape, np.array(x), np.array(u), np.array(d), ahead)
    return ahead


def slopes_along(plant: Plant, x: Array, u: Array, d: Array) -> tuple[Array, Array, Array]:
    """Derivatives of the next state by state, input and disturbance, at every sample.

    `x` (steps, n); `u` (steps, m); `d` (steps, d).
    """
    n, m, steps = plant.n, plant.m, len(x)
    if plant.body is None:
        A, B, E = (np.broadcast_to(part, (steps, *part.shape)) for part in _matrices(plant))
        return A, B, E
    given = n + m + plant.E.shape[1]
    tape = body_tape(plant.body, n, given, moving=True)
    found = np.empty((steps, n, given))
    move_along(tape, np.array(x), np.array(u), np.array(d), found)
    return found[..., :n], found[..., n : n + m], found[..., n + m :]


def _matrices(plant: Plant) -> tuple[Array, Array, Array]:
    return plant.A, plant.B, plant.E
