"""Alarm rates of the residual test on simulated subjects with known noise.

The seat, three trials of 30 s at 100 Hz, |u| <= 6 Nm. The fit starts from the true weights and uses
the linear plant, also if the simulated body is nonlinear. The subjects:

    recorder     linear plant, white noise on the angles
    coloured     linear plant, first-order noise with coefficient 0.9 on the angles
    linear       subject of `impc simulate seated-balance --motor-noise 0.3`, linear plant
    default      the same subject with its nonlinear body
    motor        linear plant, motor noise of 1 Nm inside the loop

Results: experiments/coverage.md.

    python -m experiments.residual_study --seeds 20
"""

from __future__ import annotations

import argparse
import collections
import functools
import itertools
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

import plants
from experiments.driver import each, first_order_noise
from experiments.summary import counted
from impc.assess.lack_of_fit import LackOfFit, lack_of_fit
from impc.cli.seat import seat_weights
from impc.control.controller import Controller
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.refit import refit
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.studies.fit.asked import fit_problem
from impc.studies.fit.settings import FitSettings
from impc.studies.simulated_people import simulate_subject

__all__ = ["SUBJECTS", "Kind", "diagnosed"]

_LIMIT = 6.0


class Kind(NamedTuple):
    """A kind of subject: motor noise (Nm), noise on the angles (degrees), its root, the plant."""

    motor: float
    sensor: float
    root: float
    linear: bool


#: Kinds by name. White noise of 0.1 degrees at 1000 samples a second is 0.032 at 100.
SUBJECTS = {
    "recorder": Kind(0.0, 0.9, 0.0, linear=True),
    "coloured": Kind(0.0, 0.9, 0.9, linear=True),
    "linear": Kind(0.3, 0.032, 0.0, linear=True),
    "default": Kind(0.3, 0.032, 0.0, linear=False),
    "motor": Kind(1.0, 0.032, 0.0, linear=True),
}


def diagnosed(
    seed: int, name: str, order: int = 5, horizon: int = 20, duration: float = 30.0
) -> LackOfFit | None:
    """Residual test of a subject; `order` of the Padé delay, `duration` of a trial in s."""
    kind = SUBJECTS[name]
    system = plants.seated_balance_for(sample_time=0.01, delay_order=order)
    plant = Plant(system, ["command"]).linear()
    weights = seat_weights(plant)
    bounds = Bounds(plant, u_min=-_LIMIT, u_max=_LIMIT)
    controller = Controller(plant, weights, bounds, horizon, terminal_set=False)
    nonlinear = plants.seated_balance_step_for(sample_time=0.01, delay_order=order)
    step = _linear_step(plant) if kind.linear else nonlinear
    rng = np.random.default_rng([seed, 1])
    trials: list[Recording] = []
    for number, child in enumerate(np.random.SeedSequence(seed).spawn(3)):
        torque = plants.ternary_torque(duration=duration, rate=100.0, seed=100 * seed + number + 1)
        run = simulate_subject(
            controller, step, torque, rate=100.0, motor=kind.motor, largest=0.5, seed=child
        )
        noise = first_order_noise(rng, run.outputs.shape, kind.root)
        outputs = run.outputs + np.radians(kind.sensor) * noise
        trials.append(Recording(plant, outputs, run.disturbance))
    settings = FitSettings(horizon=horizon, u_max=_LIMIT)
    fitted = fit_controller(fit_problem(plant, trials, settings), weights)
    return lack_of_fit(refit(fitted.problem, np.array(fitted.gain), np.array(fitted.metric)))


def _linear_step(plant: Plant) -> Any:
    x, u = ca.SX.sym("x", plant.n), ca.SX.sym("u", plant.m + plant.E.shape[1])
    both = np.hstack([plant.B, plant.E])
    return ca.Function("step", [x, u], [ca.DM(np.array(plant.A)) @ x + ca.DM(both) @ u])


def _alarm(task: tuple[str, int], order: int, horizon: int) -> str:
    """Name of the error after an alarm; empty without one."""
    lack = diagnosed(task[1], task[0], order, horizon)
    return lack.errors[0].name if lack is not None and lack.alarm else ""


def main() -> None:
    """Print the alarms of the residual test for each kind, and the errors that it names."""
    parser = argparse.ArgumentParser(description="Alarm rates of the residual test.")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--order", type=int, default=5)
    parser.add_argument("--horizon", type=int, default=20)
    given = parser.parse_args()
    tasks = list(itertools.product(SUBJECTS, range(given.seeds)))
    study = functools.partial(_alarm, order=given.order, horizon=given.horizon)
    found = list(zip(tasks, each(study, tasks), strict=True))
    for name in SUBJECTS:
        alarms = [alarm for task, alarm in found if task[0] == name and alarm]
        print(f"{name:<10} {counted(len(alarms), given.seeds)}: {collections.Counter(alarms)}")


if __name__ == "__main__":
    main()
