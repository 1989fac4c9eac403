"""Plants that differ in physical parameters which are not known exactly.

The parameters are positive (masses, lengths, stiffnesses, time constants) and are searched in
their logarithms about the nominal values. The plant's matrices are analytic functions of them, so
the derivative is taken by Richardson's extrapolation of central differences of step h and h/2 in
the logarithm: an error of order h^4 and of rounding/h. At h = 1e-3 both are 1e-12, and the two
central differences say how far the extrapolation can be trusted. docs/fitting.md says how a
parameter is freed.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from impc.arrays import Array, frozen
from impc.checking import Value, checked, replace
from impc.errors import InputError, PlantError
from impc.model.plant import UNKNOWN

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from impc.arrays import BoolArray
    from impc.model.body import Body
    from impc.model.bounds import Bounds
    from impc.model.plant import Plant

_STEP, _FINE_STEP = 1e-3, 1e-4
#: What may be uncertain beside the parameters of a plant.
DELAY, LIMIT = "extra_delay", "u_max"
# A step of a free parameter's logarithm that counts as large.
_FREE = 1 / 3
# Samples of delay that one more state can stand for.
_LONGEST = 2.0
# Difference of the two central differences, relative to the derivative: h^2 for a smooth plant.
_ROUGH = 1e-3


@dataclass(frozen=True, init=False, eq=False)  # itself alone: its derivatives may be cached
class PlantFamily(Value):
    """A plant for every value of some physical parameters, which are fitted with the gain.

    Parameters
    ----------
    make : callable
        Values of the parameters (k,), in their units -> plant.
    names : sequence of str
        Of the parameters.
    nominal : sequence of float
        Their values when nothing is known, in their units; positive.
    uncertainty : mapping of str to float or str, optional
        Standard deviation with which a parameter is known, by its name: in its own unit, or
        relative as "5 %". Such a parameter keeps to its nominal value as far as that says, and
        every interval contains its uncertainty. A parameter without one is free: any positive
        value. Two more may be named: "extra_delay", by which commands reach the plant later than
        `make` says, in seconds and at most two samples, and "u_max", the limits of the controls.

    Attributes
    ----------
    make : callable
        Values (k,) in the parameters' units -> `Plant`.
    names : tuple of str
        (k,).
    nominal : Array
        Values about which they are searched (k,), positive.
    deviations : Array
        Standard deviation of the logarithm of each (k,); infinite where it is free.
    limit_deviation : float
        Of the logarithm of the limits of the controls; 0 where they are known.

    Raises
    ------
    InputError
        When a nominal value is not a positive number: give it in a unit in which it is; when an
        uncertainty is of no parameter, or no standard deviation.

    Examples
    --------
    A mass (kg) that is pushed for a second at a time, known to 4 kg.

    >>> import control
    >>> import impc
    >>> def pushed(values):
    ...     return impc.Plant(control.ss([[1.0]], [[1 / values[0]]], [[1.0]], 0, 1))
    >>> family = impc.PlantFamily(pushed, ["mass"], [80.0], {"mass": 4.0})
    >>> family.make([100.0]).B
    array([[0.01]])
    >>> family.deviations
    array([0.05])
    """

    make: Callable[[Array], Plant]
    names: tuple[str, ...]
    nominal: Array
    deviations: Array
    limit_deviation: float

    @checked
    def __init__(
        self,
        make: Callable[[Array], Plant],
        names: Sequence[str],
        nominal: Sequence[float],
        uncertainty: Mapping[str, Any] | None = None,
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
        given = dict(uncertainty or {})
        limit = relative_deviation(LIMIT, given.pop(LIMIT, 0.0), None)
        late = 0.0 if DELAY in names else given.pop(DELAY, 0.0)
        unknown = [name for name in given if name not in names]
        if unknown:
            known = ", ".join([*names, DELAY, LIMIT])
            raise InputError(f"uncertainty {unknown[0]}", "is of no parameter", f"known: {known}")
        found = [
            relative_deviation(name, given[name], value) if name in given else np.inf
            for name, value in zip(names, nominal, strict=True)
        ]
        self._fill(
            make=make,
            names=tuple(names),
            nominal=frozen(nominal),
            deviations=frozen(found),
            limit_deviation=limit,
        )
        if 0.0 in found:  # known exactly
            uncertain = np.array(found) > 0
            self._fill(**vars(self.part(uncertain, np.zeros(len(found)))))
        if relative_deviation(DELAY, late, 1.0) > 0:
            dt = self.make(self.nominal).dt
            self._fill(**vars(self.with_delay(relative_deviation(DELAY, late, dt), dt)))

    @property
    def stated(self) -> BoolArray:
        """Which parameters have a stated uncertainty (k,); the others are free."""
        return np.isfinite(self.deviations)

    @property
    def unit(self) -> Array:
        """What one unit of each coordinate of a search is of its logarithm (k,)."""
        return np.where(self.stated, self.deviations, _FREE)

    def values(self, logarithms: Array) -> Array:
        """The parameters (k,), in their units, at logarithms (k,) of them over their nominal."""
        begins = self.make(self.nominal).dt if DELAY in self.names else 0.0
        late = np.array([name == DELAY for name in self.names], float)
        return np.asarray(self.nominal * np.exp(logarithms) - begins * late)

    def linear(self) -> PlantFamily:
        """The same family without bodies of their own: the matrices alone move."""
        return replace(self, make=lambda values: self.make(values).linear())

    def part(self, chosen: BoolArray, logarithms: Array) -> PlantFamily:
        """The `chosen` parameters alone (k,), the others held at `logarithms` (k,)."""
        whole, made = self.nominal * np.exp(logarithms), self.make

        def make(values: Array) -> Plant:
            moved = np.array(whole)
            moved[chosen] = values
            return made(moved)

        return replace(
            self,
            make=make,
            names=tuple(np.array(self.names)[chosen].tolist()),
            nominal=frozen(self.nominal[chosen]),
            deviations=frozen(self.deviations[chosen]),
        )

    def wider(
        self,
        names: Sequence[str],
        nominal: Sequence[float],
        deviations: Sequence[float],
        change: Callable[[Plant, Array], Plant] = lambda plant, _: plant,
    ) -> PlantFamily:
        """The family with more parameters.

        Parameters
        ----------
        names, nominal, deviations : sequence
            Of the further parameters, as of the class.
        change : callable
            Plant and values (more,) of the further parameters -> plant.
        """
        count, make = len(self.names), self.make
        return replace(
            self,
            make=lambda values: change(make(values[:count]), values[count:]),
            names=(*self.names, *names),
            nominal=frozen([*self.nominal, *nominal]),
            deviations=frozen([*self.deviations, *deviations]),
        )

    def with_delay(self, deviation: float, dt: float) -> PlantFamily:
        """The family with a delay of the commands, known to `deviation` samples of `dt` (s)."""
        if deviation > _LONGEST:
            remedy = "make a plant with a delay of its own"
            raise InputError(f"uncertainty {DELAY}", f"is more than {_LONGEST:g} samples", remedy)
        # It is counted from one sample on, so that its logarithm is a number where there is none.
        return self.wider(
            [DELAY],
            [dt],
            [deviation],
            lambda plant, late: with_late_commands(plant, late[0] / dt - 1),
        )

    def with_limits(self, plant: Plant, bounds: Bounds) -> PlantFamily:
        """The family with the limits of the controls among its parameters, where uncertain."""
        bounded = np.flatnonzero(np.isfinite(bounds.u_max))
        if self.limit_deviation == 0 or len(bounded) == 0:
            return self
        if np.any(bounds.u_max != -bounds.u_min) or plant.commands:
            remedy = "leave it out of the uncertainty"
            raise InputError(f"uncertainty {LIMIT}", "needs a limit alike on both sides", remedy)
        names = [f"{LIMIT}.{plant.controls[place]}" for place in bounded]
        limits, known = np.array(bounds.u_max)[bounded], [self.limit_deviation] * len(bounded)
        return replace(self.wider(names, limits.tolist(), known), limit_deviation=0.0)

    def limits(self, plant: Plant) -> list[tuple[int, int]]:
        """Places of the limits among the parameters, each with that of its control."""
        named = {f"{LIMIT}.{control}": place for place, control in enumerate(plant.controls)}
        return [(k, named[name]) for k, name in enumerate(self.names) if name in named]

    def bounds_at(self, plant: Plant, bounds: Bounds, logarithms: Array) -> Bounds:
        """The bounds with the limits that belong to these `logarithms` (k,)."""
        found = self.limits(plant)
        u_max = np.array(bounds.u_max)
        for place, control in found:
            u_max[control] = self.nominal[place] * np.exp(logarithms[place])
        return replace(bounds, u_min=frozen(-u_max), u_max=frozen(u_max)) if found else bounds


def relative_deviation(name: str, given: float | str, nominal: float | None) -> float:
    """Standard deviation of a logarithm, from "5 %" or a number in the unit of `nominal`."""
    where, share = f"uncertainty {name}", isinstance(given, str) and given.strip().endswith("%")
    try:
        number = float(str(given).strip().removesuffix("%"))
    except ValueError:
        number = -1.0
    if not 0 <= number < np.inf:
        raise InputError(where, f"got {given!r}", 'give a standard deviation, or "5 %"')
    if not share and number and nominal is None:
        raise InputError(where, f"got {given!r}", 'give a share of the limit, as "5 %"')
    return number / 100 if share else number / (nominal or 1.0)


def with_late_commands(plant: Plant, lag: float) -> Plant:
    """The plant whose commands arrive `lag` samples late, part of the last one in each sample."""
    if plant.body is not None:
        raise PlantError("plant.body", "has no delay of commands", "write one into the body")
    n, m = plant.n, plant.m
    A, B = np.zeros((n + m, n + m)), np.zeros((n + m, m))
    A[:n, :n], A[:n, n:] = plant.A, lag * plant.B
    B[:n], B[n:] = (1 - lag) * plant.B, np.eye(m)
    units = [(f"last_{name}", plant.unit(name)) for name in plant.controls]
    return replace(
        plant,
        A=frozen(A),
        B=frozen(B),
        E=frozen(np.vstack([plant.E, np.zeros((m, plant.E.shape[1]))])),
        C=frozen(np.hstack([plant.C, np.zeros((len(plant.C), m))])),
        states=(*plant.states, *(name for name, _ in units)),
        units=(*plant.units, *(pair for pair in units if pair[1] != UNKNOWN)),
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
    return _differential(family, frozen(logarithms).tobytes())


@functools.lru_cache(maxsize=4)  # of a point it is asked for again and again
def _differential(family: PlantFamily, point: bytes) -> PlantDifferential:
    logarithms = np.frombuffer(point)
    parts: list[tuple[Array, ...]] = []
    bodies: list[tuple[tuple[float, Body], ...]] = []
    for index, name in enumerate(family.names):
        if family.stated[index]:  # to 1e-7, and nothing rests on more
            slopes, _ = _central(family, logarithms, index, _FINE_STEP)
            parts.append(slopes)
            bodies.append(())
            continue
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
    slopes = tuple((up - down) / (2 * step) for up, down in pairs)
    if above.body and below.body and above.body.constants is below.body.constants:
        return slopes, ()  # its linear part alone moves, as the matrices do
    return slopes, tuple((factor, body) for factor, body in ends if body is not None)
