"""Controller as a CasADi function: the quadratic program of one sample.

`experiments/reference_mpc.py` solves it at every sample, as the reference for `closed_loop`.

    minimise over v_0..v_{N-1} (and slacks s >= 0 of soft rows)   sum v_k'S v_k / 2 + limit's
    subject to   T x + M v <= b + s
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import scipy.linalg

from impc.arrays import BoolArray
from impc.checking import checked
from impc.control.compiled_values import Rows
from impc.control.constraint_rows import build_rows
from impc.control.controller import Controller
from impc.control.named_solver import PLUGINS, SOLVERS, silent
from impc.errors import InputError

# Slacks are linear in the cost, so the Hessian is singular, which DAQP does not accept; with its
# proximal iterations it declares feasible programs infeasible. Its slacks get a quadratic cost of
# this share of their penalty: a relative excess s changes the penalty by 1e-8 s.
_DAQP_SLACK = 1e-8
#: A row exceeded by more than this share of its bound counts as violated, whatever the solver says.
EXCEEDED = 1e-6


@dataclass(frozen=True)
class MpcSolver:
    """A controller and its program, ready to be solved; made by `build_mpc`."""

    controller: Controller
    rows: Rows
    name: str  # CasADi plugin
    function: Any  # solver with the state as parameter ``p``
    # Of a call: slacks are not negative, and rows are divided by their bounds
    limits: dict[str, Any]
    soft: BoolArray  # (r,), which rows have a slack


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
    least = np.r_[np.full(rows.M.shape[1], -np.inf), np.zeros(int(soft.sum()))]
    limits = {"lbx": least, "ubx": np.inf, "lbg": -np.inf, "ubg": 1}
    return MpcSolver(controller, rows, solver, function, limits, soft)


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
    v = mpc.function(p=x, **mpc.limits)["x"][:width]
    reached = ca.mtimes(ca.DM(rows.T / rows.b[:, None]), x)
    planned = reached + ca.mtimes(ca.DM(rows.M / rows.b[:, None]), v)
    hard = np.flatnonzero(~mpc.soft).tolist()
    kept = ca.mmax(planned[hard]) <= 1 + EXCEEDED if hard else ca.MX(1)
    answer = ca.if_else(kept, gain + v[: controller.plant.m], np.nan)
    busy = ca.Function("program", [x], [answer])
    branch = ca.Function.if_else("branch", free, busy)
    return ca.Function("mpc", [x], [branch(ca.mmax(reached) <= 1, x)], ["x"], ["u"])
