"""Parametric simulation model: a function from parameters and an input to outputs.

Parameters are normalised to [-1, 1] between their bounds (4.2),

    t_i = (theta_i - o_i) / g_i,    o_i = (max + min) / 2,   g_i = (max - min) / 2.

The standard deviation of a parameter between people is stated by the model, or a quarter of its
range (d = 0.5 in t).

A model may have its own Jacobian; otherwise central differences of 1e-4 in normalised units are
used (error about 1e-6). `linear_functions` makes an exact one for x' = A(theta) x + B(theta) r,
y = C(theta) x: the input is held between samples, so that

    x+ = Ad x + Bd r,      [Ad Bd; 0 I] = exp( [A B; 0 0] dt )

is exact for all poles. Derivatives of the exponential are Fréchet derivatives along those of A and
B, which CasADi computes; with X_i = dx / dtheta_i

    X_i+ = Ad X_i + (dAd/dtheta_i) x + (dBd/dtheta_i) r.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import scipy

from impc.arrays import Array, Frozen, IntArray, frozen
from impc.errors import InputError
from impc.jit import njit

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
    def usual(self) -> Array:
        """Typical values in normalised units (k,)."""
        return normalised(self, np.asarray(self.typical))

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


def linear_functions(
    matrices: ca.Function, dt: float
) -> tuple[
    Callable[[Array, Array], Array], Callable[[Array, Array, IntArray], tuple[Array, Array]]
]:
    """Functions `simulate` and `jacobian` of a `ParametricModel` from rest; `dt` in s."""
    symbol = ca.SX.sym("theta", matrices.size1_in(0))
    jacobians = [ca.jacobian(ca.vec(part), symbol) for part in matrices(symbol)]
    derivative = ca.Function("derivative", [symbol], jacobians)

    def jacobian(theta: Array, given: Array, free: IntArray) -> tuple[Array, Array]:
        given = np.ascontiguousarray(given)
        A, B, C = (item.full() for item in matrices(theta))
        dA, dB, dC = (
            # CasADi stacks columns; the first axis becomes the parameter.
            item.full()[:, free].T.reshape(len(free), *part.T.shape).transpose(0, 2, 1)
            for item, part in zip(derivative(theta), (A, B, C), strict=True)
        )
        exponential, change = _exponentials(_joined(A, B) * dt, _joined(dA, dB) * dt)
        x, X = _with_derivatives(*_split(exponential, A), *_split(change, A), given)
        on_state, on_output = np.einsum("pn,skn->spk", C, X), np.einsum("kpn,sn->spk", dC, x)
        return np.asarray(x @ C.T), np.asarray(on_state + on_output)

    def simulate(theta: Array, given: Array) -> Array:
        given = np.ascontiguousarray(given)
        A, B, C = (item.full() for item in matrices(theta))
        held = scipy.linalg.expm(_joined(A, B) * dt)
        none = np.zeros((0, *held.shape))
        x, _ = _with_derivatives(*_split(held, A), *_split(none, A), given)
        return np.asarray(x @ C.T)

    return simulate, jacobian


def _joined(A: Array, B: Array) -> Array:
    """[A B; 0 0], with the leading axes of A and B."""
    wide = np.concatenate([A, B], axis=-1)
    return np.pad(wide, [(0, 0)] * (wide.ndim - 2) + [(0, B.shape[-1]), (0, 0)])


def _split(held: Array, A: Array) -> tuple[Array, Array]:
    """Blocks [A B] of held matrices (..., N, N), contiguous."""
    n = len(A)
    return np.ascontiguousarray(held[..., :n, :n]), np.ascontiguousarray(held[..., :n, n:])


def _exponentials(M: Array, along: Array) -> tuple[Array, Array]:
    """exp(M) and its Fréchet derivatives (k, N, N) along k directions.

    The corner of exp [[M, L], [0, M]] is the derivative along L (Higham 2008, chapter 3); L is
    scaled to the norm of M, so that it does not affect the number of squarings.
    """
    count, size = along.shape[:2]
    length = np.linalg.norm(along, axis=(1, 2), keepdims=True) / max(np.linalg.norm(M), 1e-300)
    length[length == 0] = 1.0
    blocks = np.tile(np.kron(np.eye(2), M), (count, 1, 1))
    blocks[:, :size, size:] = along / length
    found = np.asarray(scipy.linalg.expm(blocks))
    first = found[0, :size, :size] if count else np.asarray(scipy.linalg.expm(M))
    return first, found[:, :size, size:] * length


@njit(nogil=True)
def _with_derivatives(A: Any, B: Any, dA: Any, dB: Any, given: Any) -> Any:
    samples, n, d, count = len(given), A.shape[0], B.shape[1], len(dA)
    x = np.zeros((samples, n))
    X = np.zeros((samples, count, n))
    for k in range(samples - 1):
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += A[i, j] * x[k, j]
            for j in range(d):
                total += B[i, j] * given[k, j]
            x[k + 1, i] = total
        for p in range(count):
            for i in range(n):
                total = 0.0
                for j in range(n):
                    total += A[i, j] * X[k, p, j] + dA[p, i, j] * x[k, j]
                for j in range(d):
                    total += dB[p, i, j] * given[k, j]
                X[k + 1, p, i] = total
    return x, X
