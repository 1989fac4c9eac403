"""The four systems of Safe-PDP (Jin, Mou and Pappas, NeurIPS 2021) as optimal control problems.

Equations, cost weights, limits, sample times, horizons and initial states are those of its
demonstrations (*learning MPC from demonstrations*). Dynamics, constraints and cost weights are
unknown together; one cost weight is known and fixes the scale.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from impc.arrays import Array
from impc.nonlinear.problem import OptimalControlProblem
from plants.rigid_bodies import cart_pole, quadrotor, robot_arm, rocket, rotation

__all__ = ["SYSTEMS", "PeerSystem"]


@dataclass(frozen=True)
class PeerSystem:
    """A system of the benchmark.

    Attributes
    ----------
    name : str
    problem : OptimalControlProblem
    truth : dict
        Parameters of the demonstration, in SI units.
    x0 : Array
        Initial state of the demonstration (n,).
    """

    name: str
    problem: OptimalControlProblem
    truth: dict[str, float]
    x0: Array


def _symbols(truth: dict[str, float]) -> dict[str, ca.SX]:
    return {name: ca.SX.sym(name) for name in truth}


def _cart_pole(horizon: int = 35) -> PeerSystem:
    truth = {"mc": 0.5, "mp": 0.5, "l": 1.0, "max_u": 5.0, "max_x": 0.8,
             "wx": 0.1, "wq": 1.0, "wdx": 0.1, "wdq": 0.1}  # fmt: skip
    p = _symbols(truth)
    x = ca.vertcat(*(ca.SX.sym(name) for name in ("position", "angle", "velocity", "rate")))
    u = ca.SX.sym("force")
    prices = ca.vertcat(*(p[name] for name in ("wx", "wq", "wdx", "wdq")))
    cost = ca.dot(prices, (x - ca.DM([0, np.pi, 0, 0])) ** 2)
    problem = OptimalControlProblem(
        x,
        u,
        p,
        x + 0.1 * cart_pole(x, u, p["mc"], p["mp"], p["l"]),
        cost + 0.1 * u**2,
        horizon,
        terminal_cost=cost,
        constraints={
            "force": ca.vertcat(u - p["max_u"], -u - p["max_u"]),
            "position": ca.vertcat(x[0] - p["max_x"], -x[0] - p["max_x"]),
        },
        units={"mc": "kg", "mp": "kg", "l": "m", "max_u": "N", "max_x": "m"},
    )
    return PeerSystem("cart-pole", problem, truth, np.zeros(4))


def _robot_arm(horizon: int = 25) -> PeerSystem:
    truth = {"l1": 1.0, "m1": 1.0, "l2": 1.0, "m2": 1.0, "max_u": 1.0, "max_q": float(np.pi),
             "wq1": 0.1, "wq2": 0.1, "wdq1": 0.1, "wdq2": 0.1}  # fmt: skip
    p = _symbols(truth)
    x = ca.vertcat(*(ca.SX.sym(name) for name in ("q1", "q2", "dq1", "dq2")))
    u = ca.vertcat(ca.SX.sym("torque1"), ca.SX.sym("torque2"))
    prices = ca.vertcat(*(p[name] for name in ("wq1", "wq2", "wdq1", "wdq2")))
    cost = ca.dot(prices, (x - ca.DM([np.pi / 2, 0, 0, 0])) ** 2)
    rate = robot_arm(x, u, (p["l1"], p["l2"]), (p["m1"], p["m2"]))
    problem = OptimalControlProblem(
        x,
        u,
        p,
        x + 0.2 * rate,
        cost + 0.01 * ca.sumsqr(u),
        horizon,
        terminal_cost=cost,
        constraints={
            "torque": ca.vertcat(u - p["max_u"], -u - p["max_u"]),
            "angle": ca.vertcat(x[:2] - p["max_q"], -x[:2] - p["max_q"]),
        },
        units={"l1": "m", "m1": "kg", "l2": "m", "m2": "kg", "max_u": "Nm", "max_q": "rad"},
    )
    return PeerSystem("robot arm", problem, truth, np.array([-np.pi / 2, 3 * np.pi / 4, 0, 0]))


def _free_body_states() -> ca.SX:
    names = ("rx", "ry", "rz", "vx", "vy", "vz", "q0", "q1", "q2", "q3", "wx", "wy", "wz")
    return ca.vertcat(*(ca.SX.sym(name) for name in names))


def _quadrotor(horizon: int = 25) -> PeerSystem:
    truth = {"Jx": 1.0, "Jy": 1.0, "Jz": 1.0, "mass": 1.0, "l": 0.4, "max_u": 12.0,
             "max_r": 200.0, "wr": 1.0, "wv": 1.0, "wq": 5.0, "ww": 1.0}  # fmt: skip
    p = _symbols(truth)
    x = _free_body_states()
    u = ca.vertcat(*(ca.SX.sym(f"f{k}") for k in range(1, 5)))
    cost = (
        p["wr"] * ca.sumsqr(x[:3])
        + p["wv"] * ca.sumsqr(x[3:6])
        + p["wq"] * (3 - ca.trace(rotation(x[6:10])))
        + p["ww"] * ca.sumsqr(x[10:])
    )
    inertia = ca.vertcat(p["Jx"], p["Jy"], p["Jz"])
    problem = OptimalControlProblem(
        x,
        u,
        p,
        x + 0.15 * quadrotor(x, u, inertia, p["mass"], p["l"], 0.01),
        cost + 0.1 * ca.sumsqr(u),
        horizon,
        terminal_cost=cost,
        constraints={
            "thrust": ca.vertcat(u - p["max_u"], -u - p["max_u"]),
            "distance": ca.sumsqr(x[:3]) - p["max_r"],
        },
        units={"Jx": "kg m^2", "Jy": "kg m^2", "Jz": "kg m^2", "mass": "kg", "l": "m",
               "max_u": "N", "max_r": "m^2"},
    )  # fmt: skip
    x0 = np.array([-5.0, 5, 5, -5, -5, 0, 1, 0, 0, 0, 0, 0, 0])
    return PeerSystem("quadrotor", problem, truth, x0)


def _rocket(horizon: int = 40) -> PeerSystem:
    truth = {"Jx": 0.5, "Jy": 1.0, "Jz": 1.0, "mass": 1.0, "l": 1.0, "max_f_sq": 400.0,
             "max_tilt": 0.3, "wr": 10.0, "wv": 1.0, "wtilt": 50.0, "wside": 1.0,
             "ww": 1.0}  # fmt: skip
    p = _symbols(truth)
    x = _free_body_states()
    u = ca.vertcat(*(ca.SX.sym(name) for name in ("ux", "uy", "uz")))
    R = rotation(x[6:10])
    cost = (
        p["wr"] * ca.sumsqr(x[:3])
        + p["wv"] * ca.sumsqr(x[3:6])
        + p["wtilt"] * (R[1, 0] ** 2 + R[2, 0] ** 2)
        + p["ww"] * ca.sumsqr(x[10:])
    )
    inertia = ca.vertcat(p["Jx"], p["Jy"], p["Jz"])
    problem = OptimalControlProblem(
        x,
        u,
        p,
        x + 0.1 * rocket(x, u, inertia, p["mass"], p["l"]),
        cost + p["wside"] * ca.sumsqr(u[1:]) + 0.4 * ca.sumsqr(u),
        horizon,
        terminal_cost=cost,
        constraints={
            "thrust": ca.sumsqr(u) - p["max_f_sq"],
            "tilt": ca.cos(p["max_tilt"]) - (ca.trace(R) - 1) / 2,
        },
        units={"Jx": "kg m^2", "Jy": "kg m^2", "Jz": "kg m^2", "mass": "kg", "l": "m",
               "max_f_sq": "N^2", "max_tilt": "rad"},
    )  # fmt: skip
    x0 = np.array([10.0, -8, 5, -0.1, 0, 0, 1, 0, 0, 0, 0, 0, 0])
    return PeerSystem("rocket", problem, truth, x0)


#: Name -> function that builds the system, optionally with another horizon in samples.
SYSTEMS = {
    "cart-pole": _cart_pole,
    "robot arm": _robot_arm,
    "quadrotor": _quadrotor,
    "rocket": _rocket,
}
