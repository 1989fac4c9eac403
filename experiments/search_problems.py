"""Inverse problems with known gains for search tests: sticks and random plants."""

from __future__ import annotations

from dataclasses import dataclass

import control
import numpy as np

from impc.arrays import Array
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.simulation import scenario
from impc.inverse.problem import Problem
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.weights import Weights

__all__ = ["Known", "random_problem", "stick", "stick_problem"]

_SAMPLE, _PUSHED, _NOISE, _FALLEN = 0.02, 10, np.radians(0.02), 0.6


@dataclass(frozen=True)
class Known:
    """An inverse problem with its true gain.

    Attributes
    ----------
    problem : Problem
    K, S : Array
        The true gain (m, n) and metric (m, m).
    saturated : float
        Share of samples at which an input is at its bound.
    """

    problem: Problem
    K: Array
    S: Array
    saturated: float


def stick(length: float = 1.0) -> control.StateSpace:
    """A stick of `length` m on a fingertip, 50 samples a second; its angle is the output."""
    turn = 1.5 / length
    continuous = control.ss(
        [[0, 1], [9.81 * turn, 0]],
        [[0, 0], [-turn, 1]],
        [[1, 0]],
        [[0, 0]],
        states=["angle", "rate"],
        inputs=["finger", "push"],
        outputs=["angle"],
    )
    return control.c2d(continuous, _SAMPLE)


def stick_problem(seed: int, samples: int = 600) -> Known | None:
    """A stick balanced by a clipped gain; None if it falls or the loop is slow."""
    rng = np.random.default_rng([77, seed])
    length = float(rng.uniform(0.7, 1.6))
    plant = Plant(stick(length), ["finger"])
    K = np.array([[-25.0, -7.0]]) * rng.uniform(0.7, 1.5, 2)
    limit, push = float(rng.uniform(0.5, 2.5)), float(rng.uniform(0.8, 2.0))
    if np.max(np.abs(np.linalg.eigvals(plant.A - plant.B @ K))) > 0.995:
        return None
    d = np.repeat(rng.choice([-push, 0, push], samples // _PUSHED), _PUSHED)[:, None]
    x, states, met = np.zeros(2), [], 0
    for now in d:
        states.append(x)
        command = -K @ x
        u = np.clip(command, -limit, limit)
        met += int(u[0] != command[0])
        x = plant.A @ x + plant.B @ u + plant.E @ now
        if abs(x[0]) > _FALLEN:
            return None
    outputs = np.array(states)[:, :1] + _NOISE * rng.standard_normal((samples, 1))
    bounds = Bounds(plant, u_min=-limit, u_max=limit)
    trial = Recording(plant, outputs, d)
    return Known(Problem(plant, bounds, 15, (trial,)), K, np.eye(1), met / samples)


def random_problem(
    seed: int, inputs: int = 1, *, half: bool = False, samples: int = 40
) -> Known | None:
    """An exact recording of a random MPC from a random initial state; None if it diverges.

    All states are recorded; with `half`, half as many mixed outputs, and the initial state is
    unknown.
    """
    rng = np.random.default_rng([900, inputs, seed])
    n = int(rng.integers(max(2, inputs), 7))
    A = rng.normal(size=(n, n))
    A *= rng.uniform(0.85, 1.3) / np.max(np.abs(np.linalg.eigvals(A)))
    B = rng.normal(size=(n, inputs))
    factors = [np.tril(rng.normal(size=(size, size))) for size in (n, inputs)]
    Q, R = (L @ L.T + 0.05 * np.eye(len(L)) for L in factors)
    horizon = int(rng.integers(3, 13))
    u_max, u_min = (sign * np.exp(rng.uniform(-0.4, 0.4, inputs)) for sign in (1, -1))
    C = rng.normal(size=(max(1, n // 2), n)) if half else np.eye(n)
    plant = Plant(control.ss(A, B, C, np.zeros((len(C), inputs)), True))
    bounds = Bounds(plant, u_min=u_min, u_max=u_max)
    truth = Controller(plant, Weights(Q, R), bounds, horizon, terminal_set=False)
    x0 = rng.normal(size=n)
    x0 *= rng.uniform(1.2, 2.2) / np.max(np.abs(truth.K @ x0) / u_max)
    run = simulate(truth, scenario(plant, x0, samples - 1))
    if not run.complete:
        return None
    met = np.mean(np.any((run.u >= u_max - 1e-9) | (run.u <= u_min + 1e-9), axis=1))
    outputs = run.x @ C.T
    trial = Recording(plant, outputs, x0=np.linalg.pinv(C) @ outputs[0])
    problem = Problem(plant, bounds, horizon, (trial,), unknown_start=half)
    return Known(problem, np.array(truth.K), np.array(truth.S), float(met))
