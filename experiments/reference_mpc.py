"""MPC with the quadratic program of `casadi_controller` solved from scratch at every sample.

This plain implementation is the reference for the fast one in `impc.control.closed_loop`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, finite_array
from impc.checking import checked
from impc.control.body_steps import next_state
from impc.control.casadi_controller import EXCEEDED, MpcSolver
from impc.control.controller import Controller
from impc.control.named_solver import excluded_row, silent
from impc.control.simulation import Simulation, Status
from impc.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from impc.control.simulation import Scenario


@dataclass(frozen=True)
class MpcStep:
    """Solution of one program."""

    u: Array  # (m,), input to apply; if the status is a failure, that of the plain gain
    plan: Array  # (N, m), planned inputs
    states: Array  # (N + 1, n), planned states
    # UNSOLVED: no plan found that satisfies the hard rows; INFEASIBLE: proved that there is none.
    # The solver's own claim is not used: on unstable plants IPOPT and qpOASES report feasible
    # programs as infeasible.
    status: Status
    excess: float  # largest violation of a hard row relative to its bound, recomputed
    failed_row: int  # row of `Rows` that is incompatible with the others, or -1


@checked(x="n")
def solve_mpc(mpc: MpcSolver, x: ArrayLike) -> MpcStep:
    """Solve the program at state `x` (n,)."""
    controller, rows = mpc.controller, mpc.rows
    state = finite_array("x", x, (controller.plant.n,))
    width = rows.M.shape[1]
    with silent():  # the first call builds the solver
        answer = mpc.function(p=state, **mpc.limits)
    solved = bool(mpc.function.stats()["success"])
    decision = np.asarray(answer["x"]).ravel()
    v = decision[:width] if solved else np.zeros(width)
    excess = rows.T @ state + rows.M @ v - rows.b
    hard = excess[~mpc.soft] / rows.b[~mpc.soft]
    violation = float(np.max(hard, initial=0.0))
    status = _judge(excess[mpc.soft] / rows.b[mpc.soft], v)
    row = -1
    if not solved or violation > EXCEEDED:
        row = excluded_row(rows, rows.b - rows.T @ state)
        status = Status.INFEASIBLE if row >= 0 else Status.UNSOLVED
    plan, states = _unroll(controller, state, v)
    return MpcStep(plan[0], plan, states, status, violation, row)


@checked
def simulate_mpc(mpc: MpcSolver, given: Scenario) -> Simulation:
    """Simulate with a program at every sample; slow counterpart of `closed_loop.simulate`."""
    plant = mpc.controller.plant
    if given.signals or np.any(plant.observer):
        raise InputError("target", "is given, but is not supported here", "use impc.simulate")
    x, u = np.zeros((given.steps + 1, plant.n)), np.zeros((given.steps, plant.m))
    status = np.full(given.steps, Status.NOT_REACHED, dtype=np.int8)
    x[0], failed_row = given.x0, -1
    for t in range(given.steps):
        step = solve_mpc(mpc, x[t])
        status[t] = step.status
        if step.status > Status.SOFTENED:
            x[t + 1 :], failed_row = x[t], step.failed_row
            break
        u[t] = step.u
        x[t + 1] = next_state(plant, x[t], u[t], given.disturbance[t])
    return Simulation(plant, x, u, status, 0, failed_row)


def _judge(soft_excess: Array, v: Array) -> Status:
    if np.max(soft_excess, initial=0.0) > EXCEEDED:
        return Status.SOFTENED
    return Status.ACTIVE if np.max(np.abs(v), initial=0.0) > 1e-8 else Status.FREE


def _unroll(controller: Controller, x: Array, v: Array) -> tuple[Array, Array]:
    plant, horizon = controller.plant, controller.horizon
    moves = v.reshape(horizon, plant.m)
    plan, states = np.zeros((horizon, plant.m)), np.zeros((horizon + 1, plant.n))
    states[0] = x
    for k in range(horizon):
        plan[k] = moves[k] - controller.gains[k] @ states[k]
        states[k + 1] = plant.A @ states[k] + plant.B @ plan[k]
    return plan, states
