"""Timed problems: W1 is the simulation example, W2 the seated subject."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import control
import numpy as np

import plants
from impc.checking import replace
from impc.cli.seat import seat_weights
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.feasibility import require_complete
from impc.control.simulation import Scenario, scenario
from impc.inverse.problem import Problem
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.weights import Weights

__all__ = ["Workload", "chain_of_masses", "example", "seat", "with_horizon"]

_RATE = 100.0


@dataclass(frozen=True)
class Workload:
    """A true controller, its scenarios, and the inverse problem of its recordings."""

    weights: Weights
    controller: Controller
    drives: tuple[Scenario, ...]
    problem: Problem


def example() -> Workload:
    """W1: the example of section 3.4, case A."""
    plant = Plant(plants.yalmip_example())
    bounds = Bounds(plant, u_min=-1, u_max=1)
    weights = Weights(np.eye(2), 1)
    controller = Controller(plant, weights, bounds, 3)
    return _record(weights, controller, [scenario(plant, [1, 3], 20)], plant, terminal_set=True)


def seat(trials: int = 1, seconds: float = 30.0, limit: float = 6.0) -> Workload:
    """W2: the seated subject at 100 Hz under the 5 Nm ternary torque, |u| <= 6 Nm, N = 20.

    The weights are the "true" intent of the reference, with 1e-2 on delay and muscle states.
    Trials differ in the phase of the torque.
    """
    plant = Plant(plants.seated_balance_plant(), ["command"])
    weights = seat_weights(plant)
    bounds = Bounds(plant, u_min=-limit, u_max=limit)
    controller = Controller(plant, weights, bounds, 20, terminal_set=False)
    torques = [
        plants.ternary_torque(duration=seconds, rate=_RATE, seed=None if k == 0 else k)
        for k in range(trials)
    ]
    drives = [scenario(plant, np.zeros(plant.n), disturbance=torque) for torque in torques]
    return _record(weights, controller, drives, plant, terminal_set=False)


def with_horizon(work: Workload, horizon: int) -> Workload:
    """The same workload recorded with another horizon."""
    controller = replace(work.controller, horizon=horizon)
    return _record(work.weights, controller, work.drives, controller.plant, terminal_set=False)


def chain_of_masses(states: int, steps: int = 3000, seed: int = 0, inputs: int = 1) -> Workload:
    """A chain of masses, springs and dampers whose first mass has a negative spring.

    `states` / 2 masses of 1 kg, springs of 40 N/m, dampers of 1 Ns/m between neighbours; the last
    mass is tied to a wall, the first is pushed away from the origin by 5 N/m: one unstable mode. A
    bounded force acts on each of the first `inputs` masses, a random one, held for 0.25 s, on the
    last.
    """
    masses = states // 2
    laplacian = 2 * np.eye(masses) - np.eye(masses, k=1) - np.eye(masses, k=-1)
    laplacian[0, 0] = 1.0
    stiffness = 40.0 * laplacian
    stiffness[0, 0] -= 40.0 / masses + 5.0  # Overcomes the stiffness of the chain: unstable
    eye, zero = np.eye(masses), np.zeros((masses, masses))
    A = np.block([[zero, eye], [-stiffness, -laplacian]])
    B, forces = np.zeros((states, inputs + 1)), [f"force{k}" for k in range(inputs)]
    B[masses : masses + inputs, :inputs] = np.eye(inputs)
    B[-1, inputs] = 1.0
    continuous = control.ss(A, B, np.eye(states), 0, inputs=[*forces, "push"])
    plant = Plant(control.c2d(continuous, 1 / _RATE), forces)
    weights = Weights(np.eye(states), 1e-2 * np.eye(inputs))
    push = np.random.default_rng(seed).choice([-1.0, 0.0, 1.0], size=steps // 25 + 1)
    controller = Controller(plant, weights, Bounds(plant), 20, terminal_set=False)
    drive = scenario(plant, np.zeros(states), disturbance=np.repeat(push, 25)[:steps])
    # About one sample in ten reaches this limit.
    free = require_complete(controller, simulate(controller, drive))
    limit = np.quantile(np.abs(free.u), 0.9, axis=0)
    bounds = Bounds(plant, u_min=-limit, u_max=limit)
    return _record(weights, replace(controller, bounds=bounds), [drive], plant, terminal_set=False)


def _record(
    weights: Weights,
    controller: Controller,
    drives: Sequence[Scenario],
    plant: Plant,
    *,
    terminal_set: bool,
) -> Workload:
    recordings = []
    for drive in drives:
        run = require_complete(controller, simulate(controller, drive))
        disturbance = np.vstack([drive.disturbance, np.zeros((1, plant.E.shape[1]))])
        recordings.append(Recording(plant, run.x @ plant.C.T, disturbance, x0=drive.x0))
    problem = Problem(
        plant,
        controller.bounds,
        controller.horizon,
        tuple(recordings),
        terminal_set=terminal_set,
        output_scale=np.ones(len(plant.outputs)),  # The same objective as for the alternatives
    )
    return Workload(weights, controller, tuple(drives), problem)
