"""One sample of a nonlinear body or a linear plant, and slopes along a trajectory.

The operations of a body are translated by LLVM (which numba includes) to machine code without
branches, a function of pointers (constants, given, found). Operations are not fused, so that all
processors give the same numbers. Parameters are constants: bodies that differ only in them share
their code (docs/howto/nonlinear.md).
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import Any

import llvmlite.binding as llvm
import numpy as np
from llvmlite import ir

from impc.arrays import Array
from impc.control.compiled_body import move_along, states_along
from impc.control.compiled_values import BodyTape
from impc.control.constraint_rows import Directions
from impc.model.body import OPERATIONS, Body
from impc.model.plant import Plant


def body_tape(body: Body | None, n: int, given: int, *, moving: bool) -> BodyTape:
    """A body for the compiled loop, empty without one; own arrays, as trials run in parallel."""
    if body is None:
        none = np.zeros((0, 0))
        return BodyTape(0, np.zeros(0), np.zeros(0), np.zeros(0), none, none)
    found = np.zeros(n * (1 + given))
    code = address(body, n, moving=moving)
    constants = np.array(body.constants)
    slopes, beside = found[n:].reshape(n, given), np.array(body.beside, order="C")
    return BodyTape(code, constants, np.zeros(given), found, slopes, beside)


def next_state(plant: Plant, x: Array, u: Array, d: Array) -> Array:
    """State (n,) one sample after x (n,) with u (m,) and d (d,)."""
    if plant.body is None:
        linear: Array = plant.A @ x + plant.B @ u + plant.E @ d
        return linear
    return np.array(_ahead(plant.body, x[None], u[None], d[None])[0])


def pushes(along: Directions, x: Array, u: Array, d: Array) -> Array:
    """Contribution of the body's parameters to each derivative of the next state.

    Directions without nearby bodies change the body as they change the matrices.
    """
    found = np.tensordot(x, along.A, ((1,), (1,))) + np.tensordot(u, along.B, ((1,), (1,)))
    found += np.tensordot(d, along.E, ((1,), (1,)))
    for index, bodies in enumerate(along.bodies):
        if bodies:
            found[..., index] = sum(factor * _ahead(body, x, u, d) for factor, body in bodies)
    return found


def _ahead(body: Body, x: Array, u: Array, d: Array) -> Array:
    ahead = np.empty(x.shape)
    given = x.shape[1] + u.shape[1] + d.shape[1]
    tape = body_tape(body, x.shape[1], given, moving=False)
    states_along(tape, np.array(x), np.array(u), np.array(d), ahead)
    return ahead


def slopes_along(plant: Plant, x: Array, u: Array, d: Array) -> tuple[Array, Array, Array]:
    """Derivatives of the next state by state, input and disturbance, at every sample."""
    n, m, steps = plant.n, plant.m, len(x)
    if plant.body is None:
        parts = (plant.A, plant.B, plant.E)
        A, B, E = (np.broadcast_to(part, (steps, *part.shape)) for part in parts)
        return A, B, E
    given = n + m + plant.E.shape[1]
    tape = body_tape(plant.body, n, given, moving=True)
    found = np.empty((steps, n, given))
    move_along(tape, np.array(x), np.array(u), np.array(d), found)
    return found[..., :n], found[..., n : n + m], found[..., n + m :]


_NUMBER, _PLACE = ir.DoubleType(), ir.IntType(64)
_ZERO, _ONE, _MINUS = (_NUMBER(value) for value in (0.0, 1.0, -1.0))
# LLVM intrinsics (LLVM merges a sine and cosine of one number), and functions of the C library.
_CALLED = {
    **{"SIN": "llvm.sin", "COS": "llvm.cos", "SQRT": "llvm.sqrt", "FABS": "llvm.fabs"},
    **{"EXP": "exp", "LOG": "log", "POW": "pow", "CONSTPOW": "pow"},
    **{"TAN": "tan", "TANH": "tanh", "SINH": "sinh"},
    **{"COSH": "cosh", "ASIN": "asin", "ACOS": "acos", "ATAN": "atan", "ATAN2": "atan2"},
    **{"FMIN": "fmin", "FMAX": "fmax", "HYPOT": "hypot", "LOG1P": "log1p", "EXPM1": "expm1"},
}
_OF_TWO = {"POW", "CONSTPOW", "ATAN2", "FMIN", "FMAX", "HYPOT"}
# Instructions, from a builder and two operands.
_WRITTEN: dict[str, Callable[[Any, Any, Any], Any]] = {
    "MUL": lambda to, a, b: to.fmul(a, b),
    "ADD": lambda to, a, b: to.fadd(a, b),
    "SUB": lambda to, a, b: to.fsub(a, b),
    "DIV": lambda to, a, b: to.fdiv(a, b),
    "NEG": lambda to, a, _: to.fneg(a),
    "SQ": lambda to, a, _: to.fmul(a, a),
    "TWICE": lambda to, a, _: to.fadd(a, a),
    "INV": lambda to, a, _: to.fdiv(_ONE, a),
    "ASSIGN": lambda _, a, __: a,
    "SIGN": lambda to, a, _: to.select(
        to.fcmp_ordered(">", a, _ZERO), _ONE, to.select(to.fcmp_ordered("<", a, _ZERO), _MINUS, a)
    ),
    "LT": lambda to, a, b: to.uitofp(to.fcmp_ordered("<", a, b), _NUMBER),
    "LE": lambda to, a, b: to.uitofp(to.fcmp_ordered("<=", a, b), _NUMBER),
    "EQ": lambda to, a, b: to.uitofp(to.fcmp_ordered("==", a, b), _NUMBER),
    "NE": lambda to, a, b: to.uitofp(to.fcmp_unordered("!=", a, b), _NUMBER),
    "NOT": lambda to, a, _: to.uitofp(to.fcmp_ordered("==", a, _ZERO), _NUMBER),
    "AND": lambda to, a, b: to.uitofp(to.and_(_true(to, a), _true(to, b)), _NUMBER),
    "OR": lambda to, a, b: to.uitofp(to.or_(_true(to, a), _true(to, b)), _NUMBER),
    "IF_ELSE_ZERO": lambda to, a, b: to.select(_true(to, a), b, _ZERO),
}
_one_at_a_time = threading.Lock()


def address(body: Body, states: int, *, moving: bool) -> int:
    """Address of a body's machine code, valid as long as the process runs."""
    with _one_at_a_time:
        place, _ = _translated(body.code.tobytes(), len(body.constants), None if moving else states)
    return place


def _of_states(code: list[list[int]], states: int) -> list[list[int]]:
    """Operations that the next states need."""
    needed: set[int] = set()
    kept = []
    for line in code[::-1]:
        operation, to, a, b = line
        if OPERATIONS[operation] == "OUTPUT":
            wanted = to < states
        else:
            wanted = to in needed
            needed.discard(to)
        if wanted:
            needed |= {a, b}
            kept.append(line)
    return kept[::-1]


@functools.cache
def _translated(code: bytes, constants: int, states: int | None) -> tuple[int, Any]:
    """Address of the compiled function (of `states` outputs only, if given), and its owner."""
    lines: list[list[int]] = np.frombuffer(code, dtype=np.int64).reshape(-1, 4).tolist()
    if states is not None:
        lines = _of_states(lines, states)
    module = ir.Module()
    pointer = _NUMBER.as_pointer()
    kind = ir.FunctionType(ir.VoidType(), [pointer] * 3)
    function = ir.Function(module, kind, "body")
    builder = ir.IRBuilder(function.append_basic_block())
    held, given, found = function.args
    slots: dict[int, Any] = {}

    def read(slot: int) -> Any:
        if slot not in slots:  # computed values are written before they are read
            source, place = (held, slot) if slot < constants else (given, slot - constants)
            slots[slot] = builder.load(builder.gep(source, [_PLACE(place)]))
        return slots[slot]

    for operation, to, a, b in lines:
        name = OPERATIONS[operation]
        if name == "OUTPUT":
            builder.store(read(a), builder.gep(found, [_PLACE(to)]))
        elif name in _WRITTEN:
            slots[to] = _WRITTEN[name](builder, read(a), read(b))
        else:
            operands = [read(a), read(b)] if name in _OF_TWO else [read(a)]
            slots[to] = builder.call(_library(module, _CALLED[name], len(operands)), operands)
    builder.ret_void()
    return _compiled(str(module))


def _compiled(text: str) -> tuple[int, Any]:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    parsed = llvm.parse_assembly(text)
    machine = llvm.Target.from_default_triple().create_target_machine(opt=2, jit=True)
    engine = llvm.create_mcjit_compiler(parsed, machine)
    engine.finalize_object()
    return int(engine.get_function_address("body")), engine


def _library(module: Any, name: str, operands: int) -> Any:
    """A function of LLVM or of the C library, declared once."""
    if name.startswith("llvm."):
        return module.declare_intrinsic(name, [_NUMBER])
    if name in module.globals:
        return module.globals[name]
    return ir.Function(module, ir.FunctionType(_NUMBER, [_NUMBER] * operands), name)


def _true(builder: Any, a: Any) -> Any:
    return builder.fcmp_unordered("!=", a, _ZERO)
