"""A plant under the constrained controller, simulated and differentiated in one pass.

At most samples v = 0 keeps every bound and the controller is the gain; only elsewhere a
least-distance problem is solved (docs/theory.md, section 4). There, with the active rows a
(multipliers lam) and one direction of change, written d,

    Gram_aa dlam = -N_a q + dM_a v - db_a + dT_a x + T_a dx,     q = dM'lam + dS v
    dv = -S^-1 q - N_a' dlam

follows from the stationarity S v + M'lam = 0 and the tight rows T_a x + M_a v = b_a. The derivative
is that of the active set at hand. At a sample where the active set is about to change (a row that
is tight without a multiplier) it is one-sided: the row counts as inactive there. Such samples are
counted in the result.

Where the plant offers a body that is not linear, that one moves and the controller still predicts
by A and B: x+ = f(x, u, d) and dx+ = f_x dx + f_u du + f_theta take the place of the linear
recursion (docs/nonlinear.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array
from impc.checking import checked
from impc.control.aims import aim_of
from impc.control.body_steps import body_tape, pushes
from impc.control.compiled_kernel import (
    LoopMatrices,
    answer_with,
    deviate,
    fill_slack,
    return_to,
    run,
    workspace,
)
from impc.control.constraint_rows import RowDirections, build_rows, differentiate_rows, directions
from impc.control.named_solver import (
    COMPILED,
    Program,
    active_set,
    build_program,
    excluded_row,
)
from impc.control.simulation import Sensitivity, Simulation, Status

if TYPE_CHECKING:
    from impc.control.compiled_kernel import Workspace
    from impc.control.constraint_rows import Directions, Rows
    from impc.control.controller import Controller
    from impc.control.simulation import Scenario

# Asked where the compiled method has no answer.
_SECOND = "daqp"


@dataclass(frozen=True)
class PreparedLoop:
    """A controller with its rows and derivatives built; made by `prepare_loop`."""

    controller: Controller
    along: Directions  # The p directions of the derivatives
    rows: Rows
    row_directions: RowDirections  # Derivatives of the rows
    matrices: LoopMatrices  # Plant, gain and inverse metric
    matrix_directions: LoopMatrices  # Derivatives of plant, gain and metric
    unit: Array  # The nearer bound of each input (m,): what its error is measured by
    program: Program | None  # For the controller's solver, where that is one of CasADi's


@checked
def simulate(controller: Controller, given: Scenario) -> Simulation:
    """Simulate the plant of the controller; never raises for what happens on the way."""
    simulation, _ = run_loop(prepare_loop(controller, directions(controller, 0)), given)
    return simulation


@checked
def simulate_and_differentiate(
    controller: Controller, given: Scenario, along: Directions
) -> tuple[Simulation, Sensitivity]:
    """Simulate and differentiate in one pass; see `simulate` and the module's text.

    Examples
    --------
    How the trajectory moves with the initial state: one direction for each of its entries.

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
    controller: Controller, along: Directions, moves: tuple[Array, Array, Array] | None = None
) -> PreparedLoop:
    """Build all that does not depend on the recording, so that several trials share it.

    `moves` are A (n, n), B (n, m) and E (n, d) of what moves in place of the plant; the controller
    predicts by its own.
    """
    plant = controller.plant
    A, B, E = (plant.A, plant.B, plant.E) if moves is None else moves
    rows = build_rows(controller)
    moved = differentiate_rows(controller, along) if along.count else _no_directions(rows)
    inverse = np.asarray(np.linalg.inv(controller.S), dtype=np.float64)
    return PreparedLoop(
        controller,
        along,
        rows,
        moved,
        _writable(A, B, E, controller.K, inverse),
        _writable(along.A, along.B, along.E, along.K, along.S),
        np.minimum(-controller.bounds.u_min, controller.bounds.u_max),
        None if controller.solver == COMPILED else build_program(controller.solver, rows),
    )


def run_loop(
    prepared: PreparedLoop, given: Scenario, *, local: bool = False, proved: bool = True
) -> tuple[Simulation, Sensitivity]:
    """Simulate one recording of a prepared loop, with its derivatives.

    Samples that were not reached repeat the last state, so that a search can go on with them. Where
    `local`, the state at every sample moves along the directions of the first, whatever the others
    did: `Sensitivity.u` then has the derivatives of the controller at each sample by itself. With
    `proved` false the first sample that the rows do not solve ends the simulation: a search then
    steps back.
    """
    plant, along = prepared.controller.plant, prepared.along
    steps, n, m, p = given.steps, plant.n, plant.m, along.count
    x, u = np.zeros((steps + 1, n)), np.zeros((steps, m))
    dx, du = np.zeros((steps + 1, n, p)), np.zeros((steps, m, p))
    status = np.full(steps, Status.NOT_REACHED, dtype=np.int8)
    x[0], dx[0] = given.x0, along.x0
    multipliers = np.zeros(len(prepared.rows.b))
    program, asked = prepared.program, prepared.program is not None
    aim = aim_of(prepared.controller, given, along)
    work = workspace(prepared.rows, prepared.row_directions, m)
    loop = (
        *(prepared.matrices, prepared.matrix_directions, prepared.rows, prepared.row_directions),
        body_tape(plant.body, n, n + m + given.disturbance.shape[1], moving=p > 0),
        _pushes(prepared, given),
        *(np.array(given.disturbance), aim, _divergence(prepared.matrices.E, given)),
        *(prepared.unit, work),
    )
    written = (x, u, dx, du, status, multipliers)
    t, weakly_active = 0, 0
    while True:
        weak, failed_row = run(*loop, t, *written, asked, local)
        weakly_active += weak
        t = int(np.count_nonzero(status <= Status.SOFTENED))
        if t == steps or status[t] == Status.DIVERGED or not (asked or proved):
            break
        if program is None:  # a second opinion on a sample that the compiled method does not solve
            program = build_program(_SECOND, prepared.rows)
        away, daway = x[t].copy(), dx[t].copy()
        deviate(aim, prepared.rows, prepared.row_directions, work, t, away, daway)
        status[t], weak, row = _ask_solver(prepared, program, work, away, daway, u[t], du[t])
        return_to(aim, t, u[t], du[t])
        weakly_active += weak
        if status[t] > Status.SOFTENED:
            failed_row = failed_row if row >= 0 and failed_row >= 0 else row
            break
    return Simulation(plant, x, u, status, weakly_active, failed_row), Sensitivity(dx, du)


def _pushes(prepared: PreparedLoop, given: Scenario) -> Array:
    """What parameters in the body add to the derivatives, along the trajectory."""
    controller, along = prepared.controller, prepared.along
    moving = any(along.bodies) or np.any(along.A) or np.any(along.B) or np.any(along.E)
    if controller.plant.body is None or not moving:
        return np.zeros((0, controller.plant.n, along.count))
    run, _ = run_loop(prepare_loop(controller, directions(controller, 0)), given)
    return pushes(along, run.x[:-1], run.u, given.disturbance)


def _ask_solver(
    prepared: PreparedLoop,
    program: Program,
    work: Workspace,
    x: Array,
    dx: Array,
    u: Array,
    du: Array,
) -> tuple[Status, bool, int]:
    """Write the input of one deviation, and its derivative, that the controller's solver finds."""
    controller, rows = prepared.controller, prepared.rows
    fill_slack(work, x)
    slack = work.slack.copy()
    found = active_set(program, slack)
    if found is not None:
        status, weak = answer_with(
            prepared.matrices,
            prepared.matrix_directions,
            rows,
            prepared.row_directions,
            prepared.unit,
            work,
            found.tight,
            found.given_up,
            x,
            dx,
            u,
            du,
            np.empty(len(rows.b)),
        )
        w = (work.v.reshape(-1, 1, len(u)) @ np.linalg.cholesky(controller.metrics)).ravel()
        if status <= Status.SOFTENED and np.max(np.abs(w - found.w)) <= found.agrees:
            return Status(status), weak, -1
    row = excluded_row(rows, slack)
    return Status.INFEASIBLE if row >= 0 else Status.UNSOLVED, False, row


def _writable(*matrices: Array) -> LoopMatrices:
    """Copies, because read-only arrays are another type to numba and would be compiled again."""
    return LoopMatrices(*(np.array(matrix, order="C") for matrix in matrices))


def _no_directions(rows: Rows) -> RowDirections:
    return RowDirections(
        np.zeros((*rows.T.shape, 0)), np.zeros((*rows.M.shape, 0)), np.zeros((len(rows.b), 0))
    )


def _divergence(E: Array, given: Scenario) -> float:
    """State norm that ends a simulation: a million times what drives it, and at least that."""
    pushes = E @ given.disturbance.T
    return 1e6 * max(1.0, float(np.max(np.abs(given.x0))), float(np.max(np.abs(pushes), initial=0)))
