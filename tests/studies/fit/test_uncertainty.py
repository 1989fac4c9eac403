"""All analyses of uncertainty on the cart; comparison of alternatives with the truth."""

from __future__ import annotations

import numpy as np
import pytest

import impc
from experiments.coverage import true_controller
from experiments.printed_intervals import carts, fit, noisy_recording, regulator
from impc.assess.covariance import gain_covariance
from impc.assess.long_run_covariance import white_noise
from impc.assess.printed_gain import gain_estimate
from impc.assess.profiles import profile_likelihood
from impc.studies.fit.first import FitProgress
from impc.studies.fit.result import FitResult
from impc.studies.fit.subject import fit_recordings, stages
from impc.studies.fit.uncertainty import fit_alternatives
from tests.assess.cart_fits import cart_fit, cart_problem
from tests.support import present

SEEDS = (11, 12)
EXTRAS = impc.FitSettings(
    horizon=10, u_max=1.0, replicates=20, profiles=["K.force.x[1]"], unknown_limit=True,
    horizons=[1, 10, 20],
)  # fmt: skip


@pytest.fixture(scope="module")
def result() -> FitResult:
    heard: list[str] = []
    problem = cart_problem(*SEEDS)
    found = fit_recordings(problem, EXTRAS, FitProgress(heard.append))
    assert tuple(heard) == stages(problem, EXTRAS)
    return found


@pytest.mark.full
def test_every_interval_holds_the_truth(result: FitResult) -> None:
    """Seeds 11 and 12, fixed before the run; 95 % intervals of two entries and the limit."""
    truth = dict(zip(("K.force.x[0]", "K.force.x[1]"), true_controller().K[0], strict=True))
    truth["u_max.force"] = 1.0
    methods = {item.method for item in result.uncertainty.intervals}
    assert methods == {"sandwich", "block", "profile"}
    for item in result.uncertainty.intervals:
        assert item.low < truth[item.name] < item.high, item
        assert item.value is not None


@pytest.mark.full
def test_the_set_of_weights_is_described(result: FitResult) -> None:
    found = present(result.uncertainty.weights)
    Q = result.intent.reported.weights.Q
    for item in found.entries:
        i, j = (result.fitted.problem.plant.states.index(n) for n in (item.first, item.second))
        assert item.low <= Q[i, j] * (1 + 1e-6) + 1e-9
        assert Q[i, j] <= item.high + 1e-6 * abs(item.high)
    assert len(found.statements) == 2


@pytest.mark.full
def test_the_limit_is_told_from_none_and_short_horizons_too(result: FitResult) -> None:
    """True limit 1 and N = 10: "no limit" is ruled out, N = 20 is not distinguished."""
    by_name = {item.name: item for item in result.uncertainty.alternatives}
    assert list(by_name) == ["as fitted", "no limit", "horizon 1", "horizon 20"]
    first = by_name["as fitted"]
    assert first.aic < 2
    assert by_name["no limit"].aic > 10
    assert by_name["no limit"].held_out < first.held_out
    assert by_name["horizon 20"].aic < 2


def test_aic_is_that_of_the_innovations() -> None:
    """White residuals of one output: T log of the mean square, up to a common constant."""
    problem = cart_problem(SEEDS[0])
    found = fit_alternatives(problem, cart_fit(SEEDS[0]), [20], 1.0)
    misfits = np.array([item.misfit for item in found])
    expected = problem.recordings[0].samples * np.log(misfits**2)
    differences = np.array([item.aic for item in found]) - (expected - np.min(expected))
    # The estimated coefficient of white residuals is not exactly zero.
    assert np.max(np.abs(differences)) < 0.05 * np.max(expected - np.min(expected)) + 1.0
    assert all(np.isnan(item.held_out) for item in found)


def test_profiles_of_two_inputs_end_where_deviations_say() -> None:
    """At a VAF of 99.9 % the problem is almost linear: ends at 1.96 standard errors.

    The ends differ from that by 2.6 and 1.0 %, and from each other by at most 0.5 %.
    """
    controller = regulator(carts(2))
    estimate = gain_estimate(fit(controller, noisy_recording(controller, 0, 99.9, 0.0)))
    at = estimate.problem, np.array(estimate.K), np.array(estimate.S)
    white = gain_covariance(*at, white_noise, curvature=True)
    for name, row, column in (("K.force1.x[0]", 0, 0), ("K.force2.x[1]", 1, 1)):
        found = profile_likelihood(estimate, name)
        half = 1.959964 * white.entries[row, column]
        value = estimate.K[row, column]
        np.testing.assert_allclose([value - found.low, found.high - value], half, rtol=0.05)
        assert found.low < controller.K[row, column] < found.high
