"""Noise inside the loop and model error, from the residuals of subjects who are known."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.signal

from experiments.benchmarks.workloads import seat
from experiments.coverage import cart, noisy_trial
from experiments.residual_study import diagnosed
from impc.arrays import Array
from impc.assess.diagnostics import (
    ResidualDiagnostics,
    ResidualStructure,
    residual_diagnostics,
    residual_structure,
    residual_warnings,
)
from impc.assess.loop_noise import LoopNoise, loop_noise
from impc.checking import replace
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.residuals import evaluate
from impc.model.plant import Plant
from impc.studies.fit.settings import FitSettings
from impc.studies.fit.subject import fit_problem

SAMPLES, TRIALS = 1500, 2
QUICK: dict[str, Any] = {"order": 1, "horizon": 4}
SHORT = QUICK | {"duration": 15.0}


def loop() -> tuple[Plant, Array]:
    work = seat(1, 1.0)
    return work.problem.plant, np.array(work.controller.K)


def coloured(rng: np.random.Generator, a: list[float], mix: Array | None = None) -> list[Array]:
    """Noise of an autoregression for each output, innovations mixed."""
    mixed = np.eye(2) if mix is None else mix
    white = rng.standard_normal((TRIALS, SAMPLES + 1000, 2)) @ mixed.T
    return list(scipy.signal.lfilter([1.0], [1.0, *a], white, axis=1)[:, 1000:])


def through_the_loop(rng: np.random.Generator) -> list[Array]:
    """What white motor noise leaves in the outputs, sample by sample."""
    plant, K = loop()
    found = []
    for _ in range(TRIALS):
        x, rows = np.zeros(plant.n), np.zeros((SAMPLES, 2))
        for k in range(SAMPLES + 300):
            if k >= 300:
                rows[k - 300] = plant.C @ x
            x = (plant.A - plant.B @ K) @ x + plant.B[:, 0] * rng.standard_normal()
        found.append(rows / np.std(rows))
    return found


NOISES: dict[str, Callable[[np.random.Generator], list[Array]]] = {
    "white": lambda rng: coloured(rng, []),
    "first order": lambda rng: coloured(rng, [-0.9]),
    "correlated": lambda rng: coloured(rng, [-0.9], np.array([[1.0, 0.0], [-0.9, 0.44]])),
    "resonant": lambda rng: coloured(rng, [-1.97, 0.975]),
    "drifting and white": lambda rng: [
        slow + 3 * rng.standard_normal(slow.shape) for slow in coloured(rng, [-0.97])
    ],
}


@pytest.mark.parametrize("name", NOISES)
def test_noise_of_the_recorder_is_not_laid_to_the_loop(name: str) -> None:
    """Seed 0 of each colour; a hundred of each are in the slow test."""
    found = loop_noise(*loop(), NOISES[name](np.random.default_rng(0)))
    assert found is not None
    assert not found.found


@pytest.mark.slow
@pytest.mark.parametrize("name", NOISES)
def test_false_alarms_of_noise_inside_the_loop(name: str) -> None:
    """At most 5 of 100, seeds 0 to 99."""
    alarms = 0
    for seed in range(100):
        found = loop_noise(*loop(), NOISES[name](np.random.default_rng(seed)))
        assert found is not None
        alarms += found.found
    assert alarms <= 5


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_noise_that_went_through_the_loop_is_told(share: float) -> None:
    """Alone, and beside as much coloured noise in the recorder; the share is found to 0.15."""
    rng = np.random.default_rng(1)
    other = coloured(rng, [-0.9])
    mixed = [
        np.sqrt(share) * inside / np.std(inside, axis=0)
        + np.sqrt(1 - share) * outside / np.std(outside, axis=0)
        for inside, outside in zip(through_the_loop(rng), other, strict=True)
    ]
    found = loop_noise(*loop(), mixed)
    assert found is not None
    assert found.found
    np.testing.assert_allclose(found.shares, share, atol=0.15)


def test_too_little_to_test() -> None:
    plant, K = loop()
    assert loop_noise(plant, K, [np.zeros((500, 2))]) is None
    assert loop_noise(plant, K, [np.ones((500, 2))]) is None
    assert loop_noise(plant, K, [np.random.default_rng(0).standard_normal((20, 2))]) is None


@pytest.mark.parametrize("root", [0.0, 0.9])
def test_noise_knows_nothing_of_the_perturbation(root: float) -> None:
    """One recording of the cart, fitted: neither test speaks, seed 5."""
    problem = fit_problem(cart(), [noisy_trial(5, root)], FitSettings(horizon=10, u_max=1.0))
    fitted = fit_controller(problem)
    found = residual_diagnostics(fitted.problem, fitted.gain, fitted.metric)
    assert found.structure is not None
    assert not found.structure.found
    assert residual_warnings(found, ("position",), 0.1) == ()


@pytest.mark.parametrize(("colour", "most"), [(0.0, 0.15), (0.9, 0.15), (0.97, 0.15)])
def test_false_alarms_of_structure(colour: float, most: float) -> None:
    """60 recordings of the cart with noise of a colour; 5 % expected, the deviation is 3 %.

    The fit is to first order: what gain and initial state can take is taken out of the noise.
    """
    problem = fit_problem(cart(), [noisy_trial(0, 0.0)], FitSettings(horizon=10, u_max=1.0))
    fitted = fit_controller(problem)
    problem, K = fitted.problem, np.array(fitted.gain)
    clean = evaluate(problem, K, np.array(fitted.metric))
    columns = np.hstack([clean.dK.reshape(len(clean.residual), -1), clean.own])
    basis = np.linalg.qr(columns)[0]
    alarms = 0
    for seed in range(60):
        white = np.random.default_rng(seed).standard_normal(len(clean.residual) + 500)
        noise = 0.1 * scipy.signal.lfilter([1.0], [1.0, -colour], white)[500:]
        left = noise - basis @ (basis.T @ noise)
        recorded = problem.recordings[0].outputs + clean.residual[:, None] * problem.output_scale
        moved = replace(
            problem.recordings[0], outputs=recorded - left[:, None] * problem.output_scale
        )
        one = replace(problem, recordings=(moved,))
        found = residual_structure(one, K, replace(clean, residual=left))
        assert found is not None
        alarms += found.found
    assert alarms / 60 <= most


@pytest.mark.full
def test_the_default_subject_is_told_from_the_same_on_a_linear_plant() -> None:
    """Its body is nonlinear, the model's is not; six states for ten, trials of 15 s, seed 0."""
    default, linear = (diagnosed(0, name, **SHORT) for name in ("default", "linear"))
    assert default.structure is not None
    assert linear.structure is not None
    assert default.structure.found
    assert default.structure.share > 0.1
    assert not linear.structure.found
    identified = residual_warnings(default, ("theta1", "theta2"), 0.1)
    assert any("do not contain this error" in line for line in identified)


@pytest.mark.full
def test_motor_noise_with_saturation_leads_the_page() -> None:
    """Motor noise of 1 Nm, at the limit for part of the time; noise on the angles is not found."""
    found = diagnosed(0, "motor", **SHORT)
    assert found.loop is not None
    assert found.loop.found
    identified = residual_warnings(found, ("theta1", "theta2"), 0.12)
    assert "noise inside the loop and not in the recorder" in identified[0]
    assert "is at its bound for 12.0 %" in identified[0]
    recorder = diagnosed(0, "recorder", **SHORT)
    assert recorder.loop is not None
    assert not recorder.loop.found
    assert residual_warnings(recorder, ("theta1", "theta2"), 0.12) == ()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "loops", "structures"),
    [
        ("recorder", (0, 2), (0, 4)),
        ("coloured", (0, 2), (0, 4)),
        ("linear", (0, 20), (0, 4)),
        ("default", (0, 20), (19, 20)),
        ("motor", (19, 20), (0, 20)),
    ],
)
def test_twenty_subjects_of_each_kind(
    name: str, loops: tuple[int, int], structures: tuple[int, int]
) -> None:
    """Counts of 20 in which either test speaks: seeds 0 to 19, six states for ten."""
    found = [diagnosed(seed, name, **QUICK) for seed in range(20)]
    inside = sum(item.loop is not None and item.loop.found for item in found)
    model = sum(item.structure is not None and item.structure.found for item in found)
    assert loops[0] <= inside <= loops[1]
    assert structures[0] <= model <= structures[1]


def test_the_order_of_the_warnings() -> None:
    """Noise inside the loop leads where the command saturates, model error elsewhere."""
    inside = LoopNoise(np.array([0.4, 0.8]), 300.0, 9.2, 0.0)
    model = ResidualStructure(0.005, 0.3, 0.2)
    both = ResidualDiagnostics(inside, model)
    first, second = residual_warnings(both, ("a", "b"), 0.1)
    assert "80 % of the residual of b" in first
    assert "20 % of what the fit leaves" in second
    first, second = residual_warnings(both, ("a", "b"), 0.0)
    assert "20 % of what the fit leaves" in first
    assert "83 to 92 %" in second
    weak = replace(inside, shares=np.array([0.1, 0.1]))
    assert residual_warnings(ResidualDiagnostics(weak, None), ("a", "b"), 0.1) == ()
