"""Test whether cost weights explain a gain: optimal regulators, and delayed ones."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import impc
from experiments.search_problems import stick
from impc.assess.printed_gain import gain_estimate
from impc.assess.weights_test import WeightsTest, return_difference, weights_test
from impc.inverse.equivalent_weights import weights_margin
from plants import yalmip_example
from tests.support import plant_of, posed, random_plant, random_weights


def compared(problem: impc.Problem) -> WeightsTest:
    fitted = impc.fit(problem)
    return weights_test(fitted, gain_estimate(fitted))


def noisy_problem(seed: int) -> impc.Problem:
    """Random optimal regulator of one to three states, with 2 % noise."""
    rng = np.random.default_rng([470, seed])
    n = 1 + seed % 3
    plant = random_plant(rng, n, 1, rng.uniform(0.8, 1.1), d=1)
    weights = impc.Weights(random_weights(rng, n), random_weights(rng, 1))
    law = impc.Controller(plant, weights, impc.Bounds(plant), 3, terminal_set=False)
    push = rng.choice([-1.0, 0.0, 1.0], 40).repeat(5)
    x = law.simulate(np.zeros(n), disturbance=push).x[:-1]
    noisy = x + 0.02 * np.std(x, axis=0) * rng.standard_normal(x.shape)
    return posed(law, impc.Recording(plant, noisy, push))


@pytest.mark.parametrize(
    "wanted",
    [4, pytest.param(12, marks=pytest.mark.full), pytest.param(200, marks=pytest.mark.slow)],
)
def test_an_optimal_regulator_has_weights(wanted: int) -> None:
    assert [seed for seed in range(wanted) if compared(noisy_problem(seed)).rejected] == []


def test_the_inequality_of_the_readme_holds_and_is_the_linear_matrix_inequality() -> None:
    """0.1754 >= 0.1572; for other gains of the stick it agrees with the program."""
    example = impc.Plant(yalmip_example())
    found = return_difference(example, impc.solve_lqr(example, impc.Weights(np.eye(2), 1)).K)
    assert found is not None
    assert found.least == pytest.approx(0.1754, abs=1e-4)
    assert found.needed == pytest.approx(0.1572, abs=1e-4)
    assert found.kept
    plant, kept, exist = impc.Plant(stick(), ["finger"]), [], []
    for gain in itertools.product(np.linspace(-60, -16, 8), np.linspace(-12, -2, 6)):
        K = np.array([gain])
        if np.max(np.abs(np.linalg.eigvals(plant.A - plant.B @ K))) <= 0.999:
            found = return_difference(plant, K)
            assert found is not None
            kept.append(found.kept)
            exist.append(weights_margin(impc.gain_fibre(plant, K)).exist)
    assert kept == exist
    assert 0 < sum(kept) < len(kept)


def test_a_gain_without_weights_is_said_to_have_none() -> None:
    """Stick balanced by a gain that no weights have, well recorded."""
    plant = impc.Plant(stick(), ["finger"])
    K, rng = np.array([[-60.0, -4.0]]), np.random.default_rng(2)
    assert np.max(np.abs(np.linalg.eigvals(plant.A - plant.B @ K))) < 1
    law = impc.Controller.from_gain(plant, K, impc.Bounds(plant), 5, terminal_set=False)
    push = rng.choice([-1.5, 0, 1.5], 60).repeat(10)
    angle = law.simulate(np.zeros(2), disturbance=push).x[:-1, :1]
    trial = impc.Recording(plant, angle + 3e-4 * rng.standard_normal(angle.shape), push)
    found = compared(impc.fit_problem(plant, [trial], impc.FitSettings(horizon=5)))
    assert found.rejected
    assert not found.exist
    assert found.difference is not None
    assert not found.difference.kept
    assert f"here it is {found.difference.least:.3g}" in found.sentence


def test_several_inputs_and_a_delay_have_no_inequality() -> None:
    """A chain of delays is not invertible."""
    for plant in (plant_of([[0, 0], [1, 0]], [[1], [0]]), plant_of(0.5 * np.eye(2), np.eye(2))):
        assert return_difference(plant, np.zeros((plant.m, 2))) is None
