"""MPC with the full equations of the plant, to test when the linear controller is adequate.

    minimise    x_N' P x_N + sum_{k<N} (x_k' Q x_k + u_k' R u_k)              (3.1), with f
    subject to  x_{k+1} = f(x_k, u_k),   u_min <= u_k <= u_max

by single shooting in CasADi. IPOPT solves every sample, starting from the last solution shifted by
one sample. P is the Riccati solution of the linearised plant, so for small states the controller is
the linear one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from impc.arrays import Array
from impc.control.simulation import Simulation, Status
from impc.model.riccati import solve_lqr
from impc.settings_files import IPOPT_ALONE

if TYPE_CHECKING:
    from impc.control.simulation import Scenario
    from impc.model.bounds import Bounds
    from impc.model.plant import Plant
    from impc.model.weights import Weights

_OPTIONS: dict[str, Any] = {
    "expand": True,  # All functions in one list: half the time
    "print_time": False,
    "error_on_fail": False,
    "ipopt": {
        **IPOPT_ALONE,
        "tol": 1e-9,
        "bound_relax_factor": 0.0,
        "warm_start_init_point": "yes",
        "mu_init": 1e-4,
    },
}
# States above this multiple of the disturbance count as diverged.
_FALLEN = 1e6


@dataclass(frozen=True)
class NonlinearMpc:
    """A nonlinear controller with its solver."""

    plant: Plant  # Linearised plant
    step: Any  # (state (n), all inputs (m + d)) -> next state: the plant, with its disturbances
    solver: Any  # CasADi's nlpsol: start x and parameters -> sequence
    horizon: int  # N in samples, number of states, number of inputs
    n: int
    m: int
    u_min: Array  # (m,)
    u_max: Array
    scale: Array  # Typical inputs (m,), by which the decisions are divided


def build_nonlinear_mpc(
    step: Any, plant: Plant, weights: Weights, bounds: Bounds, horizon: int
) -> NonlinearMpc:
    """Build the nonlinear program and its solver."""
    n, m, d = plant.n, plant.m, plant.E.shape[1]
    P = solve_lqr(plant, weights).P
    finite = np.where(np.isfinite(bounds.u_max), np.abs(bounds.u_max), 1.0)
    x0 = ca.MX.sym("x0", n)
    u = ca.MX.sym("u", m, horizon)
    x, cost = x0, ca.MX(0)
    Q, R = ca.DM(np.array(weights.Q)), ca.DM(np.array(weights.R))
    for k in range(horizon):
        command = u[:, k] * ca.DM(finite)
        cost += x.T @ Q @ x + command.T @ R @ command
        x = step(x, ca.vertcat(command, ca.DM.zeros(d)))
    cost += x.T @ ca.DM(np.array(P)) @ x
    # The cost is scaled by the state, so that the tolerance means the same at every state.
    size = 1e-9 + x0.T @ ca.DM(np.array(P)) @ x0
    program = {"x": ca.vec(u), "p": x0, "f": cost / size}
    solver = ca.nlpsol("nonlinear_mpc", "ipopt", program, _OPTIONS)
    return NonlinearMpc(
        plant, step, solver, horizon, n, m, np.array(bounds.u_min), np.array(bounds.u_max), finite
    )


def simulate_nonlinear(mpc: NonlinearMpc, given: Scenario) -> Simulation:
    """Simulate the nonlinear plant and controller; a failed sample ends it without an error."""
    steps = given.steps
    x, u = np.zeros((steps + 1, mpc.n)), np.zeros((steps, mpc.m))
    status = np.full(steps, Status.NOT_REACHED, dtype=np.int8)
    x[0] = given.x0
    guess = np.zeros(mpc.m * mpc.horizon)
    lower = np.tile(mpc.u_min / mpc.scale, mpc.horizon)
    upper = np.tile(mpc.u_max / mpc.scale, mpc.horizon)
    largest = _FALLEN * max(1.0, float(np.max(np.abs(given.disturbance), initial=0)))
    for k in range(steps):
        found = mpc.solver(x0=guess, p=x[k], lbx=lower, ubx=upper)
        plan = np.asarray(found["x"]).ravel()
        if not mpc.solver.stats()["success"]:
            status[k] = Status.UNSOLVED
            break
        u[k] = plan[: mpc.m] * mpc.scale
        near = np.isclose(plan[: mpc.m], upper[: mpc.m]) | np.isclose(plan[: mpc.m], lower[: mpc.m])
        status[k] = Status.ACTIVE if np.any(near) else Status.FREE
        inputs = np.concatenate([u[k], given.disturbance[k]])
        x[k + 1] = np.asarray(mpc.step(x[k], inputs)).ravel()
        guess = np.concatenate([plan[mpc.m :], plan[-mpc.m :]])
        if not np.all(np.isfinite(x[k + 1])) or np.max(np.abs(x[k + 1])) > largest:
            status[k] = Status.DIVERGED
            break
    reached = int(np.count_nonzero(status <= Status.SOFTENED))
    x[reached + 1 :] = x[reached]
    return Simulation(mpc.plant, x, u, status, 0, -1)
