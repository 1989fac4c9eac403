"""Parametric simulation model: a function from parameters and an input to outputs.

Parameters are normalised to [-1, 1] between their bounds (4.2),

    t_i = (theta_i - o_i) / g_i,    o_i = (max + min) / 2,   g_i = (max - min) / 2.

The standard deviation of a parameter between people is stated by the model, or a quarter of its
range (d = 0.5 in t).

A model may have its own Jacobian (`impc.studies.selection.linear` makes exact ones for linear
systems); otherwise central differences of 1e-4 in normalised units are used (error about 1e-6).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, IntArray, frozen
from impc.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

_STEP = 1e-4


@dataclass(frozen=True)
class Trial(Frozen):
    """One recording, in the units of the model's signals."""

    input: Array  # (samples, d)
    outputs: Array  # (samples, p)


@dataclass(frozen=True)
class ParametricModel(Frozen):
    """A simulation model with bounds, typical values and descriptions of its parameters."""

    names: tuple[str, ...]  # (k,)
    low: Array  # Bounds (k,), in the parameters' units
    high: Array
    typical: Array  # Typical values (k,)
    deviation: Array  # SD of each parameter between people (k,)
    pathways: tuple[str, ...]  # Pathway of each parameter (k,)
    units: tuple[str, ...]
    # (theta (k,), input (samples, d)) -> outputs (samples, p)
    simulate: Callable[[Array, Array], Array]
    # (theta, input, free) -> (outputs, their derivatives (samples, p, f) with respect to the
    # parameters with indices `free`)
    jacobian: Callable[[Array, Array, IntArray], tuple[Array, Array]] | None
    meanings: tuple[str, ...]  # In words; empty: the name

    def word(self, index: int) -> str:
        """Meaning of a parameter in words, or its name."""
        return self.meanings[index] or self.names[index].replace("_", " ")

    def words(self, subset: Sequence[int]) -> str:
        """Parameters of a `subset` in words, separated by commas."""
        return ", ".join(self.word(index) for index in subset)

    def named(self, subset: Sequence[int]) -> list[str]:
        """Names of the parameters whose indices are `subset`."""
        return [self.names[index] for index in subset]

    @property
    def size(self) -> int:
        """Number of parameters."""
        return len(self.names)

    @property
    def gain(self) -> Array:
        """g, half the range of each parameter (k,)."""
        return (self.high - self.low) / 2


def parametric_model(
    names: Sequence[str],
    low: Sequence[float],
    high: Sequence[float],
    typical: Sequence[float],
    simulate: Callable[[Array, Array], Array],
    *,
    pathways: Sequence[str] | None = None,
    units: Sequence[str] | None = None,
    meanings: Sequence[str] | None = None,
    deviation: Sequence[float] | None = None,
    jacobian: Callable[[Array, Array, IntArray], tuple[Array, Array]] | None = None,
) -> ParametricModel:
    """Check and freeze a model; `low`, `high`, `typical`, `deviation` (k,)."""
    count = len(names)
    spread = [(most - least) / 4 for least, most in zip(low, high, strict=False)]
    spread = spread if deviation is None else [float(value) for value in deviation]
    sized = {"low": low, "high": high, "typical": typical, "deviation": spread}
    for name, values in sized.items():
        if len(values) != count:
            raise InputError(name, f"has {len(values)} values", f"give {count}, one per parameter")
    for name, least, most, value, sd in zip(names, *sized.values(), strict=True):
        if not least < most:
            raise InputError(f"parameter {name}", f"range {least:g} to {most:g}", "give low < high")
        if not least <= value <= most:
            raise InputError(
                f"parameter {name}", f"typical value {value:g} is outside its range", "widen it"
            )
        if not 0 <= sd < np.inf:
            raise InputError(f"parameter {name}", f"deviation {sd:g}", "give 0 or more")
    groups, measured, words = (
        ("",) * count if one is None else tuple(one) for one in (pathways, units, meanings)
    )
    return ParametricModel(
        tuple(names), frozen(low), frozen(high), frozen(typical), frozen(spread),
        groups, measured, simulate, jacobian, words,
    )  # fmt: skip


def normalised(model: ParametricModel, theta: Array) -> Array:
    """Normalise parameters theta (k,) by (4.2)."""
    return np.asarray((theta - (model.high + model.low) / 2) / model.gain)


def physical(model: ParametricModel, t: Array) -> Array:
    """Inverse of `normalised`: t (k,) to parameters in their units."""
    return np.asarray((model.high + model.low) / 2 + model.gain * t)


def sensitivity(
    model: ParametricModel, theta: Array, given: Array, free: IntArray | None = None
) -> tuple[Array, Array]:
    """Outputs at theta (k,) for an input, and derivatives by normalised parameters (f,)."""
    along = np.arange(model.size) if free is None else free
    if model.jacobian is not None:
        outputs, derivative = model.jacobian(theta, given, along)
        return outputs, np.asarray(derivative * model.gain[along])
    outputs = np.asarray(model.simulate(theta, given))
    t = normalised(model, theta)
    columns = []
    for step in _STEP * np.eye(model.size)[along]:
        above, below = (model.simulate(physical(model, t + end), given) for end in (step, -step))
        columns.append((above - below) / (2 * _STEP))
    return outputs, np.stack(columns, axis=-1)


def stacked(
    model: ParametricModel, theta: Array, trials: Sequence[Trial], free: IntArray | None = None
) -> tuple[list[Array], Array]:
    """Simulated minus recorded outputs (samples, p) by trial, and the stacked Jacobian."""
    pairs = [sensitivity(model, theta, trial.input, free) for trial in trials]
    errors = [outputs - trial.outputs for trial, (outputs, _) in zip(trials, pairs, strict=True)]
    return errors, np.concatenate([part.reshape(-1, part.shape[-1]) for _, part in pairs])
