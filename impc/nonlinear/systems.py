"""The equations of a python-control system as a CasADi expression.

A `control.nlsys` keeps its equations as a Python function of numbers, dx/dt or x_{k+1} =
update(t, x, u, params). Written with operators and numpy's functions it takes symbols as well, and
then gives an expression. A continuous one is stepped by the method of Runge and Kutta of fourth
order with its input held:

    x_{k+1} = x_k + dt (k1 + 2 k2 + 2 k3 + k4) / 6

docs/nonlinear.md has an example.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import casadi as ca
import control
import numpy as np

from impc.errors import InputError, one_line

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

# Of the largest entry: between what the function says of numbers and what the expression does.
_AGREE = 1e-10
_REMEDY = "write it with operators and numpy's functions, without if, float and math"


def is_system(value: object) -> bool:
    """Whether a `value` is a system of python-control."""
    return isinstance(value, control.InputOutputSystem)


def system_equations(
    system: Any,
    symbols: Sequence[Sequence[Any]],
    names: Sequence[Sequence[str]],
    parameters: Mapping[str, Any],
    dt: float | None,
) -> Any:
    """f(x, u, d; theta) of a system.

    `dt` in s; returns (n,).
    """
    if not isinstance(system, control.NonlinearIOSystem):
        kind = type(system).__name__
        raise InputError("next_state", f"got {kind}, without equations", "give a control.nlsys")
    x_order = _order("states", system.state_labels, names[0])
    u_order = _order("inputs", system.input_labels, (*names[1], *names[2]))
    x, u = ca.vertcat(*symbols[0]), ca.vertcat(*symbols[1], *symbols[2])
    if not x_order or not u_order:
        raise InputError("next_state", "is a system without states or inputs", "give both")
    x, u = (ca.vertcat(*(whole[k] for k in order)) for whole, order in ((x, x_order), (u, u_order)))
    rate = _equations(system, x, u, dict(parameters))
    following = rate(x, u) if _steps_itself(system, dt) else _runge_kutta(rate, x, u, dt)
    return ca.vertcat(*(following[x_order.index(k)] for k in range(len(x_order))))


def _order(kind: str, wanted: Sequence[str], given: Sequence[str]) -> list[int]:
    """For each signal of the system, the place of its symbol."""
    if len(wanted) != len(given):
        raise InputError(
            "next_state", f"is a system with the {kind} {', '.join(wanted)}",
            f"give {len(wanted)} symbols, and not {len(given)}",
        )  # fmt: skip
    if set(wanted) == set(given):
        return [list(given).index(name) for name in wanted]
    return list(range(len(given)))


def _steps_itself(system: Any, dt: float | None) -> bool:
    """Whether it is discrete, and then as often as the problem."""
    if not system.dt:  # 0 or None
        if dt is None:
            raise InputError("next_state", "is a continuous system", "give dt, in s")
        return False
    if system.dt is not True and dt is not None and not np.isclose(system.dt, dt, rtol=1e-9):
        raise InputError("dt", f"got {dt:g}, and the system has {system.dt:g}", "leave it out")
    return True


def _runge_kutta(rate: Callable[[Any, Any], Any], x: Any, u: Any, dt: Any) -> Any:
    k1 = rate(x, u)
    k2 = rate(x + dt / 2 * k1, u)
    k3 = rate(x + dt / 2 * k2, u)
    k4 = rate(x + dt * k3, u)
    return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def _equations(
    system: Any, x: Any, u: Any, parameters: Mapping[str, Any]
) -> Callable[[Any, Any], Any]:
    """The update function of (x, u) as an expression, compared with itself on numbers."""
    kind: Any = ca.MX if isinstance(x, ca.MX) else ca.SX
    t = kind.sym("t")
    made = ca.Function(
        "equations", [t, x, u, *parameters.values()], [_called(system, t, x, u, parameters)],
        {"allow_free": True},
    )  # fmt: skip
    if made.has_free():  # told by whoever asks for the symbols
        return lambda x, u: _called(system, 0.0, x, u, parameters)
    if made.jac_sparsity(0, 0).nnz():
        raise InputError(
            "next_state", "is a system that depends on time", "make what changes a disturbance"
        )
    rng = np.random.default_rng(0)
    for _ in range(3):
        at_x, at_u, values = (rng.uniform(0.1, 1, size) for size in
                              (x.numel(), u.numel(), len(parameters)))  # fmt: skip
        numbers = dict(zip(parameters, map(float, values), strict=True))
        expected = _called(system, 0.0, at_x, at_u, numbers).full()
        found = made(0.0, at_x, at_u, *values).full()
        size = np.max(np.abs(expected), initial=1.0)
        if not np.allclose(found, expected, rtol=0, atol=_AGREE * size, equal_nan=True):
            raise InputError(
                "next_state", "is a system whose function is another on symbols than on numbers",
                _REMEDY,
            )  # fmt: skip
    return lambda x, u: made(0.0, x, u, *parameters.values())


def _called(system: Any, t: Any, x: Any, u: Any, parameters: Mapping[str, Any]) -> Any:
    """The function of the system, of symbols or numbers, as a column of CasADi."""
    if isinstance(system, control.StateSpace):
        return ca.mtimes(ca.DM(system.A), x) + ca.mtimes(ca.DM(system.B), u)
    try:
        with warnings.catch_warnings():  # that numpy's function of a symbol is CasADi's
            warnings.simplefilter("ignore", FutureWarning)
            found = system.updfcn(t, x, u, {**system.params, **parameters})
        if not isinstance(found, ca.SX | ca.MX | ca.DM):
            found = ca.vertcat(*np.asarray(found, dtype=object).ravel())
    except Exception as error:  # a user's function may raise anything
        raise InputError(
            "next_state",
            f"is a system whose function takes no symbols ({one_line(error)})",
            _REMEDY,
        ) from None
    if found.numel() != system.nstates:
        raise InputError(
            "next_state", f"is a system whose function gives {found.numel()} numbers",
            f"give {system.nstates}, one a state",
        )  # fmt: skip
    return ca.vec(found)
