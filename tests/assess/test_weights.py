"""Whether cost weights explain a gain; statements on intent that hold for all drawn gains."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import impc
from experiments.coverage import cart
from experiments.search_problems import stick
from impc.arrays import Array
from impc.assess.covariance import GainCovariance, gain_covariance
from impc.assess.printed_gain import gain_estimate
from impc.assess.weights_ranges import WeightsSummary, drawn_gains, summarise_weights
from impc.assess.weights_test import WeightsTest, return_difference, weights_test
from impc.inverse.equivalent_weights import weights_margin
from impc.studies.fit.result import FittedParameter
from plants import yalmip_example
from tests.assess.cart_fits import cart_fit
from tests.support import plant_of, posed, present, random_plant, random_weights, regulator


def compared(problem: impc.Problem) -> WeightsTest:
    fitted = impc.fit(problem)
    return weights_test(fitted, gain_estimate(fitted))


def noisy_problem(seed: int) -> impc.Problem:
    """Random optimal regulator of one to three states, with 2 % noise."""
    rng = np.random.default_rng([470, seed])
    n = 1 + seed % 3
    plant = random_plant(rng, n, 1, rng.uniform(0.8, 1.1), d=1)
    law = regulator(plant, random_weights(rng, n), np.inf, 3, random_weights(rng, 1))
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
    gain = impc.solve_lqr(example, impc.Weights(np.eye(2), 1)).K
    found = present(return_difference(example, gain))
    assert found.least == pytest.approx(0.1754, abs=1e-4)
    assert found.needed == pytest.approx(0.1572, abs=1e-4)
    assert found.kept
    plant, kept, exist = impc.Plant(stick(), ["finger"]), [], []
    for pair in itertools.product(np.linspace(-60, -16, 8), np.linspace(-12, -2, 6)):
        K = np.array([pair])
        if np.max(np.abs(np.linalg.eigvals(plant.A - plant.B @ K))) <= 0.999:
            found = present(return_difference(plant, K))
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


SIZES = np.array([1.0, 1.0])


@pytest.fixture(scope="module")
def fitted() -> tuple[impc.Estimate, GainCovariance]:
    found = cart_fit(3)
    K, S = np.array(found.gain), np.array(found.metric)
    return found, gain_covariance(found.problem, K, S)


def test_drawn_gains_spread_as_their_covariance(
    fitted: tuple[impc.Estimate, GainCovariance],
) -> None:
    """300 draws: centre to 0.2 standard errors, standard errors along both directions to 15 %."""
    found, covariance = fitted
    drawn = drawn_gains(cart(), found.stage_weights, found.gain, covariance, 300)
    off = np.array([covariance.along(one.K - found.gain) for one in drawn])
    scaled = off / covariance.deviations
    np.testing.assert_allclose(np.std(scaled, axis=0), 1.0, atol=0.15)
    assert np.all(np.abs(np.mean(scaled, axis=0)) < 0.2)
    for one in drawn[:5]:
        np.testing.assert_allclose(impc.solve_lqr(cart(), one.weights).K, one.K)
    again = drawn_gains(cart(), found.stage_weights, found.gain, covariance, 2)
    np.testing.assert_array_equal(again[1].K, drawn[1].K)


def test_a_statement_is_made_only_when_other_gains_agree(
    fitted: tuple[impc.Estimate, GainCovariance],
) -> None:
    """Same gain and weights: well identified, and almost unidentified."""
    found, covariance = fitted
    K, metrics = np.array(found.gain), np.array(found.metrics)
    bare = summarise_weights(cart(), K, metrics, SIZES)
    held = [item for item in bare.statements if item.holds is not None]
    assert held, "at the fitted gain a cost weight is above the other"
    assert not any(item.made for item in bare.statements), "nothing was tried"

    def drawn(deviations: Array) -> WeightsSummary:
        there = impc.replace(covariance, deviations=deviations)
        draws = drawn_gains(cart(), found.stage_weights, K, there)
        return summarise_weights(cart(), K, metrics, SIZES, lambda: draws)

    identified, unknown = drawn(covariance.deviations), drawn(np.full(2, np.inf))
    for outcome in (identified, unknown):
        assert [item.holds for item in outcome.statements] == [
            item.holds for item in bare.statements
        ]
    assert any(item.made for item in identified.statements)
    assert not any(item.made for item in unknown.statements)


def test_a_parameter_that_stays_where_it_began_is_not_determined() -> None:
    assert not FittedParameter("lag", 0.08, 0.0812, 0.0812 * 1400).determined
    assert not FittedParameter("lag", 0.08, 0.0812, np.inf).determined
    assert FittedParameter("delay", 0.08, 0.09, 0.009).determined
