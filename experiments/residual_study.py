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
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import scipy.signal
from tqdm import tqdm

import plants
from impc.arrays import Array
from impc.assess.lack_of_fit import LackOfFit, lack_of_fit
from impc.control.controller import Controller
from impc.inverse.estimates import Estimate
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.refit import refit
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.weights import Weights
from impc.studies.fit.asked import fit_problem
from impc.studies.fit.settings import FitSettings
from impc.studies.simulated_people import simulate_subject

__all__ = ["SUBJECTS", "Kind", "diagnosed", "fitted_subject"]

_LIMIT = 6.0


@dataclass(frozen=True)
class Kind:
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


def fitted_subject(
    kind: Kind, seed: int, order: int, horizon: int, duration: float = 30.0
) -> Estimate:
    """Simulate and fit a subject; `order` of the Padé delay, `duration` of a trial in s."""
    system = plants.seated_balance_for(sample_time=0.01, delay_order=order)
    plant = Plant(system, ["command"]).linear()
    weights = _weights(plant)
    bounds = Bounds(plant, u_min=-_LIMIT, u_max=_LIMIT)
    controller = Controller(plant, weights, bounds, horizon, terminal_set=False)
    step = _linear_step(plant) if kind.linear else _nonlinear_step(order)
    rng = np.random.default_rng([seed, 1])
    trials: list[Recording] = []
    for number, child in enumerate(np.random.SeedSequence(seed).spawn(3)):
        torque = plants.ternary_torque(duration=duration, rate=100.0, seed=100 * seed + number + 1)
        run = simulate_subject(
            controller, step, torque, rate=100.0, motor=kind.motor, largest=0.5, seed=child
        )
        noise = np.radians(kind.sensor) * _noise(kind.root, run.outputs.shape, rng)
        trials.append(Recording(plant, run.outputs + noise, run.disturbance))
    settings = FitSettings(horizon=horizon, u_max=_LIMIT)
    return fit_controller(fit_problem(plant, trials, settings), weights)


def diagnosed(
    seed: int, name: str, order: int = 5, horizon: int = 20, duration: float = 30.0
) -> LackOfFit | None:
    """Residual test of one subject with three trials of `duration` s."""
    fitted = fitted_subject(SUBJECTS[name], seed, order, horizon, duration)
    K, S = np.array(fitted.gain), np.array(fitted.metric)
    return lack_of_fit(refit(fitted.problem, K, S))


def _weights(plant: Plant) -> Weights:
    v = np.array([0.70, 0.65, 0.22, 0.20])
    v /= np.linalg.norm(v)
    Q = 1e-2 * np.eye(plant.n)
    Q[:4, :4] = 6e5 * np.outer(v, v) + np.diag([2e4, 2e4, 500, 500])
    return Weights(Q, 1)


def _linear_step(plant: Plant) -> Any:
    x, u = ca.SX.sym("x", plant.n), ca.SX.sym("u", plant.m + plant.E.shape[1])
    both = np.hstack([plant.B, plant.E])
    return ca.Function("step", [x, u], [ca.DM(np.array(plant.A)) @ x + ca.DM(both) @ u])


def _nonlinear_step(order: int) -> Any:
    return plants.seated_balance_step_for(sample_time=0.01, delay_order=order)


def _noise(root: float, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    white = rng.standard_normal((shape[0] + 500, *shape[1:]))
    filtered = scipy.signal.lfilter([np.sqrt(1 - root**2)], [1.0, -root], white, axis=0)
    return np.asarray(filtered[500:])


def main() -> None:
    """Print the alarms of the residual test for each kind, and the errors that it names."""
    parser = argparse.ArgumentParser(description="Alarm rates of the residual test.")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--order", type=int, default=5)
    parser.add_argument("--horizon", type=int, default=20)
    given = parser.parse_args()
    for name in SUBJECTS:
        study = functools.partial(diagnosed, name=name, order=given.order, horizon=given.horizon)
        with ProcessPoolExecutor(2) as pool:
            found = list(tqdm(pool.map(study, range(given.seeds)), total=given.seeds, disable=None))
        alarms = [lack.errors[0].name for lack in found if lack is not None and lack.alarm]
        print(
            f"{name:<10} {len(alarms)} alarms of {len(found)}: {dict(collections.Counter(alarms))}"
        )


if __name__ == "__main__":
    main()
