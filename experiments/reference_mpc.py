"""MPC with the quadratic program of `casadi_controller` solved from scratch at every sample.

This plain implementation is the reference for the fast one in `impc.control.closed_loop`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from impc.arrays import Array
from impc.control.body_steps import next_state
from impc.control.casadi_controller import EXCEEDED, MpcSolver
from impc.control.controller import Controller
from impc.control.named_solver import excluded_row, silent
from impc.control.simulation import Scenario, Simulation, Status


@dataclass(frozen=True)
class MpcStep:
    """Solution of one program."""

    plan: Array  # (N, m), planned inputs; if the status is a failure, those of the plain gain
    states: Array  # (N + 1, n), planned states
    # UNSOLVED: no plan found that satisfies the hard rows; INFEASIBLE: proved that there is none.
    # The solver's own claim is not used: on unstable plants IPOPT and qpOASES report feasible
    # programs as infeasible.
    status: Status
    failed_row: int = -1  # row of `Rows` that is incompatible with the others


def solve_mpc(mpc: MpcSolver, x: ArrayLike) -> MpcStep:
    """Solve the program at state `x` (n,)."""
    state, rows = np.asarray(x, dtype=float), mpc.rows
    with silent():  # the first call builds the solver
        answer = mpc.function(p=state, **mpc.limits)
    solved = bool(mpc.function.stats()["success"])
    width = rows.M.shape[1]
    v = answer["x"].full().ravel()[:width] if solved else np.zeros(width)
    excess = (rows.T @ state + rows.M @ v - rows.b) / rows.b
    plan, states = _unroll(mpc.controller, state, v)
    if not solved or np.max(excess[~mpc.soft], initial=0.0) > EXCEEDED:
        row = excluded_row(rows, rows.b - rows.T @ state)
        return MpcStep(plan, states, Status.INFEASIBLE if row >= 0 else Status.UNSOLVED, row)
    active = Status.ACTIVE if np.max(np.abs(v), initial=0.0) > 1e-8 else Status.FREE
    softened = np.max(excess[mpc.soft], initial=0.0) > EXCEEDED
    return MpcStep(plan, states, Status.SOFTENED if softened else active)


def simulate_mpc(mpc: MpcSolver, given: Scenario) -> Simulation:
    """Simulate with a program at every sample, without targets."""
    plant = mpc.controller.plant
    x, u = np.zeros((given.steps + 1, plant.n)), np.zeros((given.steps, plant.m))
    status = np.full(given.steps, Status.NOT_REACHED, dtype=np.int8)
    x[0], failed_row = given.x0, -1
    for t in range(given.steps):
        step = solve_mpc(mpc, x[t])
        status[t] = step.status
        if step.status > Status.SOFTENED:
            x[t + 1 :], failed_row = x[t], step.failed_row
            break
        u[t] = step.plan[0]
        x[t + 1] = next_state(plant, x[t], u[t], given.disturbance[t])
    return Simulation(plant, x, u, status, 0, failed_row)


def _unroll(controller: Controller, x: Array, v: Array) -> tuple[Array, Array]:
    plant, moves = controller.plant, v.reshape(controller.horizon, -1)
    plan, states = np.zeros(moves.shape), np.tile(x, (len(moves) + 1, 1))
    for k, move in enumerate(moves):
        plan[k] = move - controller.gains[k] @ states[k]
        states[k + 1] = plant.A @ states[k] + plant.B @ plan[k]
    return plan, states
