"""Noise ceiling of the VAF, on outputs with known noise."""

from __future__ import annotations

import numpy as np
import pytest

import impc
from experiments.uncertain_body import cart
from impc.arrays import Array
from impc.assess.ceiling import ceiling
from tests.support import posed, present, regulator


def problem(pushes: list[Array], noise: float, seed: int = 0) -> tuple[impc.Problem, float]:
    """Pushed carts with white noise, and the noise share of the outputs, %."""
    rng, plant = np.random.default_rng(seed), cart()
    law = regulator(plant, np.diag([4.0, 1.0]), 5, 10, terminal_set=True)
    trials, squares, size = [], 0.0, 0.0
    for push in pushes:
        y = law.simulate([0, 0], disturbance=push).x[:-1, :1]
        added = noise * rng.standard_normal(y.shape)
        squares, size = squares + float(np.sum(added**2)), size + float(np.sum((y + added) ** 2))
        trials.append(impc.Recording(plant, y + added, push))
    return posed(law, *trials, unknown_start=True), 100 * (1 - squares / size)


def push(seed: int, samples: int = 600) -> Array:
    return np.asarray(
        0.3 * np.repeat(np.random.default_rng(seed).choice([-1.0, 0, 1], samples // 15), 15)
    )


def test_trials_with_the_same_perturbation() -> None:
    """Four trials; the interval covers the true share, and has the width of 20 draws."""
    posed, truth = problem([push(1)] * 4, 0.03)
    found = present(ceiling(posed, 0.0))
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
    found = present(ceiling(posed, 7.5))
    assert found.repetitions == 4
    assert found.vaf[0] == pytest.approx(truth, abs=3.0)


@pytest.mark.parametrize(
    ("pushes", "repeats"),
    [
        ([push(1), push(2)], False),
        ([np.zeros(300)] * 2, False),
        ([np.full(600, 0.2)], False),  # a lasting push is not periodic
        ([np.tile(push(2, 150), 4) + 1.0], True),
    ],
)
def test_what_does_not_repeat_has_none(pushes: list[Array], repeats: bool) -> None:
    assert (ceiling(problem(pushes, 0.03)[0], 0.0) is not None) == repeats


def test_targets_count_as_what_drives() -> None:
    """The same push towards two targets is no repetition; towards one target it is."""
    plant, rng, force = cart(), np.random.default_rng(3), push(1)
    bounds = impc.Bounds(plant, u_min=-5, u_max=5)
    paths = [np.repeat(rng.standard_normal(40), 15) for _ in range(2)]
    for pair in (paths, [paths[0]] * 2):
        trials = [
            impc.Recording(plant, rng.standard_normal((600, 1)), force, target={"pos": path})
            for path in pair
        ]
        found = ceiling(impc.Problem(plant, bounds, 10, trials, unknown_start=True), 0.0)
        assert (found is None) == (pair is paths)
