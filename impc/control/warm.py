"""Compile what simulations, fits and likelihoods run, so that nobody waits for it later.

A cart is simulated in each way that has compiled code of its own: with and without derivatives, by
a named solver, with a body that is not linear, and as a person who senses with noise, whose
likelihood is taken (docs/speed.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import casadi as ca
import control
import numpy as np

from impc.checking import replace
from impc.control.closed_loop import simulate, simulate_and_differentiate
from impc.control.constraint_rows import directions
from impc.control.controller import Controller
from impc.control.joint_likelihood import NoiseDirections, joint_likelihoods, prepare_filter
from impc.control.noisy_person import simulate_person
from impc.control.simulation import scenario
from impc.model.bounds import Bounds
from impc.model.observer import Observer
from impc.model.plant import Plant
from impc.model.recordings import Recording

if TYPE_CHECKING:
    from collections.abc import Iterator

_LIMIT, _STEPS = 0.8, 40


def compiled_parts() -> Iterator[str]:
    """Compile one part after the other; yield what each is for when it is done."""
    system = control.ss(
        [[1, 0.1], [0, 1]],
        [[0, 0], [0.1, 0.1]],
        [[1, 0]],
        0,
        0.1,
        states=["x", "v"],
        inputs=["u", "d"],
        outputs=["y"],
    )
    plant = Plant(system, ["u"])
    bounds = Bounds(plant, u_min=-_LIMIT, u_max=_LIMIT)
    law = Controller.from_gain(plant, [[8.0, 4.0]], bounds, 5, terminal_set=False)
    drive = scenario(plant, [0.5, 0.0], disturbance=np.full((_STEPS, 1), 0.1))
    simulate_and_differentiate(law, drive, directions(law, 2, x0=np.eye(2)))
    simulate(replace(law, solver="daqp"), drive)
    yield "the constrained controller and its closed loop"

    x, w = ca.SX.sym("x", 2), ca.SX.sym("w", 2)
    moved = ca.vertcat(x[0] + 0.1 * ca.sin(x[1]), x[1] + 0.1 * (w[0] + w[1]))
    bent = Plant(system, ["u"], body=ca.Function("body", [x, w], [moved]))
    bent_law = replace(law, plant=bent, bounds=Bounds(bent, u_min=-_LIMIT, u_max=_LIMIT))
    simulate_and_differentiate(bent_law, drive, directions(bent_law, 2, x0=np.eye(2)))
    yield "bodies that are not linear"

    person, recorder = Observer(plant, ["x", "v"], motor=0.3, sensory=[0.1, 0.2]), np.array([0.02])
    trial = simulate_person(law, person, drive.disturbance, recorder=0.02, seed=1)
    levels = np.zeros((len(person.levels) + 1, 2))
    noise = NoiseDirections(np.zeros((1, 2, 2)), levels, 0)
    prepared = prepare_filter(law, person, recorder, directions(law, 2, x0=np.eye(2)), noise)
    recording = Recording(plant, trial.outputs, drive.disturbance, [0.5, 0.0])
    joint_likelihoods(prepared, [recording])
    yield "subjects who sense with noise"
