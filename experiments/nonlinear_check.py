"""Compare the linear with a nonlinear controller on the full equations of the seat.

The amplitude of the ternary torque and the torque limit increase together, so the share of
saturated samples stays. Three loops: the linear controller on the linear plant, the linear
controller on the nonlinear plant, and the nonlinear controller (IPOPT) on the nonlinear plant, all
with the true weights.

    python -m experiments.nonlinear_check
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from typing import Any

import numpy as np
from tqdm import tqdm

from experiments.benchmarks.workloads import seat
from experiments.nonlinear_mpc import build_nonlinear_mpc, simulate_nonlinear
from experiments.reference_mpc import solve_mpc
from impc.arrays import Array
from impc.checking import replace
from impc.control.casadi_controller import build_mpc
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.simulation import Scenario, scenario
from impc.model.bounds import Bounds
from plants.integration import runge_kutta_step
from plants.seated_balance import nonlinear_dynamics

__all__ = ["Comparison", "compare_at"]

_TORQUE, _LIMIT = 5.0, 6.0


@dataclass(frozen=True)
class Comparison:
    """Largest angle, and largest differences of the angles, all in rad.

    Attributes
    ----------
    amplitude : float
        Amplitude of the torque, Nm.
    angle : float
        Largest angle under the nonlinear controller.
    controllers : float
        Linear against nonlinear controller, both on the nonlinear plant.
    plants : float
        Linear against nonlinear plant, both under the linear controller.
    """

    amplitude: float
    angle: float
    controllers: float
    plants: float


def compare_at(amplitude: float, seconds: float = 10.0) -> Comparison:
    """Simulate the three loops at one amplitude of the torque."""
    work = seat(1, seconds, _LIMIT)
    share = amplitude / _TORQUE
    limit = _LIMIT * share
    plant = work.controller.plant
    bounds = Bounds(plant, u_min=-limit, u_max=limit)
    controller = replace(work.controller, bounds=bounds)
    step = runge_kutta_step(nonlinear_dynamics(), plant.dt, 2)
    torque = work.drives[0].disturbance * share
    drive = scenario(plant, np.zeros(plant.n), disturbance=torque)
    nonlinear = simulate_nonlinear(
        build_nonlinear_mpc(step, plant, work.weights, bounds, controller.horizon), drive
    )
    both_linear = simulate(controller, drive).x[:, :2]
    mixed = _linear_on_nonlinear(controller, step, drive)[:, :2]
    angles = nonlinear.x[:, :2]
    return Comparison(
        amplitude,
        float(np.max(np.abs(angles))),
        float(np.max(np.abs(angles - mixed))),
        float(np.max(np.abs(both_linear - mixed))),
    )


def _linear_on_nonlinear(controller: Controller, step: Any, drive: Scenario) -> Array:
    mpc = build_mpc(controller, "daqp")
    x = np.zeros((drive.steps + 1, controller.plant.n))
    x[0] = drive.x0
    for k in range(drive.steps):
        command = solve_mpc(mpc, x[k]).plan[0]
        x[k + 1] = np.asarray(step(x[k], np.append(command, drive.disturbance[k]))).ravel()
    return x


def main() -> None:
    """Print a line for each amplitude."""
    parser = argparse.ArgumentParser(description="Linear against nonlinear controller on the seat.")
    parser.add_argument("--amplitudes", type=float, nargs="+", default=[0.05, 1, 2.5, 5, 7.5, 10])
    parser.add_argument("--seconds", type=float, default=10.0)
    given = parser.parse_args()
    print("torque Nm   largest angle deg   between controllers   between plants (of that angle)")
    for amplitude in tqdm(given.amplitudes, unit="amplitude", disable=None):
        found = compare_at(amplitude, given.seconds)
        shares = 100 * np.array([found.controllers, found.plants]) / found.angle
        print(
            f"{amplitude:9.2f} {np.degrees(found.angle):19.3f} "
            f"{shares[0]:19.4f} % {shares[1]:14.4f} %"
        )


if __name__ == "__main__":
    main()
