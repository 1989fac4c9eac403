"""Simulate a controller from a state; name the bound that no input sequence keeps."""

from __future__ import annotations

import warnings
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from impc.checking import checked, replace
from impc.control.closed_loop import simulate
from impc.control.constraint_rows import build_rows, families
from impc.control.controller import Controller
from impc.control.simulation import Simulation, Status, scenario
from impc.errors import InfeasibleError, SolverError


@checked(steps=(1, 10_000_000))
def simulate_from(
    controller: Controller,
    x0: ArrayLike,
    steps: int | None = None,
    disturbance: ArrayLike | None = None,
    target: Mapping[str, ArrayLike] | None = None,
) -> Simulation:
    """Simulate the plant under this controller.

    Parameters
    ----------
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
    Simulation
        Trajectory with a status for each sample. Samples that are not reached, because no input
        satisfies the bounds or the loop diverges, are NaN, and a warning names the first of
        them; `require_complete` turns it into an error.

    Raises
    ------
    DataError
        If a value is not finite or of the wrong shape, or `steps` is missing.

    Examples
    --------
    >>> import control
    >>> import impc
    >>> plant = impc.Plant(control.ss([[0.5]], [[1]], [[1]], 0, 1))
    >>> law = impc.Controller(plant, impc.Weights(1, 1), impc.Bounds(plant, u_max=1), 3)
    >>> law.simulate([1.0], steps=4).x.shape
    (5, 1)
    """
    run = simulate(controller, scenario(controller.plant, x0, steps, disturbance, target))
    if run.complete:
        return run
    end = run.reached
    said, remedy = _failure(controller, run)
    hint = f" ({remedy})" if run.status[end] == Status.INFEASIBLE else ""
    warnings.warn(f"sample {end}: {said}{hint}; later samples are NaN", stacklevel=3)
    x, u = np.array(run.x), np.array(run.u)
    x[end + 1 :], u[end:] = np.nan, np.nan
    return replace(run, x=x, u=u)


def _failure(controller: Controller, run: Simulation) -> tuple[str, str]:
    """What ended a simulation, and the remedy."""
    status = Status(int(run.status[run.reached]))
    if status is not Status.INFEASIBLE:
        return status.sentence, "check the plant, the gain and the bounds"
    bound = "the bounds"
    remedy = "start nearer to the origin, lengthen the horizon, or soften the state bounds"
    if run.failed_row >= 0:
        rows = build_rows(controller)
        stage = int(rows.stage[run.failed_row])
        where = f"at sample {stage} of the horizon"
        if stage >= controller.horizon:
            where, remedy = f"in the terminal set, {where}", f"{remedy}, or set terminal_set=False"
        bound = f"the bound {families(controller).names[rows.family[run.failed_row]]} {where}"
    return f"no input sequence keeps {bound}", remedy


@checked
def require_complete(controller: Controller, simulation: Simulation) -> Simulation:
    """Return the simulation if every sample was reached, else raise an error.

    Parameters
    ----------
    controller : Controller
        Controller that was simulated.
    simulation : Simulation
        Result of `Controller.simulate`.

    Returns
    -------
    Simulation
        The given simulation.

    Raises
    ------
    InfeasibleError
        If no input satisfies the bounds at a sample; names the bound and the sample.
    SolverError
        If the loop diverged or the active-set method found no solution.

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
    sample, failure = simulation.reached, _failure(controller, simulation)
    if simulation.status[sample] == Status.INFEASIBLE:
        raise InfeasibleError("x0" if sample == 0 else f"sample {sample}", *failure)
    raise SolverError(f"sample {sample}", *failure)
