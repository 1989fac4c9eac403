"""A linear controller's program as an optimal control problem with parameters."""

from __future__ import annotations

import casadi as ca
import numpy as np

from impc.control.controller import Controller
from impc.model.weights import Weights
from impc.nonlinear.problem import OptimalControlProblem


def linear_twin(
    controller: Controller, weights: Weights
) -> tuple[OptimalControlProblem, dict[str, float]]:
    """The same program; its parameters are factors 1 of the diagonal of Q, with their values.

    The terminal weight is the Riccati solution as a function of them, by ten steps of the doubling
    algorithm (Chu, Fan and Lin 2005), which square the error.
    """
    plant = controller.plant
    n, m = plant.n, plant.m
    x, u = ca.SX.sym("x", n), ca.SX.sym("u", m)
    names = [f"q{k}" for k in range(n)]
    theta = {name: ca.SX.sym(name) for name in names}
    Q = ca.SX(ca.DM(np.array(weights.Q)))
    for k, name in enumerate(names):
        Q[k, k] *= theta[name]
    A, B = ca.DM(np.array(plant.A)), ca.DM(np.array(plant.B))
    R = np.array(weights.R)
    step, G, P = ca.SX(A), ca.SX(B @ ca.DM(np.linalg.inv(R)) @ B.T), Q
    for _ in range(10):
        W = ca.inv(ca.SX.eye(n) + G @ P)
        step, G, P = step @ W @ step, G + step @ W @ G @ step.T, P + step.T @ P @ W @ step
    bounds = controller.bounds
    over = ca.vertcat(u - ca.DM(bounds.u_max), ca.DM(bounds.u_min) - u)
    problem = OptimalControlProblem(
        x, u, theta, A @ x + B @ u, ca.bilin(Q, x, x) + ca.bilin(ca.DM(R), u, u),
        controller.horizon, terminal_cost=ca.bilin(P, x, x), constraints={"input": over},
    )  # fmt: skip
    return problem, dict.fromkeys(names, 1.0)
