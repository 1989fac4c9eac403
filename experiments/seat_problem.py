"""Optimal control problem of a seated subject who predicts with the full equations.

    stage cost    line (v'z)^2 + angle1 theta1^2 + angle2 theta2^2 + command^2,      z the body

with v the direction of `impc.cli.seat.seat_weights`, and a limit of the command. The terminal cost
is x'P x, with P the Riccati solution of the linearised plant as a function of the cost weights. For
small angles the controller is therefore the linear one.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from impc.arrays import Array
from impc.cli.seat import HORIZON
from impc.model.plant import Plant
from impc.nonlinear.problem import OptimalControlProblem
from plants import seated_balance_for

__all__ = ["DIRECTION", "TRUTH", "seat_problem"]

#: Direction in angles and rates of the two bodies, rad and rad/s.
DIRECTION = (0.70, 0.65, 0.22, 0.20)
#: Cost weights relative to that of the command, and the limit, N m.
TRUTH = {"line": 6e5, "angle1": 2e4, "angle2": 2e4, "limit": 12.0}
# Doublings of the Riccati horizon: after 2^9 samples the slowest mode has decayed to 1e-9.
_DOUBLINGS = 9


def seat_problem(terminal: Array | None = None) -> OptimalControlProblem:
    """Build the problem at 100 samples a second; its disturbance is the torque on the seat.

    Parameters
    ----------
    terminal : Array, optional
        Constant P, shape (n, n); by default P depends on the cost weights.
    """
    system = seated_balance_for()
    plant = Plant(system, ["command"])
    x, u, d = ca.SX.sym("x", plant.n), ca.SX.sym("command"), ca.SX.sym("perturbation")
    theta = {name: ca.SX.sym(name) for name in TRUTH}
    v = ca.DM(np.array(DIRECTION))
    Q = ca.SX(plant.n, plant.n)
    Q[:4, :4] = theta["line"] * (v @ v.T)
    for k, name in enumerate(("angle1", "angle2")):
        Q[k, k] += theta[name]
    limit = theta["limit"]
    return OptimalControlProblem(
        x,
        u,
        theta,
        next_state=system.body()(x, ca.vertcat(u, d)),
        stage_cost=ca.bilin(Q, x, x) + u**2,
        horizon=HORIZON,
        terminal_cost=ca.bilin(_riccati(plant, Q) if terminal is None else ca.DM(terminal), x, x),
        constraints={"torque": ca.vertcat(u - limit, -u - limit)},
        disturbances=d,
        units={"limit": "N m"},
        dt=plant.dt,
    )


def _riccati(plant: Plant, Q: ca.SX) -> ca.SX:
    """Riccati solution P for R = 1 by the doubling algorithm (Chu, Fan and Lin 2005)."""
    A, B = ca.DM(np.array(plant.A)), ca.DM(np.array(plant.B))
    one = ca.SX.eye(plant.n)
    step, G, P = ca.SX(A), ca.SX(B @ B.T), Q
    for _ in range(_DOUBLINGS):
        W = ca.solve(one + G @ P, one)
        step, G, P = step @ W @ step, G + step @ W @ G @ step.T, P + step.T @ P @ W @ step
    return P
