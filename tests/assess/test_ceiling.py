"""Noise ceiling of the VAF, on outputs with known noise."""

from __future__ import annotations

import numpy as np
import pytest

import impc
from experiments.uncertain_body import cart
from impc.arrays import Array
from impc.assess.ceiling import ceiling
from impc.inverse.problem import Problem


def problem(pushes: list[Array], noise: float, seed: int = 0) -> tuple[Problem, float]:
    """Pushed carts with white noise, and the noise share of the outputs, %."""
    rng, plant = np.random.default_rng(seed), cart()
    bounds = impc.Bounds(plant, u_min=-5, u_max=5)
    law = impc.Controller(plant, impc.Weights(np.diag([4.0, 1.0]), 1), bounds, 10)
    trials, squares, size = [], 0.0, 0.0
    for push in pushes:
        y = law.simulate([0, 0], disturbance=push).x[:-1, :1]
        added = noise * rng.standard_normal(y.shape)
        squares, size = squares + float(np.sum(added**2)), size + float(np.sum((y + added) ** 2))
        trials.append(impc.Recording(plant, y + added, push))
    return Problem(plant, bounds, 10, trials, unknown_start=True), 100 * (1 - squares / size)


def push(seed: int, samples: int = 600) -> Array:
    return np.asarray(
        0.3 * np.repeat(np.random.default_rng(seed).choice([-1.0, 0, 1], samples // 15), 15)
    )


def test_trials_with_the_same_perturbation() -> None:
    """Four trials; the interval covers the true share, and has the width of 20 draws."""
    posed, truth = problem([push(1)] * 4, 0.03)
    found = ceiling(posed, 0.0)
    assert found is not None
    assert found.repetitions == 4
    assert found.low[0] <= truth <= found.high[0]
    values = [
        one.vaf[0] - share
        for seed in range(20)
        for made, share in [problem([push(1)] * 4, 0.03, seed)]
        if (one := ceiling(made, 0.0)) is not None
    ]
    assert abs(np.mean(values)) < 4 * np.std(values) / np.sqrt(20)
    assert 0.4 < (found.high[0] - found.low[0]) / 3.92 / np.std(values) < 3


def test_a_periodic_perturbation_in_one_trial() -> None:
    """Five periods: the first is excluded, four repetitions remain."""
    posed, truth = problem([np.tile(push(2, 150), 5)], 0.03)
    found = ceiling(posed, 7.5)
    assert found is not None
    assert found.repetitions == 4
    assert found.vaf[0] == pytest.approx(truth, abs=3.0)


def test_what_does_not_repeat_has_none() -> None:
    assert ceiling(problem([push(1), push(2)], 0.03)[0], 0.0) is None
    assert ceiling(problem([np.zeros(300)] * 2, 0.03)[0], 0.0) is None


def test_targets_count_as_what_drives() -> None:
    """The same push towards two targets is no repetition; towards one target it is."""
    plant, rng = cart(), np.random.default_rng(3)
    bounds, force = impc.Bounds(plant, u_min=-5, u_max=5), push(1)
    paths = [np.repeat(rng.standard_normal(40), 15) for _ in range(2)]

    def found(first: Array, second: Array) -> object:
        trials = [
            impc.Recording(plant, rng.standard_normal((600, 1)), force, target={"pos": path})
            for path in (first, second)
        ]
        return ceiling(Problem(plant, bounds, 10, trials, unknown_start=True), 0.0)

    assert found(*paths) is None
    assert found(paths[0], paths[0]) is not None


def test_a_lasting_push_is_not_periodic() -> None:
    assert ceiling(problem([np.full(600, 0.2)], 0.03)[0], 0.0) is None
    assert ceiling(problem([np.tile(push(2, 150), 4) + 1.0], 0.03)[0], 0.0) is not None
