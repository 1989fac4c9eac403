"""Scenarios, simulations and their status, sample by sample.

A simulation never raises because of its course: it has a `Status` for each sample, and
`feasibility.require_complete` turns a failure into an error that names bound and sample.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from impc.arrays import Array, Frozen, as_numbers, finite_array, frozen
from impc.checking import Value, checked
from impc.control import compiled_values
from impc.errors import DataError
from impc.model.foresight import physical_disturbances, with_steps
from impc.model.plant import Plant
from impc.model.targets import reference

if TYPE_CHECKING:
    import pandas as pd


class Status(IntEnum):
    """Result at a sample.

    FREE: the gain satisfies all bounds. ACTIVE: a bound is active. SOFTENED: a soft bound is
    exceeded. INFEASIBLE: no input sequence satisfies the bounds. UNSOLVED: the input, or its
    existence, cannot be determined in double precision. DIVERGED: the state diverged. NOT_REACHED:
    the simulation ended before.

    Examples
    --------
    >>> import impc
    >>> impc.Status.ACTIVE.sentence
    'a bound is active'
    """

    FREE = compiled_values.FREE
    ACTIVE = compiled_values.ACTIVE
    SOFTENED = compiled_values.SOFTENED
    INFEASIBLE = compiled_values.INFEASIBLE
    UNSOLVED = compiled_values.UNSOLVED
    DIVERGED = compiled_values.DIVERGED
    NOT_REACHED = 6

    @property
    def sentence(self) -> str:
        """Description of the status."""
        return _SENTENCES[self]


_SENTENCES = {
    Status.FREE: "the gain keeps every bound",
    Status.ACTIVE: "a bound is active",
    Status.SOFTENED: "a soft bound was exceeded",
    Status.INFEASIBLE: "no input sequence keeps the bounds",
    Status.UNSOLVED: "the input cannot be determined in double precision",
    Status.DIVERGED: "the state diverged",
    Status.NOT_REACHED: "the simulation ended before this sample",
}


@dataclass(frozen=True)
class Scenario(Value):
    """Initial state, disturbance and targets of a simulation, in the units of the plant.

    Attributes
    ----------
    x0 : ndarray of shape (n,)
        Initial state.
    disturbance : ndarray of shape (steps, d)
        One row per sample.
    target : ndarray of shape (steps + 1, q)
        Targets of `signals`, one row per sample; if shorter, the last row continues.
    signals : tuple of str
        Outputs or states with a target, length q.
    """

    _rules: ClassVar[Mapping[str, Any]] = {"x0": "n", "disturbance": "* d", "target": "* q"}

    x0: Array
    disturbance: Array
    target: Array = field(default_factory=lambda: frozen(np.zeros((0, 0))))
    signals: tuple[str, ...] = ()

    @property
    def steps(self) -> int:
        """Number of samples at which an input is applied."""
        return len(self.disturbance)


@dataclass(frozen=True)
class Simulation(Frozen):
    """Trajectory of a closed loop.

    Attributes
    ----------
    plant : Plant
        Simulated plant.
    x : ndarray of shape (steps + 1, n)
        States. At samples that are not reached NaN (inside a search the last state).
    u : ndarray of shape (steps, m)
        Inputs; NaN, or zero, at samples that are not reached.
    status : ndarray of shape (steps,)
        `Status` of each sample.
    weakly_active : int
        Number of samples at which the active set is about to change, to 1e-8 of the bound.
    failed_row : int
        Row of `Rows` that proved the last problem infeasible, or -1.

    Examples
    --------
    >>> import impc
    >>> from plants import yalmip_example
    >>> plant = impc.Plant(yalmip_example())
    >>> bounds = impc.Bounds(plant, u_min=-1, u_max=1)
    >>> truth = impc.Controller(plant, impc.Weights([[1, 0], [0, 1]], 1), bounds, horizon=3)
    >>> run = truth.simulate([1, 3], steps=20)
    >>> run.x.shape, run.u.shape, run.complete
    ((21, 2), (20, 1), True)
    >>> run.statuses[0], run.frame().columns.tolist()
    (<Status.ACTIVE: 1>, ['time', 'x1', 'x2', 'u'])
    """

    plant: Plant
    x: Array
    u: Array
    status: np.ndarray[tuple[int], np.dtype[np.int8]]
    weakly_active: int
    failed_row: int

    @property
    def time(self) -> Array:
        """Time of every state in s (steps + 1,)."""
        return np.asarray(self.plant.dt * np.arange(len(self.x)), dtype=np.float64)

    @property
    def states(self) -> Array:
        """States x (steps + 1, n)."""
        return self.x

    @property
    def outputs(self) -> Array:
        """Outputs y = C x (steps + 1, p)."""
        return np.asarray(self.x @ self.plant.C.T)

    @property
    def inputs(self) -> Array:
        """Inputs u (steps, m)."""
        return self.u

    @property
    def statuses(self) -> tuple[Status, ...]:
        """Status of every sample."""
        return tuple(Status(int(code)) for code in self.status)

    def frame(self) -> pd.DataFrame:
        """Return time, states, outputs and inputs as named columns; the last input is NaN.

        `frame().attrs["units"]` contains the unit of each column.
        """
        import pandas as pd  # noqa: PLC0415  # takes a third of a second

        plant, last = self.plant, np.full((1, self.u.shape[1]), np.nan)
        columns = [self.time[:, None], self.x, self.outputs, np.vstack([self.u, last])]
        names = ["time", *plant.states, *plant.outputs, *plant.controls]
        found = pd.DataFrame(np.hstack(columns), columns=names)
        found = found.loc[:, ~found.columns.duplicated()]  # an output may be a state
        found.attrs["units"] = {
            name: "s" if name == "time" else plant.unit(name) for name in found.columns
        }
        return found

    @property
    def complete(self) -> bool:
        """Whether every sample was reached."""
        return bool(np.all(self.status <= Status.SOFTENED))

    @property
    def reached(self) -> int:
        """Number of samples with an input."""
        return int(np.count_nonzero(self.status <= Status.SOFTENED))

    @property
    def applied(self) -> Array:
        """Inputs of the samples that were reached (reached, m), in their units."""
        return self.u[: self.reached]


@dataclass(frozen=True)
class Sensitivity(Frozen):
    """Derivatives of a `Simulation` along p directions."""

    x: Array  # (steps + 1, n, p), of the states
    u: Array  # (steps, m, p), of the inputs


@checked(steps=(1, 10_000_000))
def scenario(
    plant: Plant,
    x0: ArrayLike,
    steps: int | None = None,
    disturbance: ArrayLike | None = None,
    target: Mapping[str, ArrayLike] | None = None,
) -> Scenario:
    """Return a checked scenario for a simulation.

    Parameters
    ----------
    plant : Plant
        Plant that is simulated.
    x0 : array_like
        Initial state (n,).
    steps : int, optional
        Number of samples; required without a disturbance, whose length is used otherwise.
    disturbance : array_like, optional
        Disturbance (steps, d), or (steps,) for a single one.
    target : mapping, optional
        Set points of outputs or states by name, in their units: a number, or (steps + 1,).

    Returns
    -------
    Scenario

    Raises
    ------
    DataError
        If a value is not finite or of the wrong shape, or `steps` is missing.

    Examples
    --------
    >>> import impc
    >>> from plants import yalmip_example
    >>> impc.scenario(impc.Plant(yalmip_example()), x0=[1, 3], steps=20).x0
    array([1., 3.])
    """
    count = physical_disturbances(plant)
    if disturbance is None:
        if steps is None:
            raise DataError("steps", "is missing, without a disturbance", "give at least 1")
        pushes: Array = np.zeros((steps, count))
    else:
        columns = as_numbers("disturbance", disturbance)
        pushes = finite_array(
            "disturbance", columns[:, None] if columns.ndim == 1 else columns, (steps, count)
        )
    values, names = reference(plant, target, len(pushes) + 1)
    start, pushes = with_steps(plant, x0, pushes, values, names)
    return Scenario(frozen(start), frozen(pushes), frozen(values), names)
