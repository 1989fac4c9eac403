"""Controller as a CasADi quadratic program that is solved at every sample.

This plain implementation is the reference for the fast one in `closed_loop`: the symbolic program
is solved by a named plugin from scratch at every sample.

    minimise over v_0..v_{N-1} (and slacks s >= 0 of soft rows)   sum v_k'S v_k / 2 + limit's
    subject to   T x + M v <= b + s
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import scipy.linalg

from impc.arrays import Array, BoolArray, finite_array
from impc.checking import checked
from impc.control.body_steps import next_state
from impc.control.constraint_rows import build_rows
from impc.control.controller import Controller
from impc.control.named_solver import PLUGINS, SOLVERS, excluded_row, silent
from impc.control.simulation import Simulation, Status
from impc.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from impc.control.compiled_values import Rows
    from impc.control.simulation import Scenario

# Slacks are linear in the cost, so the Hessian is singular, which DAQP does not accept; with its
# proximal iterations it declares feasible programs infeasible. Its slacks get a quadratic cost of
# this share of their penalty: a relative excess s changes the penalty by 1e-8 s.
_DAQP_SLACK = 1e-8
# A row exceeded by more than this share of its bound counts as violated, whatever the solver says.
_EXCEEDED = 1e-6


@dataclass(frozen=True)
class MpcSolver:
    """A controller and its program, ready to be solved; made by `build_mpc`."""

    controller: Controller
    rows: Rows
    name: str  # CasADi plugin
    # solver with the state as parameter ``p``; rows are divided by their bounds: call it with
    # ``lbg=-inf, ubg=1`` and slacks >= 0, as `solve_mpc` does
    function: Any
    soft: BoolArray  # (r,), which rows have a slack


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


@checked
def build_mpc(controller: Controller, solver: str = "daqp") -> MpcSolver:
    """Write the controller's program in CasADi and pass it to a solver."""
    if solver not in SOLVERS:
        raise InputError("solver", f"got {solver!r}", f"choose one of {', '.join(SOLVERS)}")
    rows = build_rows(controller)
    soft = np.isfinite(rows.limit)
    x = ca.SX.sym("x", controller.plant.n)
    v = ca.SX.sym("v", rows.M.shape[1])
    slack = ca.SX.sym("s", int(soft.sum()))
    metric = scipy.linalg.block_diag(*controller.metrics)
    placed = np.eye(len(rows.b))[:, soft]
    cost_weight = ca.DM(rows.limit[soft])
    curvature = ca.DM(rows.limit[soft] / rows.b[soft] * (_DAQP_SLACK if solver == "daqp" else 0))
    program = {
        "x": ca.vertcat(v, slack),
        "p": x,
        "f": (
            ca.mtimes([v.T, ca.DM(metric), v]) / 2
            + ca.dot(cost_weight, slack)
            + ca.dot(curvature, slack**2) / 2
        ),
        # Divided by b, so that a solver's absolute tolerance is relative to the bound.
        "g": (
            ca.mtimes(ca.DM(rows.T / rows.b[:, None]), x)
            + ca.mtimes(ca.DM(rows.M / rows.b[:, None]), v)
            - ca.mtimes(ca.DM(placed / rows.b[:, None]), slack)
        ),
    }
    name, options = PLUGINS[solver]
    if soft.any():  # qpOASES fails on a singular Hessian if it starts without active bounds
        options = {key: value for key, value in options.items() if key != "initialStatusBounds"}
    with silent():
        function = ca.qpsol("mpc", name, program, options)
    return MpcSolver(controller, rows, solver, function, soft)


@checked(x="n")
def solve_mpc(mpc: MpcSolver, x: ArrayLike) -> MpcStep:
    """Solve the program at state `x` (n,)."""
    controller, rows = mpc.controller, mpc.rows
    state = finite_array("x", x, (controller.plant.n,))
    width, slacks = rows.M.shape[1], int(mpc.soft.sum())
    with silent():  # the first call builds the solver
        answer = mpc.function(
            p=state,
            lbx=np.r_[np.full(width, -np.inf), np.zeros(slacks)],
            ubx=np.inf,
            lbg=-np.inf,
            ubg=1,
        )
    solved = bool(mpc.function.stats()["success"])
    decision = np.asarray(answer["x"]).ravel()
    v = decision[:width] if solved else np.zeros(width)
    excess = rows.T @ state + rows.M @ v - rows.b
    hard = excess[~mpc.soft] / rows.b[~mpc.soft]
    violation = float(np.max(hard, initial=0.0))
    status = _judge(excess[mpc.soft] / rows.b[mpc.soft], v)
    row = -1
    if not solved or violation > _EXCEEDED:
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


@checked
def mpc_function(controller: Controller) -> ca.Function:
    """Return one step of a controller as a `casadi.Function` of the state.

    It applies the gain where that satisfies all bounds, and the solution of the quadratic program
    (by DAQP) elsewhere. The function is an ordinary CasADi graph with CasADi's derivatives: it can
    be saved, loaded, and exported to C (and then linked with DAQP).

    Parameters
    ----------
    controller : Controller
        Controller to export.

    Returns
    -------
    casadi.Function
        x (n, 1) -> u (m, 1); NaN if no admissible plan was found.

    Examples
    --------
    >>> import impc
    >>> from plants import yalmip_example
    >>> plant = impc.Plant(yalmip_example())
    >>> bounds = impc.Bounds(plant, u_min=-1, u_max=1)
    >>> law = impc.Controller(plant, impc.Weights([[1, 0], [0, 1]], 1), bounds, horizon=3)
    >>> step = impc.mpc_function(law)
    >>> float(step([1, 3])), step.jacobian()([0.1, 0], 0).shape
    (1.0, (1, 2))
    """
    mpc = build_mpc(controller, "daqp")
    rows, width = mpc.rows, mpc.rows.M.shape[1]
    x = ca.MX.sym("x", controller.plant.n)
    gain = -ca.mtimes(ca.DM(controller.K), x)
    free = ca.Function("gain", [x], [gain])
    if len(rows.b) == 0:
        return ca.Function("mpc", [x], [free(x)], ["x"], ["u"])
    least = np.r_[np.full(width, -np.inf), np.zeros(int(mpc.soft.sum()))]
    v = mpc.function(p=x, lbx=least, ubx=np.inf, lbg=-np.inf, ubg=1)["x"][:width]
    reached = ca.mtimes(ca.DM(rows.T / rows.b[:, None]), x)
    planned = reached + ca.mtimes(ca.DM(rows.M / rows.b[:, None]), v)
    hard = np.flatnonzero(~mpc.soft).tolist()
    kept = ca.mmax(planned[hard]) <= 1 + _EXCEEDED if hard else ca.MX(1)
    answer = ca.if_else(kept, gain + v[: controller.plant.m], np.nan)
    busy = ca.Function("program", [x], [answer])
    branch = ca.Function.if_else("branch", free, busy)
    return ca.Function("mpc", [x], [branch(ca.mmax(reached) <= 1, x)], ["x"], ["u"])


def _judge(soft_excess: Array, v: Array) -> Status:
    if np.max(soft_excess, initial=0.0) > _EXCEEDED:
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
