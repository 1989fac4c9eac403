"""Box bounds on states and inputs, and their rows E x + F u <= b (docs/why/theory.md, section 3).

Only finite bounds make a row. A bound on a state that is the last command of a control
(`with_rates`) applies to the command as it is applied, the next value of that state. Order of the
rows: input upper, input lower, state upper, state lower, each in the order of the signals.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from impc.arrays import Array, BoolArray, frozen
from impc.checking import Value, checked
from impc.errors import BoundsError
from impc.model.plant import Plant


@dataclass(frozen=True, init=False)
class Bounds(Value):
    """Lower and upper bounds on states and inputs; infinite by default.

    Parameters
    ----------
    plant : Plant
        Plant that is bounded.
    x_min, x_max, u_min, u_max : array_like or mapping of str to float, optional
        One number for all signals, an array (n,) or (m,), or a dictionary of bounds by name, in the
        units of the signals. The origin is the equilibrium and must lie strictly inside.

    Attributes
    ----------
    x_min, x_max : ndarray of shape (n,)
        State bounds, in the units of the states.
    u_min, u_max : ndarray of shape (m,)
        Input bounds, in the units of the inputs.

    Raises
    ------
    BoundsError
        If a bound is NaN, has the wrong length, names an unknown signal, crosses its counterpart,
        or excludes the origin.

    Examples
    --------
    >>> import control
    >>> import impc
    >>> plant = impc.Plant(control.ss([[2, -1], [1, 0.2]], [[1], [0]], [[1, 0]], 0, 1))
    >>> impc.Bounds(plant, u_min=-1, u_max=1).u_max
    array([1.])
    >>> impc.Bounds(plant, x_max={"x[1]": 0.5}).x_max
    array([inf, 0.5])
    """

    _rules: ClassVar[Mapping[str, Any]] = {
        "x_min": "~n",
        "x_max": "~n",
        "u_min": "~m",
        "u_max": "~m",
    }

    x_min: Array
    x_max: Array
    u_min: Array
    u_max: Array

    @checked
    def __init__(
        self,
        plant: Plant,
        *,
        x_min: ArrayLike | Mapping[str, float] | None = None,
        x_max: ArrayLike | Mapping[str, float] | None = None,
        u_min: ArrayLike | Mapping[str, float] | None = None,
        u_max: ArrayLike | Mapping[str, float] | None = None,
    ) -> None:
        lower_x = _side("x_min", x_min, plant.states, -np.inf)
        upper_x = _side("x_max", x_max, plant.states, np.inf)
        lower_u = _side("u_min", u_min, plant.controls, -np.inf)
        upper_u = _side("u_max", u_max, plant.controls, np.inf)
        _check_pair("x_min, x_max", plant.states, lower_x, upper_x)
        _check_pair("u_min, u_max", plant.controls, lower_u, upper_u)
        self._fill(x_min=lower_x, x_max=upper_x, u_min=lower_u, u_max=upper_u)


@dataclass(frozen=True)
class BoundRows(Value):
    """Finite bounds of one stage as rows E x + F u <= b."""

    E: Array  # (c, n)
    F: Array  # (c, m)
    b: Array  # (c,)
    on_state: BoolArray  # (c,), whether the row bounds a state; the others bound a command
    names: tuple[str, ...]  # one per row, such as "u <= 1"

    def along_limit(self, control: int) -> Array:
        """Derivative of `b` (c,) with respect to the logarithm of the limits of a control."""
        own = (self.F[:, control] != 0) & ~np.any(
            self.E, axis=1
        )  # not of a command that is a state
        return np.where(own, self.b, 0.0)


def bound_rows(bounds: Bounds, plant: Plant) -> BoundRows:
    """Return the finite bounds as rows."""
    limits = np.concatenate([bounds.u_max, bounds.u_min, bounds.x_max, bounds.x_min])
    sign = np.repeat([1.0, -1.0, 1.0, -1.0], [plant.m, plant.m, plant.n, plant.n])
    signals = (*plant.controls, *plant.controls, *plant.states, *plant.states)
    finite = np.isfinite(limits)
    names = [
        f"{signals[index]} {'<=' if sign[index] > 0 else '>='} {limits[index]:g}"
        for index in np.flatnonzero(finite)
    ]
    inputs, no_state = np.eye(plant.m), np.zeros((2 * plant.m, plant.n))
    applied = np.isin(plant.states, plant.commands)
    states = np.where(applied[:, None], plant.A, np.eye(plant.n))
    moved = np.where(applied[:, None], plant.B, 0.0)
    return BoundRows(
        E=frozen(np.vstack([no_state, states, -states])[finite]),
        F=frozen(np.vstack([inputs, -inputs, moved, -moved])[finite]),
        b=frozen((sign * limits)[finite]),
        on_state=np.concatenate([np.zeros(2 * plant.m, bool), ~applied, ~applied])[finite],
        names=tuple(names),
    )


def _side(
    name: str,
    values: ArrayLike | Mapping[str, float] | None,
    signals: tuple[str, ...],
    default: float,
) -> Array:
    size = len(signals)
    if values is None:
        return np.full(size, default)
    if isinstance(values, Mapping):
        for key in values:
            if key not in signals:
                raise BoundsError(
                    name, f"there is no signal {key!r}", f"choose from {', '.join(signals)}"
                )
        values = [values.get(signal, default) for signal in signals]
    try:
        side = np.array(np.broadcast_to(np.asarray(values, dtype=float), (size,)))
    except ValueError:
        raise BoundsError(
            name, f"got shape {np.shape(values)}", f"give one number, or {size} of them"
        ) from None
    if np.any(np.isnan(side)):
        raise BoundsError(name, f"has NaN: {side.tolist()}", "use inf for no bound")
    return side


def _check_pair(name: str, signals: tuple[str, ...], lower: Array, upper: Array) -> None:
    for signal, low, high in zip(signals, lower, upper, strict=True):
        if low >= high:
            raise BoundsError(name, f"cross for {signal}: {low:g} >= {high:g}", "swap them")
        if low == 0 or high == 0:
            raise BoundsError(
                name,
                f"has a bound of {signal} at 0: [{low:g}, {high:g}]",
                "subtract the value at rest from the signal, u_min and u_max, so that 0 is inside",
            )
        if not low < 0 < high:
            raise BoundsError(
                name,
                f"exclude the origin for {signal}: [{low:g}, {high:g}]",
                "shift the signal so that its equilibrium is 0",
            )
