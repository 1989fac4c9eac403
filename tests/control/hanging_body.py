"""An inverted pendulum with a nonlinear body, for tests."""

from __future__ import annotations

import casadi as ca
import numpy as np

import impc
from tests.support import named_plant

DT = 0.1


def pendulum(stiffness: float = 2.0, damping: float = 0.3) -> impc.Plant:
    """Plant of one Euler step per sample, whose linearisation is known exactly."""
    x, w = ca.SX.sym("x", 2), ca.SX.sym("w", 2)
    gravity = stiffness * ca.sin(x[0])
    rate = ca.vertcat(x[1], gravity - damping * x[1] * (1 + x[1] ** 2) + w[0] + w[1])
    body = ca.Function("body", [x, w], [x + DT * rate])
    A = np.array([[1.0, DT], [DT * stiffness, 1 - DT * damping]])
    B = np.array([[0.0, 0.0], [DT, DT]])
    signals = "angle speed", "torque push", "angle"
    return named_plant(A, B, [[1.0, 0.0]], DT, *signals, body=body)
