"""Drawn gains, and statements on intent that hold for all of them."""

from __future__ import annotations

import numpy as np
import pytest

import impc
from experiments.coverage import cart
from impc.arrays import Array
from impc.assess.covariance import GainCovariance, gain_covariance
from impc.assess.weights_ranges import WeightsSummary, drawn_gains, summarise_weights
from impc.studies.fit.result import FittedParameter
from tests.assess.cart_fits import cart_fit

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
