"""One sample of whatever moves, a plant's body or its matrices; slopes along a trajectory.

docs/nonlinear.md has the equations.

CasADi evaluates a body. What it calls with minimal overhead, a buffer that knows where to read and
to write, is a function of the C interface with one pointer, so that compiled code calls it too.
"""

from __future__ import annotations

import ctypes
import functools
import importlib
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.arrays import Array
from impc.control.compiled_body import BodyTape, move_along, states_along
from impc.model.body import function_of

if TYPE_CHECKING:
    from impc.control.constraint_rows import Directions
    from impc.model.body import Body
    from impc.model.plant import Plant


def body_tape(body: Body | None, n: int, given: int, *, moving: bool) -> tuple[BodyTape, Any]:
    """A body for the compiled loop, empty where there is none, and what has to live as long."""
    if body is None:
        return BodyTape(0, 0, np.zeros(0), np.zeros(0), np.zeros((0, 0))), None
    tape = BodyTape(0, 0, np.zeros(given), np.zeros(n), np.zeros((n, given)))
    buffer, _ = function_of(body, moving=moving).buffer()
    buffer.set_arg(0, tape.given.data)
    buffer.set_res(0, tape.found.data)
    if moving:
        buffer.set_res(1, tape.slopes.data)
    code, pointer = _evaluation()
    return tape._replace(code=code, buffer=pointer(buffer._self(), None)), buffer


@functools.cache
def _evaluation() -> tuple[int, Any]:
    """Where CasADi's function begins that evaluates a buffer, and what tells where a buffer is."""
    library = importlib.import_module("casadi._casadi").__file__
    function = ctypes.CDLL(library)["_ZN6casadi21_function_buffer_evalEPv"]
    pointer = ctypes.pythonapi.PyCapsule_GetPointer
    pointer.restype, pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    return int(ctypes.cast(function, ctypes.c_void_p).value or 0), pointer


def next_state(plant: Plant, x: Array, u: Array, d: Array) -> Array:
    """State (n,) after one sample from x (n,) with u (m,) and d (d,)."""
    if plant.body is None:
        linear: Array = plant.A @ x + plant.B @ u + plant.E @ d
        return linear
    return np.array(_ahead(plant.body, x[None], u[None], d[None])[0])


def pushes(along: Directions, x: Array, u: Array, d: Array) -> Array:
    """What the parameters in the body add to each derivative of the next state."""
    found = np.zeros((*x.shape, along.count))
    for index, bodies in enumerate(along.bodies):
        for factor, body in bodies:
            found[..., index] += factor * _ahead(body, x, u, d)
    return found


def _ahead(body: Body, x: Array, u: Array, d: Array) -> Array:
    ahead = np.empty(x.shape)
    given = x.shape[1] + u.shape[1] + d.shape[1]
    tape, _buffer = body_tape(body, x.shape[1], given, moving=False)
    states_along(tape, np.array(x), np.array(u), np.array(d), ahead)
    return ahead


def slopes_along(plant: Plant, x: Array, u: Array, d: Array) -> tuple[Array, Array, Array]:
    """Derivatives of the next state by state, input and disturbance, at every sample."""
    n, m, steps = plant.n, plant.m, len(x)
    if plant.body is None:
        A, B, E = (np.broadcast_to(part, (steps, *part.shape)) for part in _matrices(plant))
        return A, B, E
    given = n + m + plant.E.shape[1]
    tape, _buffer = body_tape(plant.body, n, given, moving=True)
    found = np.empty((steps, n, given))
    move_along(tape, np.array(x), np.array(u), np.array(d), found)
    return found[..., :n], found[..., n : n + m], found[..., n + m :]


def _matrices(plant: Plant) -> tuple[Array, Array, Array]:
    return plant.A, plant.B, plant.E
