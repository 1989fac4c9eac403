"""Alternatives to the package: the closed loop as a CasADi graph, and in cvxpy."""

from __future__ import annotations

from typing import Any

import casadi as ca
import cvxpy as cp
import numpy as np
import scipy.optimize

from experiments.benchmarks.workloads import Workload
from experiments.certificates import weights_from_parameters
from impc.arrays import Array
from impc.errors import SolverError
from impc.model.bounds import bound_rows
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights

__all__ = ["casadi_fit", "casadi_loop", "cvxpy_fit"]

_OPTIONS: dict[str, dict[str, Any]] = {
    "daqp": {"error_on_fail": False},
    "qpoases": {"printLevel": "none", "error_on_fail": False, "sparse": False},
}


def casadi_loop(work: Workload, solver: str) -> Any:
    """The closed loop K -> states as one CasADi Function, a quadratic program at every sample.

    The rows T(K), M(K) of the input bounds are computed once in the graph and given to every step
    of a `mapaccum`. The program is in v = u + Kx as in `impc`, so only the implementation differs.
    """
    plant, controller = work.controller.plant, work.controller
    n, horizon = plant.n, controller.horizon
    disturbance = work.drives[0].disturbance
    limit = float(controller.bounds.u_max[0])
    K = ca.MX.sym("K", 1, n)
    closed = ca.DM(plant.A) - ca.mtimes(ca.DM(plant.B), K)
    power, rows_T, response = -K, [], []
    for _ in range(horizon):
        rows_T.append(power)
        response.append(ca.mtimes(power, ca.DM(plant.B)))
        power = ca.mtimes(power, closed)
    T = ca.vertcat(*rows_T)
    M = ca.vertcat(
        *[
            ca.horzcat(
                *[response[k - 1 - i] for i in range(k)],
                ca.MX(1),
                *([ca.MX(1, horizon - 1 - k)] if k < horizon - 1 else []),
            )
            for k in range(horizon)
        ]
    )
    M = ca.densify(M)
    shapes = {"h": ca.Sparsity.dense(horizon, horizon), "a": ca.Sparsity.dense(horizon, horizon)}
    program = ca.conic("qp", solver, shapes, _OPTIONS[solver])
    x, d = ca.MX.sym("x", n), ca.MX.sym("d", plant.E.shape[1])
    gain = ca.MX.sym("gain", 1, n)
    t, m = ca.MX.sym("t", horizon, n), ca.MX.sym("m", horizon, horizon)
    free = ca.mtimes(t, x)
    v = program(h=ca.DM.eye(horizon), a=m, lba=-limit - free, uba=limit - free)["x"]
    u = v[0] - ca.mtimes(gain, x)
    following = ca.mtimes(plant.A, x) + ca.mtimes(plant.B, u) + ca.mtimes(plant.E, d)
    step = ca.Function("step", [x, d, gain, t, m], [following])
    steps = len(disturbance)
    states = step.mapaccum(steps)(
        work.drives[0].x0,
        disturbance.T,
        ca.repmat(K, 1, steps),
        ca.repmat(T, 1, steps),
        ca.repmat(M, 1, steps),
    )
    return ca.Function("loop", [K], [states])


def casadi_fit(work: Workload, loop: Any, begin: Array) -> Array:
    """Gain (m, n) as a careful user of CasADi fits it: `casadi_loop` under least squares.

    Derivatives are finite differences; a gain that CasADi cannot simulate gets a large residual.
    """
    recorded, C = work.problem.recordings[0].outputs, work.controller.plant.C
    shape = work.controller.K.shape

    def residual(k: Array) -> Array:
        try:
            states = np.array(loop((begin.ravel() * k).reshape(shape))).T
        except RuntimeError:
            return np.full((len(recorded) - 1) * len(C), 1e3)
        return np.asarray((states @ C.T - recorded[1:]).ravel())

    found = scipy.optimize.least_squares(
        residual, np.ones(begin.size), method="trf", xtol=1e-12, ftol=1e-12, gtol=1e-12
    )
    return np.asarray((begin.ravel() * found.x).reshape(shape))


def cvxpy_fit(work: Workload, start: Weights) -> tuple[Weights, int]:
    """Inverse MPC as a plain script: least squares over Cholesky entries of Q, cvxpy inside.

    R is one and there is no terminal set, because computing one at every iterate would dominate the
    time. Derivatives are finite differences.

    Returns
    -------
    weights, simulations : Weights, int
    """
    plant, problem = work.controller.plant, work.problem
    limit = float(bound_rows(problem.bounds, plant).b[0])
    recorded = problem.recordings[0].outputs
    n, horizon = plant.n, problem.horizon
    x0 = cp.Parameter(n)
    u, x = cp.Variable((horizon, 1)), cp.Variable((horizon + 1, n))
    q, p = cp.Parameter((n, n)), cp.Parameter((n, n))
    cost = cp.sum_squares(x[horizon] @ p)
    constraints = [x[0] == x0, cp.abs(u) <= limit]
    for k in range(horizon):
        cost += cp.sum_squares(x[k] @ q) + cp.sum_squares(u[k])
        constraints.append(x[k + 1] == plant.A @ x[k] + plant.B @ u[k])
    program = cp.Problem(cp.Minimize(cost), constraints)
    count = 0

    def residual(parameters: Array) -> Array:
        nonlocal count
        count += 1
        weights = weights_from_parameters(parameters, n, 1)
        q.value = np.linalg.cholesky(weights.Q)
        p.value = np.linalg.cholesky(solve_lqr(plant, weights).P)
        states = [recorded[0]]
        for _ in range(len(recorded) - 1):
            x0.value = states[-1]
            program.solve(solver=cp.CLARABEL)
            if u.value is None:
                raise SolverError("cvxpy", f"no answer: {program.status}", "start elsewhere")
            states.append(plant.A @ states[-1] + plant.B @ u.value[0])
        return np.asarray((np.array(states) - recorded).ravel())

    begin = np.linalg.cholesky(start.Q / float(start.R[0, 0]))[np.tril_indices(n)]
    found = scipy.optimize.least_squares(residual, begin, diff_step=np.full(len(begin), 1e-5))
    return weights_from_parameters(np.asarray(found.x, dtype=np.float64), n, 1), count
