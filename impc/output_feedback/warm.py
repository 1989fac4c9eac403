"""Compile the numba code of the likelihood with sensory noise in advance."""

from __future__ import annotations

import numpy as np

from impc.control.constraint_rows import directions
from impc.control.warm import cart
from impc.model.recordings import Recording
from impc.output_feedback.likelihood import NoiseDirections, joint_likelihoods, prepare_filter
from impc.output_feedback.observer import Observer
from impc.output_feedback.simulation import simulate_person


def compile_filter() -> None:
    """Simulate a subject at a limit and evaluate the likelihood."""
    law, drive = cart()
    plant = law.plant
    person, recorder = Observer(plant, ["x", "v"], motor=0.3, sensory=[0.1, 0.2]), np.array([0.02])
    trial = simulate_person(law, person, drive.disturbance, recorder=0.02, seed=1)
    levels = np.zeros((len(person.levels) + 1, 2))
    noise = NoiseDirections(np.zeros((1, 2, 2)), levels, 0)
    prepared = prepare_filter(law, person, recorder, directions(law, 2, x0=np.eye(2)), noise)
    recording = Recording(plant, trial.outputs, drive.disturbance, [0.5, 0.0])
    joint_likelihoods(prepared, [recording])
