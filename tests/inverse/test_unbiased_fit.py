"""A fit from which the mean of the score is taken away, and the prior that does so."""

from __future__ import annotations

import numpy as np
import pytest

from impc.arrays import Array
from impc.errors import SolverError
from impc.inverse import unbiased_fit
from impc.inverse.likelihood_fit import PersonFit, fit_person
from impc.inverse.methods import estimate
from impc.inverse.simulated_score import SimulatedScore, simulated_score
from impc.inverse.unbiased_fit import TiltedPrior, unbiased
from tests.inverse.noisy_cart import person, problem
from tests.support import extrapolated_slope

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def met() -> PersonFit:
    return fit_person(estimate(problem(0.7)), person())


def test_where_it_ends_the_score_is_what_it_is_on_average(met: PersonFit) -> None:
    """Along the gain, with the slope of the prior; fresh draws, within a third of a deviation."""
    found, reason = unbiased(met)
    assert reason == ""
    theta, gain = np.array(found.theta), slice(0, met.space.gain)
    score = found.told.gradient + met.prior.slopes(theta)[0] + np.array(found.unseen)
    mean = simulated_score(met.prior, theta, 77, 60).mean
    root = np.linalg.cholesky(found.told.information[gain, gain])
    assert np.all(np.abs(np.linalg.solve(root, (score - mean)[gain])) < 0.5)
    np.testing.assert_allclose(found.K, met.K, rtol=0.2)
    np.testing.assert_array_equal(unbiased(met).fit.theta, theta)


def test_the_tilted_likelihood_is_level_where_it_ends(met: PersonFit) -> None:
    """What makes others as likely is measured from there; within a third of a deviation."""
    found = unbiased(met).fit
    here = found.prior.placed(np.array(found.theta), found.told)
    slope, curvature = found.prior.parabola(here, np.array(found.unseen))
    gain = slice(0, met.space.gain)
    root = np.linalg.cholesky(curvature[gain, gain])
    assert np.all(np.abs(np.linalg.solve(root, slope[gain])) < 1 / 3)
    assert found.theta is not met.theta


def test_a_mean_that_is_not_found_leaves_the_fit_and_says_why(
    met: PersonFit, monkeypatch: pytest.MonkeyPatch
) -> None:
    def none(*_: object) -> SimulatedScore:
        raise SolverError("person", "runs away in every simulated trial", "start elsewhere")

    monkeypatch.setattr(unbiased_fit, "simulated_score", none)
    found, reason = unbiased(met)
    assert found is met
    assert "runs away in every simulated trial" in reason


@pytest.mark.parametrize("deviations", [1.5, 12.0, 400.0])
def test_no_farther_than_the_likelihood_is_a_parabola(
    met: PersonFit, monkeypatch: pytest.MonkeyPatch, deviations: float
) -> None:
    theta, q = np.array(met.theta), len(met.theta)
    begin = met.prior.placed(theta, met.told)
    curvature = met.prior.parabola(begin, np.array(met.unseen))[1]
    root = np.linalg.cholesky(curvature)
    unit = np.eye(q)[0]
    mean = deviations / np.linalg.norm(np.linalg.solve(root, unit)) * unit

    def large(*_: object) -> SimulatedScore:
        return SimulatedScore(mean, np.zeros((q, q)))

    monkeypatch.setattr(unbiased_fit, "simulated_score", large)
    found, reason = unbiased(met)
    moved = float(np.linalg.norm(root.T @ (np.array(found.theta) - theta)))
    if deviations == 1.5:
        assert reason == ""
        assert moved == pytest.approx(1.5)
    elif deviations == 12.0:
        assert reason.startswith("it is worth 12.0 standard deviations, and")
        assert moved in [pytest.approx(share * 12.0) for share in (0.5, 0.25, 0.125)]
        there = met.prior.at(np.array(found.theta))
        assert begin.value - there.value < moved**2 / 2 + 1
        further = met.prior.tried(theta + 2 * (np.array(found.theta) - theta))
        assert further is None or begin.value - further.value > (2 * moved) ** 2 / 2 + 1
    else:
        assert found is met
        assert reason.endswith("the likelihood is no parabola")


def test_the_tilt_of_a_prior_has_the_slope_that_it_says(met: PersonFit) -> None:
    theta, prior = np.array(met.theta), met.prior
    rng = np.random.default_rng(1)
    curvature = prior.parabola(prior.placed(theta, met.told), np.zeros(len(theta)))[1]
    root = np.linalg.cholesky(curvature)
    slope = root @ rng.standard_normal(len(theta))
    tilted = TiltedPrior(prior, theta, slope, curvature)
    np.testing.assert_allclose(tilted.slopes(theta)[0] - prior.slopes(theta)[0], slope, rtol=1e-8)
    assert tilted.value(theta) == pytest.approx(prior.value(theta), rel=1e-12)
    there = theta + np.linalg.solve(root.T, rng.standard_normal(len(theta)))
    way = np.linalg.solve(root.T, rng.standard_normal(len(theta)))

    def moved(t: float) -> Array:
        return np.array([tilted.value(there + t * way) - prior.value(there + t * way)])

    exact = (tilted.slopes(there)[0] - prior.slopes(there)[0]) @ way
    assert exact == pytest.approx(extrapolated_slope(moved, 1e-3)[0], rel=1e-6)


def test_along_directions_that_are_not_told_nothing_moves(
    met: PersonFit, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The limit of what is told is put between the two deviations of the gain."""
    theta, gain = np.array(met.theta), met.space.gain
    curvature = met.prior.parabola(met.prior.placed(theta, met.told), np.array(met.unseen))[1]
    variances, directions = np.linalg.eigh(np.linalg.inv(curvature)[:gain, :gain])
    assert gain == 2
    monkeypatch.setattr(unbiased_fit, "TOLD", float(np.prod(variances) ** 0.25))
    step = (np.array(unbiased(met).fit.theta) - theta)[:gain]
    assert abs(directions[:, 0] @ step) > 0.05 * np.sqrt(variances[0])
    assert abs(directions[:, 1] @ step) < 1e-9
    monkeypatch.setattr(unbiased_fit, "TOLD", 1e-9)
    found, reason = unbiased(met)
    np.testing.assert_allclose(found.theta, theta, rtol=1e-12)
    assert reason == ""


def test_where_no_bound_is_met_nothing_changes() -> None:
    fit = fit_person(estimate(problem(50.0)), person())
    found, reason = unbiased(fit)
    assert found is fit
    assert reason == ""
