"""What drives a simulation and what comes of it, sample by sample.

A simulation never raises for what happens on the way: it has a `Status` for each sample, and
`require_complete` turns a failure into an error that names bound and sample. The loop itself is in
docs/theory.md, section 4.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from impc.arrays import Array, Frozen, as_numbers, finite_array, frozen
from impc.checking import Value, checked
from impc.control import compiled_kernel
from impc.control.constraint_rows import build_rows, families
from impc.errors import DataError, InfeasibleError, SolverError
from impc.model.foresight import physical_disturbances, with_steps
from impc.model.targets import reference

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pandas as pd
    from numpy.typing import ArrayLike

    from impc.control.controller import Controller
    from impc.model.plant import Plant


class Status(IntEnum):
    """What happened at a sample.

    FREE: the gain keeps every bound. ACTIVE: a bound is active. SOFTENED: a soft bound was
    exceeded. INFEASIBLE: no input sequence keeps the bounds. UNSOLVED: the input, or whether there
    is one, cannot be determined in double precision. DIVERGED: the state left every reasonable
    range. NOT_REACHED: the simulation ended before.

    Examples
    --------
    >>> import impc
    >>> impc.Status.ACTIVE.sentence
    'a bound is active'
    """

    FREE = compiled_kernel.FREE
    ACTIVE = compiled_kernel.ACTIVE
    SOFTENED = compiled_kernel.SOFTENED
    INFEASIBLE = compiled_kernel.INFEASIBLE
    UNSOLVED = compiled_kernel.UNSOLVED
    DIVERGED = compiled_kernel.DIVERGED
    NOT_REACHED = 6

    @property
    def sentence(self) -> str:
        """The status in words."""
        return _SENTENCES[self]


_SENTENCES = {
    Status.FREE: "the gain keeps every bound",
    Status.ACTIVE: "a bound is active",
    Status.SOFTENED: "a soft bound was exceeded",
    Status.INFEASIBLE: "no input sequence keeps the bounds",
    Status.UNSOLVED: "the input cannot be determined in double precision",
    Status.DIVERGED: "the state left every reasonable range",
    Status.NOT_REACHED: "the simulation ended before this sample",
}


@dataclass(frozen=True)
class Scenario(Value):
    """What drives a simulation, in the units of the plant.

    Attributes
    ----------
    x0 : Array
        Initial state (n,).
    disturbance : Array
        One row for each sample (steps, d).
    target : Array
        Targets of some signals, one row for each sample (steps + 1, q) or fewer: the last stays.
    signals : tuple of str
        Outputs or states that have one (q,).
    """

    _rules: ClassVar[Mapping[str, Any]] = {
        "x0": "n",
        "disturbance": "* d",
        "target": "* q",
    }

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
    """A closed loop from its first state to its last.

    Attributes
    ----------
    plant : Plant
    x : Array
        States (steps + 1, n). Of samples that were not reached NaN; in a search, which goes on
        with them, the last state.
    u : Array
        Inputs (steps, m); NaN, or zero, at samples that were not reached.
    status : Array of Status
        (steps,).
    weakly_active : int
        Number of samples at which the active set is about to change, to 1e-8 of the bound.
    failed_row : int
        Row of `Rows` that proved the last problem inconsistent, -1 when none did.

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
        """Of every state, s (steps + 1,)."""
        return np.asarray(self.plant.dt * np.arange(len(self.x)), dtype=np.float64)

    @property
    def states(self) -> Array:
        """x (steps + 1, n)."""
        return self.x

    @property
    def outputs(self) -> Array:
        """y = C x (steps + 1, p)."""
        return np.asarray(self.x @ self.plant.C.T)

    @property
    def inputs(self) -> Array:
        """u (steps, m)."""
        return self.u

    @property
    def statuses(self) -> tuple[Status, ...]:
        """What happened at every sample."""
        return tuple(Status(int(code)) for code in self.status)

    def frame(self) -> pd.DataFrame:
        """Time, states, outputs and inputs as columns with their names; the last input is NaN.

        `frame().attrs["units"]` has the unit of each column.
        """
        import pandas as pd  # noqa: PLC0415  # a third of a second

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
        """The inputs of the samples that were reached (reached, m), in their units."""
        return self.u[: self.reached]


@dataclass(frozen=True)
class Sensitivity(Frozen):
    """Derivatives of a `Simulation` along p directions."""

    x: Array  # Of the states (steps + 1, n, p)
    u: Array  # Of the inputs (steps, m, p)


@checked(steps=(1, 10_000_000))
def scenario(
    plant: Plant,
    x0: ArrayLike,
    steps: int | None = None,
    disturbance: ArrayLike | None = None,
    target: Mapping[str, Any] | None = None,
) -> Scenario:
    """Check and freeze an initial state with a number of steps or a disturbance.

    Parameters
    ----------
    x0 : array_like
        (n,).
    steps : int, optional
        Needed when there is no disturbance; otherwise its length is taken.
    disturbance : array_like, optional
        (steps, d), or (steps,) for a single disturbance.
    target : mapping, optional
        Set points of outputs or states by name, in their units: a number, or (steps + 1,).

    Raises
    ------
    DataError
        When something is not finite or of the wrong shape, or neither length is given.

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
            raise DataError("steps", "got None without a disturbance", "give at least 1")
        pushes: Array = np.zeros((steps, count))
    else:
        columns = as_numbers("disturbance", disturbance)
        pushes = finite_array(
            "disturbance", columns[:, None] if columns.ndim == 1 else columns, (steps, count)
        )
    values, names = reference(plant, target, len(pushes) + 1)
    start, pushes = with_steps(plant, x0, pushes, values, names)
    return Scenario(frozen(start), frozen(pushes), frozen(values), names)


def excluded_bound(controller: Controller, simulation: Simulation) -> tuple[str, str]:
    """The bound that an infeasible simulation could not keep, and what to do, in words."""
    remedy = "start nearer to the origin, lengthen the horizon, or soften the state bounds"
    row = simulation.failed_row
    if row < 0:
        return "the bounds", remedy
    rows = build_rows(controller)
    name = families(controller).names[rows.family[row]]
    stage = int(rows.stage[row])
    if stage < controller.horizon:
        return f"the bound {name} {stage} samples ahead", remedy
    return (
        f"the bound {name} in the terminal set, {stage} samples ahead",
        f"{remedy}, or leave the set out: terminal_set=False",
    )


@checked
def require_complete(controller: Controller, simulation: Simulation) -> Simulation:
    """Return the simulation when every sample was reached.

    Raises
    ------
    InfeasibleError
        When a sample has no input that keeps the bounds: names the bound and the sample.
    SolverError
        When the loop diverged or the active-set method found no answer.

    Examples
    --------
    >>> import warnings
    >>> import impc
    >>> from plants import yalmip_example
    >>> plant = impc.Plant(yalmip_example())
    >>> bounds = impc.Bounds(plant, u_min=-1, u_max=1)
    >>> law = impc.Controller(plant, impc.Weights([[1, 0], [0, 1]], 1), bounds, horizon=3)
    >>> impc.require_complete(law, law.simulate([1, 3], steps=20)).reached
    20
    >>> with warnings.catch_warnings(action="ignore"):
    ...     run = law.simulate([90, 3], steps=20)
    >>> impc.require_complete(law, run)
    Traceback (most recent call last):
        ...
    impc.errors.InfeasibleError: x0: no input sequence keeps the bound u <= 1 ...
    """
    if simulation.complete:
        return simulation
    sample = simulation.reached
    status = Status(int(simulation.status[sample]))
    if status is Status.INFEASIBLE:
        bound, remedy = excluded_bound(controller, simulation)
        where = "x0" if sample == 0 else f"sample {sample}"
        raise InfeasibleError(where, f"no input sequence keeps {bound}", remedy)
    raise SolverError(
        f"sample {sample}", status.sentence, "check the plant, the gain and the bounds"
    )
