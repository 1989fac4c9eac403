"""Families of plants that depend on uncertain physical parameters.

The parameters are positive (masses, lengths, stiffnesses, time constants); searches use the
logarithms of their ratios to the nominal values. The plant's matrices are analytic functions of
them. A plant can offer its derivatives (`slopes`). Others are Richardson extrapolations of central
differences with steps h and h/2 in the logarithm, with errors of order h^4 and rounding/h (both
1e-12 at h = 1e-3); the two differences also show whether the extrapolation can be trusted. See
docs/howto/fit.md.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from impc.arrays import Array, BoolArray, frozen
from impc.checking import Value, checked, replace
from impc.errors import InputError, PlantError
from impc.model.body import Body
from impc.model.bounds import Bounds
from impc.model.plant import UNKNOWN, Plant

_STEP, _FORWARD = 1e-3, 1e-7
#: Uncertainties that are not parameters of `make`.
DELAY, LIMIT = "extra_delay", "u_max"
# Scale of the logarithm of a free parameter.
_FREE = 1 / 3
# Largest delay in samples that one more state can represent.
_LONGEST = 2.0
# Largest relative difference of the two central differences; h^2 for a smooth plant.
_ROUGH = 1e-3


@dataclass(frozen=True, init=False, eq=False)  # compared by identity: its derivatives are cached
class PlantFamily(Value):
    """Plants for all values of some physical parameters, which are fitted with the gain.

    Parameters
    ----------
    make : callable
        Function of parameter values (k,) that returns the plant.
    names : sequence of str
        Names of the parameters, length k.
    nominal : sequence of float
        Nominal values of the parameters, positive, in their units.
    uncertainty : mapping of str to float or str, optional
        Prior standard deviation of a parameter by name, in its unit or relative as "5 %". A fit
        keeps such a parameter near its nominal value, and all intervals include its uncertainty. A
        parameter without one is free. Two more names are allowed: "extra_delay", an additional
        delay of the commands in s (at most two samples), and "u_max", the limits of the controls.
    slopes : callable, optional
        Function of parameter values (k,) that returns, by name, the derivatives of A (n, n), B
        (n, m) and E (n, d) by a parameter; C and the nonlinear part of a body must not depend on
        it. Others are found by differences.

    Attributes
    ----------
    make : callable
        Function of parameter values (k,) that returns the `Plant`.
    names : tuple of str
        Names of the parameters, length k.
    nominal : ndarray of shape (k,)
        Nominal values.
    deviations : ndarray of shape (k,)
        Prior standard deviation of the logarithm of each parameter; infinite if it is free.
    limit_deviation : float
        Prior standard deviation of the logarithm of the control limits; 0 if they are known.
    slopes : callable
        Function of parameter values (k,): the derivatives that are known.

    Raises
    ------
    InputError
        If a nominal value is not positive, or an uncertainty names no parameter or is not a
        standard deviation.

    Examples
    --------
    A mass (kg) that is pushed for 1 s at a time, known to 4 kg.

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
    slopes: Callable[[Array], Mapping[str, Sequence[Array]]]

    @checked
    def __init__(
        self,
        make: Callable[[Array], Plant],
        names: Sequence[str],
        nominal: Sequence[float],
        uncertainty: Mapping[str, float | str] | None = None,
        slopes: Callable[[Array], Mapping[str, Sequence[Array]]] = lambda _: {},
    ) -> None:
        if len(names) != len(nominal):
            raise InputError(
                "nominal", f"has {len(nominal)} values", f"give {len(names)}, one for each name"
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
            raise InputError(f"uncertainty {unknown[0]}", "is no parameter", f"known: {known}")
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
            slopes=slopes,
        )
        if 0.0 in found:  # zero uncertainty: fixed
            uncertain = np.array(found) > 0
            self._fill(**vars(self.part(uncertain, np.zeros(len(found)))))
        if relative_deviation(DELAY, late, 1.0) > 0:
            dt = self.make(self.nominal).dt
            self._fill(**vars(self.with_delay(relative_deviation(DELAY, late, dt), dt)))

    @property
    def stated(self) -> BoolArray:
        """Mask (k,) of the parameters with a prior; the others are free."""
        return np.isfinite(self.deviations)

    @property
    def unit(self) -> Array:
        """Scale (k,) of each search coordinate in units of the logarithm."""
        return np.where(self.stated, self.deviations, _FREE)

    @checked(logarithms="names")
    def values(self, logarithms: Array) -> Array:
        """Parameter values (k,) at the logarithms (k,) of their ratios to the nominal ones."""
        begins = self.make(self.nominal).dt if DELAY in self.names else 0.0
        late = np.array([name == DELAY for name in self.names], float)
        return np.asarray(self.nominal * np.exp(logarithms) - begins * late)

    def linear(self) -> PlantFamily:
        """Return the same family without nonlinear bodies."""
        return replace(self, make=lambda values: self.make(values).linear())

    @checked(chosen="names", logarithms="names")
    def part(self, chosen: BoolArray, logarithms: Array) -> PlantFamily:
        """Family of the `chosen` parameters (k,) only; the others fixed at `logarithms` (k,)."""
        whole, made, known = self.nominal * np.exp(logarithms), self.make, self.slopes

        def among(values: Array) -> Array:
            moved = np.array(whole)
            moved[chosen] = values
            return moved

        return replace(
            self,
            make=lambda values: made(among(values)),
            slopes=lambda values: known(among(values)),
            names=tuple(np.array(self.names)[chosen].tolist()),
            nominal=frozen(self.nominal[chosen]),
            deviations=frozen(self.deviations[chosen]),
        )

    @checked
    def wider(
        self,
        names: Sequence[str],
        nominal: Sequence[float],
        deviations: Sequence[float],
        change: Callable[[Plant, Array], Plant] | None = None,
    ) -> PlantFamily:
        """Return the family with more parameters; `change` maps plant and their values (more,)."""
        count, made, known = len(self.names), self.make, self.slopes

        def make(values: Array) -> Plant:
            plant = made(values[:count])
            return plant if change is None else change(plant, values[count:])

        return replace(
            self,
            make=make,
            slopes=lambda values: known(values[:count]) if change is None else {},
            names=(*self.names, *names),
            nominal=frozen([*self.nominal, *nominal]),
            deviations=frozen([*self.deviations, *deviations]),
        )

    @checked(deviation=0, dt=1e-12)
    def with_delay(self, deviation: float, dt: float) -> PlantFamily:
        """Extend by a delay of the commands with a prior of `deviation` samples of `dt` s."""
        if deviation > _LONGEST:
            remedy = "model the delay in the plant"
            raise InputError(f"uncertainty {DELAY}", f"is more than {_LONGEST:g} samples", remedy)
        # Counted from one sample on, so that its logarithm is finite at zero delay.
        return self.wider(
            [DELAY],
            [dt],
            [deviation],
            lambda plant, late: with_late_commands(plant, late[0] / dt - 1),
        )

    @checked
    def with_limits(self, plant: Plant, bounds: Bounds) -> PlantFamily:
        """Extend by the limits of the controls as parameters, if they are uncertain."""
        bounded = np.flatnonzero(np.isfinite(bounds.u_max))
        if self.limit_deviation == 0 or len(bounded) == 0:
            return self
        if np.any(bounds.u_max != -bounds.u_min) or plant.commands:
            remedy = "remove it from the uncertainty"
            raise InputError(f"uncertainty {LIMIT}", "needs u_min = -u_max", remedy)
        names = [f"{LIMIT}.{plant.controls[place]}" for place in bounded]
        limits, known = np.array(bounds.u_max)[bounded], [self.limit_deviation] * len(bounded)
        return replace(self.wider(names, limits.tolist(), known), limit_deviation=0.0)

    @checked
    def limits(self, plant: Plant) -> list[tuple[int, int]]:
        """Pairs (index of the parameter, index of the control) of the limits."""
        named = {f"{LIMIT}.{control}": place for place, control in enumerate(plant.controls)}
        return [(k, named[name]) for k, name in enumerate(self.names) if name in named]

    @checked(logarithms="names")
    def bounds_at(self, plant: Plant, bounds: Bounds, logarithms: Array) -> Bounds:
        """Bounds with the limits at these `logarithms` (k,)."""
        found = self.limits(plant)
        u_max = np.array(bounds.u_max)
        for place, control in found:
            u_max[control] = self.nominal[place] * np.exp(logarithms[place])
        return replace(bounds, u_min=frozen(-u_max), u_max=frozen(u_max)) if found else bounds


def relative_deviation(name: str, given: float | str, nominal: float | None) -> float:
    """Standard deviation of a logarithm from "5 %" or from a number in units of `nominal`."""
    where, share = f"uncertainty {name}", isinstance(given, str) and given.strip().endswith("%")
    try:
        number = float(str(given).strip().removesuffix("%"))
    except ValueError:
        number = -1.0
    if not 0 <= number < np.inf:
        raise InputError(where, f"got {given!r}", 'give a standard deviation, or "5 %"')
    if not share and number and nominal is None:
        raise InputError(where, f"got {given!r}", 'give a percentage of the limit, as "5 %"')
    return number / 100 if share else number / (nominal or 1.0)


def with_late_commands(plant: Plant, lag: float) -> Plant:
    """Delay the commands by `lag` samples; each sample mixes the last and the new command."""
    if plant.body is not None:
        raise PlantError(
            "plant.body", "excludes a delay of commands", "model the delay in the body"
        )
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
    """Derivatives with respect to the logarithms of the parameters (last axis)."""

    A: Array  # (n, n, k)
    B: Array  # (n, m, k)
    E: Array  # (n, d, k)
    C: Array  # (p, n, k)
    observer: Array  # (d, k), of the observer rates
    # for each parameter, nearby bodies with factors: their weighted sum is the derivative of the
    # body; empty for a linear plant
    bodies: tuple[tuple[tuple[float, Body], ...], ...]


def plant_at(family: PlantFamily, logarithms: Array) -> Plant:
    """Plant at nominal * exp(logarithms), logarithms (k,)."""
    return _plant(family, frozen(logarithms).tobytes())


@functools.lru_cache(maxsize=4)  # the same point is requested repeatedly
def _plant(family: PlantFamily, point: bytes) -> Plant:
    return family.make(family.nominal * np.exp(np.frombuffer(point)))


def plant_differential(family: PlantFamily, logarithms: Array) -> PlantDifferential:
    """Derivatives of the plant's matrices with respect to the logarithms of its parameters."""
    return _differential(family, frozen(logarithms).tobytes())


@functools.lru_cache(maxsize=4)
def _differential(family: PlantFamily, point: bytes) -> PlantDifferential:
    logarithms = np.frombuffer(point)
    parts: list[tuple[Array, ...]] = []
    bodies: list[tuple[tuple[float, Body], ...]] = []
    here, values = plant_at(family, logarithms), family.nominal * np.exp(logarithms)
    known = family.slopes(values)
    for index, name in enumerate(family.names):
        if name in known:
            slopes = [values[index] * np.asarray(part) for part in known[name]]
            parts.append((*slopes, np.zeros(here.C.shape), np.zeros(len(here.observer))))
            bodies.append(())
            continue
        if family.stated[index]:  # accurate to 1e-6, which suffices for the prior parameters
            parts.append(_forward(family, logarithms, index, here))
            bodies.append(())
            continue
        coarse, far = _central(family, logarithms, index, _STEP)
        fine, near = _central(family, logarithms, index, _STEP / 2)
        for one, other in zip(coarse, fine, strict=True):
            if np.max(np.abs(one - other), initial=0) > _ROUGH * np.max(np.abs(other), initial=0):
                raise PlantError(
                    f"parameter {name}",
                    "the plant is not a smooth function of it",
                    "remove it from the free parameters",
                )
        parts.append(tuple((4 * b - a) / 3 for a, b in zip(coarse, fine, strict=True)))
        shares = [(4 / 3 * factor, body) for factor, body in near]
        bodies.append((*shares, *((-factor / 3, body) for factor, body in far)))
    A, B, E, C, observer = (np.stack(group, axis=-1) for group in zip(*parts, strict=True))
    return PlantDifferential(A, B, E, C, observer, tuple(bodies))


def _forward(family: PlantFamily, logarithms: Array, index: int, here: Plant) -> tuple[Array, ...]:
    """Forward differences of the matrices from the plant at `logarithms`."""
    shift = np.zeros(len(family.names))
    shift[index] = _FORWARD
    above = plant_at(family, logarithms + shift)
    found = [(getattr(above, name) - getattr(here, name)) / _FORWARD for name in "ABEC"]
    rates = np.where(np.isinf(here.observer), 0.0, [above.observer, here.observer])
    return *found, (rates[0] - rates[1]) / _FORWARD


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
        return slopes, ()  # only its linear part changes, as the matrices do
    return slopes, tuple((factor, body) for factor, body in ends if body is not None)
