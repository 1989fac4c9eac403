"""Plants that differ in physical parameters which are not known exactly.

The parameters are positive (masses, lengths, stiffnesses, time constants) and are searched in
their logarithms about the nominal values. The plant's matrices are analytic functions of them, so
the derivative is taken by Richardson's extrapolation of central differences of step h and h/2 in
the logarithm: an error of order h^4 and of rounding/h. At h = 1e-3 both are 1e-12, and the two
central differences say how far the extrapolation can be trusted. docs/fitting.md says how a
parameter is freed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.checking import checked
from impc.errors import InputError, PlantError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from impc.model.body import Body
    from impc.model.plant import Plant

_STEP = 1e-3
# Difference of the two central differences, relative to the derivative: h^2 for a smooth plant.
_ROUGH = 1e-3


@dataclass(frozen=True, init=False)
class PlantFamily(Frozen):
    """A plant for every value of some physical parameters, which are searched with the gain.

    Parameters
    ----------
    make : callable
        Values of the parameters (k,), in their units -> plant.
    names : sequence of str
        Of the parameters.
    nominal : sequence of float
        Their values when nothing is known, in their units; positive.

    Attributes
    ----------
    make : callable
        Values (k,) in the parameters' units -> `Plant`.
    names : tuple of str
        (k,).
    nominal : Array
        Values about which they are searched (k,), positive.

    Raises
    ------
    InputError
        When a nominal value is not a positive number: give it in a unit in which it is.

    Examples
    --------
    A mass (kg) that is pushed for a second at a time, between 60 and 90 kg as far as one knows.

    >>> import control
    >>> import impc
    >>> def pushed(values):
    ...     return impc.Plant(control.ss([[1.0]], [[1 / values[0]]], [[1.0]], 0, 1))
    >>> family = impc.PlantFamily(pushed, ["mass"], [75.0])
    >>> family.make([80.0]).B
    array([[0.0125]])
    """

    make: Callable[[Array], Plant]
    names: tuple[str, ...]
    nominal: Array

    @checked
    def __init__(
        self, make: Callable[[Array], Plant], names: Sequence[str], nominal: Sequence[float]
    ) -> None:
        if len(names) != len(nominal):
            raise InputError(
                "nominal", f"has {len(nominal)} values", f"give {len(names)}, one a name"
            )
        for name, value in zip(names, nominal, strict=True):
            if not 0 < value < np.inf:
                raise InputError(
                    f"parameter {name}", f"nominal value {value:g}", "give a positive one"
                )
        for field, given in (("make", make), ("names", tuple(names)), ("nominal", frozen(nominal))):
            object.__setattr__(self, field, given)

    def linear(self) -> PlantFamily:
        """The same family without bodies of their own: the matrices alone move."""
        return PlantFamily(
            lambda values: self.make(values).linear(), self.names, self.nominal.tolist()
        )


class PlantDifferential(NamedTuple):
    """Derivatives with respect to the logarithms of parameters, whose axis is last."""

    A: Array  # (n, n, k)
    B: Array  # (n, m, k)
    E: Array  # (n, d, k)
    C: Array  # (p, n, k)
    observer: Array  # Of the rates of the observer (d, k)
    # For each parameter, bodies nearby with their factors: the sum of what they do at a sample is
    # the derivative of the plant's own. Empty where it has none.
    bodies: tuple[tuple[tuple[float, Body], ...], ...]


@checked(logarithms="*")
def plant_at(family: PlantFamily, logarithms: Array) -> Plant:
    """The plant at nominal * exp(logarithms), logarithms (k,)."""
    return family.make(family.nominal * np.exp(logarithms))


def plant_differential(family: PlantFamily, logarithms: Array) -> PlantDifferential:
    """Derivatives of the plant's matrices with respect to the logarithms of its parameters."""
    parts: list[tuple[Array, ...]] = []
    bodies: list[tuple[tuple[float, Body], ...]] = []
    for index, name in enumerate(family.names):
        coarse, far = _central(family, logarithms, index, _STEP)
        fine, near = _central(family, logarithms, index, _STEP / 2)
        for one, other in zip(coarse, fine, strict=True):
            if np.max(np.abs(one - other), initial=0) > _ROUGH * np.max(np.abs(other), initial=0):
                raise PlantError(
                    f"parameter {name}", "the plant is not smooth in it", "do not free it"
                )
        parts.append(tuple((4 * b - a) / 3 for a, b in zip(coarse, fine, strict=True)))
        shares = [(4 / 3 * factor, body) for factor, body in near]
        bodies.append((*shares, *((-factor / 3, body) for factor, body in far)))
    A, B, E, C, observer = (np.stack(group, axis=-1) for group in zip(*parts, strict=True))
    return PlantDifferential(A, B, E, C, observer, tuple(bodies))


def _central(
    family: PlantFamily, logarithms: Array, index: int, step: float
) -> tuple[tuple[Array, ...], tuple[tuple[float, Body], ...]]:
    """Central differences of the matrices, and the two bodies with their factors."""
    shift = np.zeros(len(family.names))
    shift[index] = step
    above, below = plant_at(family, logarithms + shift), plant_at(family, logarithms - shift)
    finite = np.where(np.isinf(below.observer), 0.0, [above.observer, below.observer])
    pairs = (
        *((above.A, below.A), (above.B, below.B), (above.E, below.E), (above.C, below.C)),
        tuple(finite),
    )
    ends = ((1 / (2 * step), above.body), (-1 / (2 * step), below.body))
    return (
        tuple((up - down) / (2 * step) for up, down in pairs),
        tuple((factor, body) for factor, body in ends if body is not None),
    )
