"""Simulate subjects with motor and sensory noise: carts, and the seat.

The body is a cart of two states pushed at three levels, two such carts coupled by a spring with one
input each, or the linear seated subject under the ternary torque. Noise is in the motor command, in
the senses, or in both. Its size is chosen so that the motion without noise has a VAF of 90 or 70 %
in the motion with noise. The limit of the command is far away, or reached in a tenth of the samples
and more (less often by two carts). Cost weights are log-uniform within a factor of two. At the
limit some subjects on the seat fall.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import control
import numpy as np

import plants
from experiments.benchmarks.workloads import seat
from impc.arrays import Array
from impc.assess.variance_accounted_for import vaf
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.simulation import scenario
from impc.inverse.problem import Problem
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.structure import Structure
from impc.model.weights import Weights
from impc.output_feedback.observer import Observer
from impc.output_feedback.simulation import simulate_person

__all__ = ["BODIES", "NOISES", "Recorded", "Subject", "recorded", "subject"]

#: Motor and sensory noise of each kind before scaling, as shares of the typical sizes of a body.
NOISES = {"motor": (1.0, 0.1), "sensory": (0.05, 1.0), "both": (1.0, 1.0)}
#: Simulated bodies.
BODIES = ("cart", "seat", "pair")
_TRIALS, _FACTOR = 3, 2.0
# Recording noise as a share of the standard deviation of the motion.
_RECORDER = 0.02
# Bisections of the logarithm of the noise size, and its range.
_HALVINGS, _SIZES = 14, (-4.0, 1.5)


@dataclass(frozen=True)
class Subject:
    """A simulated subject.

    Attributes
    ----------
    controller : Controller
    person : Observer
    recorder : Array
        Standard deviations of the recording noise, shape (p,).
    pushes : sequence of Array
        Disturbance of each trial, shape (samples,); (samples, 2) for two carts.
    """

    controller: Controller
    person: Observer
    recorder: Array
    pushes: Sequence[Array]


@dataclass(frozen=True)
class Recorded:
    """Recordings of a subject.

    Attributes
    ----------
    problem : Problem
        Inverse problem with unknown initial states.
    saturated : float
        Share of the samples at the limit.
    vaf : float
        VAF of the motion without noise, mean over outputs, %.
    largest : float
        Largest magnitude of the recorded outputs, rad or m.
    """

    problem: Problem
    saturated: float
    vaf: float
    largest: float


def subject(body: str, seed: int, noise: str, share: float, limit: float) -> Subject:
    """Draw a subject whose motion without noise has a VAF of about `share` %."""
    kind = [BODIES.index(body), list(NOISES).index(noise)]
    rng = np.random.default_rng([seed, round(share), *kind, round(100 * limit)])
    law, pushes = {"cart": _on_cart, "seat": _on_seat, "pair": _on_pair}[body](rng, limit)
    low, high = _SIZES
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        person = _person(body, law.plant, noise, np.exp(middle))
        if _agreement(law, person, pushes, rng) > share:
            low = middle
        else:
            high = middle
    clean = simulate(law, scenario(law.plant, np.zeros(law.plant.n), disturbance=pushes[0])).x
    recorder = _RECORDER * np.std(clean @ law.plant.C.T, axis=0)
    return Subject(law, _person(body, law.plant, noise, np.exp(low)), recorder, pushes)


def recorded(who: Subject, seed: int) -> Recorded:
    """Simulate and record the trials of a subject."""
    law, plant, trials, met, shares = who.controller, who.controller.plant, [], [], []
    for number, push in enumerate(who.pushes):
        found = simulate_person(law, who.person, push, recorder=who.recorder, seed=[seed, number])
        met.append(np.mean(np.abs(found.u) >= law.bounds.u_max - 1e-9))
        shares.append(_moved(law, found.states, push))
        trials.append(Recording(plant, found.outputs, push))
    problem = Problem(
        plant,
        law.bounds,
        law.horizon,
        trials,
        terminal_set=False,
        unknown_start=True,
        structure=Structure(plant, "full", over=plant.states[:4]),
    )
    largest = max(float(np.max(np.abs(one.outputs))) for one in trials)
    return Recorded(problem, float(np.mean(met)), float(np.mean(shares)), largest)


def _on_cart(rng: np.random.Generator, limit: float) -> tuple[Controller, list[Array]]:
    """One cart: 20 samples a second, 30 s a trial."""
    system = control.ss(
        [[1, 0.05], [0, 0.98]], [[0, 0], [0.05, 0.05]], [[1, 0]], 0, 0.05,
        states=["x", "v"], inputs=["u", "push"], outputs=["x"],
    )  # fmt: skip
    plant = Plant(system, ["u"])
    weights = Weights(np.diag(np.array([8.0, 1.0]) * _factors(rng, 2)), 1)
    law = Controller(
        plant, weights, Bounds(plant, u_min=-limit, u_max=limit), 5, terminal_set=False
    )
    return law, [np.repeat(rng.choice([-0.7, 0.0, 0.7], 60), 10) for _ in range(_TRIALS)]


def _on_pair(rng: np.random.Generator, limit: float) -> tuple[Controller, list[Array]]:
    """Two carts coupled by a spring of 2 N/m, each with a disturbance and an input."""
    A = np.array(np.kron(np.eye(2), [[1, 0.05], [0, 0.98]]), dtype=np.float64)
    A[1::2, ::2] += 0.05 * 2.0 * np.array([[-1, 1], [1, -1]])
    B = np.zeros((4, 4))
    B[1::2, :2] = B[1::2, 2:] = 0.05 * np.eye(2)
    system = control.ss(
        A, B, np.eye(4)[::2], 0, 0.05, states=["x1", "v1", "x2", "v2"],
        inputs=["u1", "u2", "push1", "push2"], outputs=["x1", "x2"],
    )  # fmt: skip
    plant = Plant(system, ["u1", "u2"])
    cost_weights = np.array([8.0, 1.0, 8.0, 1.0]) * _factors(rng, 4)
    weights = Weights(np.diag(cost_weights), np.diag([1.0, float(_factors(rng, 1)[0])]))
    law = Controller(
        plant, weights, Bounds(plant, u_min=-limit, u_max=limit), 5, terminal_set=False
    )
    levels = [-0.7, 0.0, 0.7]
    return law, [np.repeat(rng.choice(levels, (60, 2)), 10, axis=0) for _ in range(_TRIALS)]


def _on_seat(rng: np.random.Generator, limit: float) -> tuple[Controller, list[Array]]:
    """The seated subject of the benchmarks: 100 samples a second, 30 s a trial."""
    work = seat(1, 2.0)
    plant, factor = work.controller.plant, np.ones(work.controller.plant.n)
    factor[:4] = np.sqrt(_factors(rng, 4))
    weights = Weights(factor[:, None] * np.array(work.weights.Q) * factor, 1)
    law = Controller(
        plant, weights, Bounds(plant, u_min=-limit, u_max=limit), 20, terminal_set=False
    )
    seeds = rng.integers(2**31, size=_TRIALS)
    return law, [plants.ternary_torque(duration=30.0, rate=100.0, seed=int(k)) for k in seeds]


def _factors(rng: np.random.Generator, count: int) -> Array:
    return np.exp(rng.uniform(-np.log(_FACTOR), np.log(_FACTOR), count))


def _person(body: str, plant: Plant, noise: str, size: float) -> Observer:
    motor, look = np.array(NOISES[noise]) * size
    if body == "cart":  # 1 N, 5 cm, 10 cm/s
        return Observer(plant, ["x", "v"], motor=motor, sensory=[0.05 * look, 0.1 * look])
    if body == "pair":
        return Observer(plant, plant.states, motor=motor, sensory=[0.05 * look, 0.1 * look] * 2)
    angle = np.radians(look)  # 3 Nm, 1 deg, 10 deg/s
    sensed = ["theta1", "theta2", "theta1_rate", "theta2_rate"]
    return Observer(plant, sensed, motor=3 * motor, sensory=[angle, angle, 10 * angle, 10 * angle])


def _agreement(
    law: Controller, person: Observer, pushes: Sequence[Array], rng: np.random.Generator
) -> float:
    shares = []
    for push in pushes:
        noisy = simulate_person(law, person, push, seed=int(rng.integers(2**31)))
        shares.append(_moved(law, noisy.states, push))
    return float(np.mean(shares))


def _moved(law: Controller, states: Array, push: Array) -> float:
    """VAF of the noise-free motion in the noisy motion, mean over outputs, %."""
    plant = law.plant
    clean = simulate(law, scenario(plant, np.zeros(plant.n), disturbance=push)).x[:-1]
    return float(np.mean(vaf(states @ plant.C.T, clean @ plant.C.T)))
