"""An inverted pendulum with a nonlinear body, for tests."""

from __future__ import annotations

import casadi as ca
import control
import numpy as np

from impc.arrays import Array
from impc.model.plant import Plant
from impc.model.plant_family import PlantFamily

__all__ = ["DT", "linear_body", "pendulum", "pendulum_family", "rate"]

DT = 0.1


def rate(x: ca.SX, w: ca.SX, stiffness: float, damping: float) -> ca.SX:
    """Rates of angle and angular rate under torque and push; gravity acts as sin(angle)."""
    return ca.vertcat(
        x[1], stiffness * ca.sin(x[0]) - damping * x[1] * (1 + x[1] ** 2) + w[0] + w[1]
    )


def pendulum(stiffness: float = 2.0, damping: float = 0.3) -> Plant:
    """Plant of one Euler step per sample, whose linearisation is known exactly."""
    x, w = ca.SX.sym("x", 2), ca.SX.sym("w", 2)
    A = np.array([[1.0, DT], [DT * stiffness, 1 - DT * damping]])
    B = np.array([[0.0, 0.0], [DT, DT]])
    inputs, outputs = ["push", "torque"], ["angle"]
    system = control.ss(A, B, [[1.0, 0.0]], 0, DT, inputs=inputs, outputs=outputs)
    system.body = ca.Function("body", [x, w], [x + DT * rate(x, w, stiffness, damping)])
    return Plant(system, ["torque"])


def pendulum_family() -> PlantFamily:
    """Pendulums that differ in stiffness and damping."""

    def made(values: Array) -> Plant:
        return pendulum(float(values[0]), float(values[1]))

    return PlantFamily(made, ["stiffness", "damping"], [2.0, 0.3])


def linear_body(plant: Plant) -> Plant:
    """The same linear plant, with its matrices as a body."""
    n, m, d = plant.n, plant.m, plant.E.shape[1]
    x, w = ca.SX.sym("x", n), ca.SX.sym("w", m + d)
    both = np.hstack([plant.B, plant.E])
    names = [*plant.controls, *plant.disturbances]
    system = control.ss(
        plant.A, both, plant.C, 0, plant.dt, inputs=names, outputs=list(plant.outputs)
    )
    ahead = ca.DM(np.array(plant.A)) @ x + ca.DM(both) @ w
    return Plant(system, plant.controls, body=ca.Function("linear", [x, w], [ahead]))
