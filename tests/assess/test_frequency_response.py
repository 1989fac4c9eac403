"""Frequency responses against the transfer function of the simulation."""

from __future__ import annotations

import numpy as np

import impc
from experiments.coverage import cart
from impc.assess.frequency_response import frequency_response

GAIN = np.array([[2.5, 2.2]])


def problem(
    noise: float, seed: int = 0, trials: int = 3
) -> tuple[impc.Problem, list[impc.Simulation]]:
    """Cart under linear feedback with random pushes, and its simulations."""
    plant, rng = cart(), np.random.default_rng(seed)
    bounds = impc.Bounds(plant, u_min=-1e3, u_max=1e3)
    law = impc.Controller.from_gain(plant, GAIN, bounds, 5, terminal_set=False)
    recordings, runs = [], []
    for _ in range(trials):
        push = 0.3 * np.repeat(rng.standard_normal(400), 3)
        run = law.simulate([0, 0], disturbance=push)
        y = run.outputs[: len(push)]
        recordings.append(impc.Recording(plant, y + noise * rng.standard_normal(y.shape), push))
        runs.append(run)
    return impc.Problem(plant, bounds, 5, recordings, unknown_start=True), runs


def test_the_response_is_the_transfer_function() -> None:
    """Magnitude and phase of the closed loop at coherent frequencies."""
    posed, runs = problem(0.0)
    found = frequency_response(posed, runs)
    assert found is not None
    plant = posed.plant
    low = (found.frequencies > 0.2) & (found.frequencies < 1.0)
    z = np.exp(2j * np.pi * found.frequencies * plant.dt)
    closed = plant.A - plant.B @ GAIN
    gains = [plant.C @ np.linalg.solve(one * np.eye(2) - closed, plant.E) for one in z]
    true = np.array(gains)[:, 0, 0]
    np.testing.assert_allclose(found.recorded[low, 0], np.abs(true)[low], rtol=0.1)
    turned = np.degrees(np.angle(true)[low]) - found.recorded_phase[low, 0]
    assert np.max(np.abs((turned + 180) % 360 - 180)) < 8
    np.testing.assert_allclose(found.recorded, found.modelled, rtol=1e-6)
    assert np.all(found.coherence[low] > 0.9)


def test_errors_hold_what_noise_does() -> None:
    """95 % intervals cover the noise-free response in about 95 of 100."""
    clean = frequency_response(*problem(0.0))
    assert clean is not None
    held: list[bool] = []
    for seed in range(12):
        asked, runs = problem(0.0)
        rng = np.random.default_rng(seed + 100)
        noisy = [
            impc.replace(one, outputs=one.outputs + 0.05 * rng.standard_normal(one.outputs.shape))
            for one in asked.recordings
        ]
        found = frequency_response(impc.Problem(asked.plant, asked.bounds, 5, noisy), runs)
        assert found is not None
        k = min(len(found.frequencies), len(clean.frequencies), 25)
        off = np.abs(found.recorded[:k, 0] / clean.recorded[:k, 0] - 1)
        held += list(off <= 1.96 * found.errors[:k, 0])
    assert 0.88 < np.mean(held) < 1.0


def test_where_nothing_drives_there_is_none() -> None:
    asked, runs = problem(0.0)
    still = [impc.replace(one, disturbance=0 * one.disturbance) for one in asked.recordings]
    assert frequency_response(impc.Problem(asked.plant, asked.bounds, 5, still), runs) is None
