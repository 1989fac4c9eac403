"""One sample of whatever moves, a plant's body or its matrices; slopes along a trajectory."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array
from impc.control.compiled_body import BodyTape, move_along, move_body

if TYPE_CHECKING:
    from impc.model.plant import Plant

__all__ = ["body_tape", "next_state", "slopes_along"]


def body_tape(plant: Plant, moves: Array) -> BodyTape:
    """The body of a plant for the compiled loop, empty where it has none.

    With slots of its own each time, because trials are simulated side by side.

    Parameters
    ----------
    moves : Array
        Derivatives of the body's constants along p directions (c, p).
    """
    count = moves.shape[1]
    if plant.body is None:
        return BodyTape(np.zeros((0, 4), dtype=np.int64), 0, np.zeros(0), np.zeros((0, count)))
    constants, slots = plant.body.constants, plant.body.slots
    values, slopes = np.zeros(slots), np.zeros((slots, count))
    values[: len(constants)], slopes[: len(constants)] = constants, moves
    return BodyTape(np.array(plant.body.code), len(constants), values, slopes)


def next_state(plant: Plant, x: Array, u: Array, d: Array) -> Array:
    """State (n,) after one sample from x (n,) with u (m,) and d (d,)."""
    if plant.body is None:
        linear: Array = plant.A @ x + plant.B @ u + plant.E @ d
        return linear
    tape = body_tape(plant, np.zeros((len(plant.body.constants), 0)))
    ahead, none = np.empty(plant.n), np.zeros((plant.n, 0))
    still = np.zeros((plant.m, 0))
    move_body(tape, np.array(x), np.array(u), np.array(d), none, still, ahead, none.copy())
    return ahead


def slopes_along(plant: Plant, x: Array, u: Array, d: Array) -> tuple[Array, Array, Array]:
    """Derivatives of the next state by state, input and disturbance, at every sample.

    Parameters
    ----------
    x, u, d : Array
        (steps, n), (steps, m) and (steps, d).

    Returns
    -------
    tuple of Array
        (steps, n, n), (steps, n, m) and (steps, n, d): A, B and E where the plant has no body.
    """
    n, m, steps = plant.n, plant.m, len(x)
    if plant.body is None:
        A, B, E = (np.broadcast_to(part, (steps, *part.shape)) for part in _matrices(plant))
        return A, B, E
    count = n + m + plant.E.shape[1]
    tape = body_tape(plant, np.zeros((len(plant.body.constants), count)))
    tape.slopes[tape.given : tape.given + count] = np.eye(count)
    found = np.empty((steps, n, count))
    move_along(tape, np.array(x), np.array(u), np.array(d), found)
    return found[..., :n], found[..., n : n + m], found[..., n + m :]


def _matrices(plant: Plant) -> tuple[Array, Array, Array]:
    return plant.A, plant.B, plant.E
