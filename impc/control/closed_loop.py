"""Simulate and differentiate a plant under the constrained controller in one pass.

At most samples v = 0 satisfies all bounds and the controller is the gain; elsewhere a
least-distance problem is solved (docs/why/theory.md, section 4). There, with the active rows a
(multipliers lam) and one direction of change, written d,

    Gram_aa dlam = -N_a q + dM_a v - db_a + dT_a x + T_a dx,     q = dM'lam + dS v
    dv = -S^-1 q - N_a' dlam

follows from the stationarity S v + M'lam = 0 and the tight rows T_a x + M_a v = b_a. The derivative
is that of the current active set. Where the active set is about to change (a tight row without
multiplier) it is one-sided: the row counts as inactive; the result counts such samples.

A nonlinear body replaces the linear recursion by x+ = f(x, u, d), dx+ = f_x dx + f_u du + f_theta,
while the controller predicts with A and B (docs/howto/nonlinear.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from impc.arrays import Array
from impc.checking import checked, replace
from impc.control.aims import aim_of
from impc.control.body_steps import body_tape, pushes
from impc.control.compiled_loop import run
from impc.control.compiled_values import (
    TOO_SHORT,
    Aim,
    BodyTape,
    LoopMatrices,
    RowDirections,
    Rows,
    Trace,
    workspace,
)
from impc.control.constraint_rows import Directions, build_rows, differentiate_rows, directions
from impc.control.controller import Controller
from impc.control.named_solver import (
    COMPILED,
    ActiveSet,
    Program,
    active_set,
    build_program,
    excluded_row,
)
from impc.control.simulation import Scenario, Sensitivity, Simulation, Status

# Longest horizon whose problem is solved as a whole at once, and number of its first stages with
# which a longer one begins.
_WHOLE, _STAGES = 100, 50
# Solver that is tried where the compiled method finds no solution.
_SECOND = "daqp"
_Drive: TypeAlias = "tuple[BodyTape, Array, Array, Array, Aim, float]"


@dataclass(frozen=True)
class PreparedLoop:
    """A controller with its rows and derivatives; made by `prepare_loop`."""

    controller: Controller
    along: Directions  # the p directions of the derivatives
    rows: Rows
    row_directions: RowDirections  # derivatives of the rows
    matrices: LoopMatrices  # plant, gain and inverse metric
    matrix_directions: LoopMatrices  # derivatives of plant, gain and metric
    unit: Array  # (m,), nearer bound of each input, the scale of its error
    program: Program | None  # for a CasADi solver
    stages: int  # number of stages of the problem, all or the first ones


@checked
def simulate(controller: Controller, given: Scenario) -> Simulation:
    """Simulate the closed loop; failures are reported by `Simulation.status`, not raised."""
    simulation, _ = run_loop(prepare_loop(controller, directions(controller, 0)), given)
    return simulation


@checked
def simulate_and_differentiate(
    controller: Controller, given: Scenario, along: Directions
) -> tuple[Simulation, Sensitivity]:
    """Simulate the closed loop and its derivatives in one pass.

    Parameters
    ----------
    controller : Controller
        Controller with its plant.
    given : Scenario
        Initial state, disturbance and targets, see `impc.scenario`.
    along : Directions
        The p directions of the derivatives, see `impc.directions`.

    Returns
    -------
    Simulation
        Trajectory and status of each sample.
    Sensitivity
        Derivatives of states and inputs along the directions.

    Examples
    --------
    Derivative of the trajectory with respect to the initial state, one direction per entry.

    >>> import impc
    >>> import numpy as np
    >>> from plants import yalmip_example
    >>> plant = impc.Plant(yalmip_example())
    >>> bounds = impc.Bounds(plant, u_min=-1, u_max=1)
    >>> law = impc.Controller(plant, impc.Weights([[1, 0], [0, 1]], 1), bounds, horizon=3)
    >>> along = impc.directions(law, 2, x0=np.eye(2))
    >>> run, moved = impc.simulate_and_differentiate(law, impc.scenario(plant, [1, 3], 20), along)
    >>> run.x.shape, moved.x.shape
    ((21, 2), (21, 2, 2))
    """
    return run_loop(prepare_loop(controller, along), given)


def prepare_loop(
    controller: Controller,
    along: Directions,
    moves: tuple[Array, Array, Array] | None = None,
    *,
    whole: bool = False,
) -> PreparedLoop:
    """Build everything that does not depend on the recording, so that trials share it.

    `moves`: A (n, n), B (n, m), E (n, d) of the simulated plant, if it differs from the one with
    which the controller predicts. `whole`: the problem has all stages, however many.
    """
    plant = controller.plant
    A, B, E = (plant.A, plant.B, plant.E) if moves is None else moves
    whole = whole or controller.stages is not None
    stages = controller.horizon if whole else first_stages(controller.horizon, controller.solver)
    rows, moved = _rows(controller, along, stages)
    inverse = np.asarray(np.linalg.inv(controller.S), dtype=np.float64)
    plant_moves = along.A, along.B, along.E
    if any(along.bodies):  # then `pushes` has all that moves the next state
        plant_moves = np.zeros_like(along.A), np.zeros_like(along.B), np.zeros_like(along.E)
    return PreparedLoop(
        controller,
        along,
        rows,
        moved,
        _writable(A, B, E, controller.K, inverse),
        _writable(*plant_moves, along.K, along.S),
        np.minimum(-controller.bounds.u_min, controller.bounds.u_max),
        None if controller.solver == COMPILED else build_program(controller.solver, rows),
        stages,
    )


def first_stages(horizon: int, solver: str) -> int:
    """Number of stages of the problem with which a simulation begins."""
    return _STAGES if horizon > _WHOLE and solver == COMPILED else horizon


def _rows(controller: Controller, along: Directions, stages: int) -> tuple[Rows, RowDirections]:
    rows = build_rows(controller, stages)
    if along.count:
        return rows, differentiate_rows(controller, along, stages)
    h, width = rows.N.shape
    none = np.zeros((h, rows.T.shape[1], 0)), np.zeros((h, width, 0)), np.zeros((h, 0))
    return rows, RowDirections(*none)


def _with_stages(prepared: PreparedLoop, stages: int) -> PreparedLoop:
    """The same loop, with more stages in the problem."""
    stages = min(stages, prepared.controller.horizon)
    rows, moved = _rows(prepared.controller, prepared.along, stages)
    return replace(prepared, rows=rows, row_directions=moved, stages=stages)


def run_loop(
    prepared: PreparedLoop,
    given: Scenario,
    *,
    local: bool = False,
    proved: bool = True,
    seen: Array | None = None,
    inputs: bool = True,
    pushed: Array | None = None,
) -> tuple[Simulation, Sensitivity]:
    """Simulate one recording of a prepared loop, with its derivatives.

    Samples that are not reached repeat the last state, so that a search can continue. With `local`
    the state at every sample has the directions of the first one: `Sensitivity.u` then holds the
    derivatives of the controller at each sample separately. Without `proved` the simulation ends at
    the first unsolved sample, without a proof of infeasibility. With `seen` (q, n), which saves
    memory, `Sensitivity.x` has the derivatives of seen x, (steps + 1, q, p), in place of those of
    all states; without `inputs` those of the inputs are not kept. `pushed` (steps, d, q) are the
    derivatives of the disturbance along the last q directions.
    """
    plant, along = prepared.controller.plant, prepared.along
    steps, n, m, p = given.steps, plant.n, plant.m, along.count
    x, u = np.zeros((steps + 1, n)), np.zeros((steps, m))
    dx = np.zeros((steps + 1 if seen is None else 2, n, p))
    du = np.zeros((steps if inputs else 1, m, p))
    observed = np.zeros((0, n)) if seen is None else np.array(seen, order="C")
    dy = np.zeros((steps + 1, len(observed), p))
    status = np.full(steps, Status.NOT_REACHED, dtype=np.int8)
    x[0], dx[0] = given.x0, along.x0
    program, asked = prepared.program, prepared.program is not None
    drive = _drive(prepared, given, pushed)
    t, weakly_active, work = 0, 0, None
    while True:
        rows, moved = prepared.rows, prepared.row_directions
        work = workspace(rows, moved, m) if work is None else work
        loop = (prepared.matrices, prepared.matrix_directions, rows, moved, *drive)
        trace = Trace(x, u, dx, du, observed, dy, status, np.zeros(len(rows.limit)))
        weak, failed_row = run(*loop, prepared.unit, work, t, trace, asked, local)
        weakly_active += weak
        t = int(np.count_nonzero(status <= Status.SOFTENED))
        longer = t < steps and status[t] == TOO_SHORT
        if t == steps or status[t] == Status.DIVERGED or not (asked or proved or longer):
            break
        if longer or prepared.stages < prepared.controller.horizon:
            stages = 2 * prepared.stages if longer else prepared.controller.horizon
            prepared, work = _with_stages(prepared, stages), None
            status[t] = Status.NOT_REACHED
            continue
        if program is None:  # second solver for a sample that the compiled method did not solve
            program = build_program(_SECOND, rows)
        found = active_set(program, work.slack.copy())
        if found is not None:
            asking = work._replace(tight=found.tight, given_up=found.given_up)
            weak, _ = run(*loop, prepared.unit, asking, t, trace, False, local)
            if _agrees(prepared.controller, status[t], work.v, found):
                weakly_active += weak
                status[t] = min(status[t], Status.SOFTENED)  # the next pass finds what diverged
                continue
        row = excluded_row(rows, work.slack)
        status[t] = Status.INFEASIBLE if row >= 0 else Status.UNSOLVED
        failed_row = failed_row if row >= 0 and failed_row >= 0 else row
        break
    x[t + 1 :] = x[t]  # unless all samples are reached
    if seen is None:
        dx[t + 1 :] = 0.0
    moves = Sensitivity(dx if seen is None else dy, du)
    return Simulation(plant, x, u, status, weakly_active, failed_row), moves


def _drive(prepared: PreparedLoop, given: Scenario, pushed: Array | None) -> _Drive:
    """Arguments of `run`; the last, 1e6 times the excitation, is the norm that ends it."""
    plant, d, E = prepared.controller.plant, np.array(given.disturbance), prepared.matrices.E
    width, largest = plant.n + plant.m + d.shape[1], float(np.max(np.abs(E @ d.T), initial=0))
    return (
        body_tape(plant.body, plant.n, width, moving=prepared.along.count > 0),
        _pushes(prepared, given),
        d,
        np.zeros((given.steps, 0, 0)) if pushed is None else np.array(pushed, order="C"),
        aim_of(prepared.controller, given, prepared.along),
        1e6 * max(1.0, float(np.max(np.abs(given.x0))), largest),
    )


def _pushes(prepared: PreparedLoop, given: Scenario) -> Array:
    """Contribution of nearby bodies to the derivatives along the trajectory."""
    controller, along = prepared.controller, prepared.along
    if not any(along.bodies):
        return np.zeros((0, controller.plant.n, along.count))
    run, _ = run_loop(prepare_loop(controller, directions(controller, 0)), given)
    return pushes(along, run.x[:-1], run.u, given.disturbance)


def _agrees(controller: Controller, status: int, v: Array, found: ActiveSet) -> bool:
    """Whether the solution `v` of an active set is that of the solver that found it."""
    if status > Status.SOFTENED and status != Status.DIVERGED:
        return False
    w = (v.reshape(-1, 1, controller.plant.m) @ np.linalg.cholesky(controller.metrics)).ravel()
    return bool(np.max(np.abs(w - found.w)) <= found.agrees)


def _writable(*matrices: Array) -> LoopMatrices:
    """Writable copies: for numba read-only arrays are another type and would be recompiled."""
    return LoopMatrices(*(np.array(matrix, order="C") for matrix in matrices))
