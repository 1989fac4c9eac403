"""The stated timing of signals is a prior of their time shift, in fits and in intervals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import scipy.linalg

import impc
from impc.arrays import Array, frozen
from impc.assess.covariance import gain_covariance, slopes_at
from impc.assess.long_run_covariance import ResidualNoise
from impc.assess.printed_gain import GainEstimate, gain_estimate
from impc.errors import DataError
from impc.inverse.problem import noise_of_residual, simulated
from impc.model.signal_errors import SHIFT, distorted
from tests.inverse.test_signal_errors import DT, SAMPLES, controller
from tests.support import posed

LATE = 0.4  # samples


@dataclass(frozen=True)
class Timed:
    """A recording whose push acts later than recorded, with a stated standard deviation."""

    law: impc.Controller
    problem: impc.Problem


def timed(deviation: float, shift: float = LATE, trials: int = 2) -> Timed:
    law, recordings = controller(), []
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        push = np.repeat(rng.choice([-2.0, 2.0], SAMPLES // 10), 10)[:, None]
        errors = np.zeros((5, 1))
        errors[SHIFT] = shift
        run = law.simulate([0.05, 0.0], disturbance=distorted(push, errors, held=True))
        y = run.x + 0.005 * rng.standard_normal(run.x.shape)
        recordings.append(
            impc.Recording(law.plant, y, push, timing={"push": deviation} if deviation else None)
        )
    given = {"unknown_start": True, "terminal_set": False}
    return Timed(law, posed(law, *recordings, **given))


@pytest.fixture(scope="module")
def estimate() -> GainEstimate:
    return gain_estimate(impc.fit(timed(DT / 2).problem))


def test_a_push_with_uncertain_timing_is_moved_to_where_it_acts(estimate: GainEstimate) -> None:
    ((kind, name, values),) = estimate.problem.fitted_errors
    halves = 1.96 * DT * np.array(estimate.covariance.shifts)[0]
    assert (kind, name) == ("shift", "push")
    assert np.all(np.abs(values - LATE * DT) < halves)
    assert np.all(halves < LATE * DT)


def test_a_push_with_a_known_time_stays() -> None:
    known = timed(0.0).problem
    assert known.signal_errors == ()
    tight = impc.fit(timed(DT / 1000).problem)
    values = tight.problem.errors[:, SHIFT, 2]
    assert np.all(np.abs(values) < 0.02)
    assert tight.misfit > 1.1 * impc.fit(timed(DT / 2).problem).misfit


def test_the_covariance_is_that_of_the_joint_curvature(estimate: GainEstimate) -> None:
    """White residuals: inverse of J'J / s^2 + prior, all columns of all trials in one matrix."""
    problem, K, S = estimate.problem, np.array(estimate.K), np.array(estimate.S)
    at = slopes_at(problem, K, S)
    kept = problem.recorded_rows
    parts = np.split(np.array(at.own)[kept], np.cumsum(problem.trial_sizes)[:-1])
    on_gain = np.array(at.on_law)[kept][:, : K.size]  # in whitened coordinates
    J = np.hstack([on_gain, scipy.linalg.block_diag(*parts)])
    s = noise_of_residual(problem, np.array(at.residual)[kept])
    H = J.T @ J / s**2
    width = parts[0].shape[1]
    places = [K.size + trial * width + problem.searched_states for trial in range(len(parts))]
    H[places, places] += 1 / 0.5**2  # samples
    back = np.array(at.law.gains).reshape(K.size, -1).T
    covariance = np.linalg.inv(H)
    white = ResidualNoise(np.zeros(2), s**2 * np.eye(2)[None])
    found = gain_covariance(problem, K, S, lambda _residuals, _fitted: white)
    expected = np.sqrt(np.diag(back @ covariance[: K.size, : K.size] @ back.T))
    np.testing.assert_allclose(np.ravel(found.entries), expected, rtol=1e-6)
    shifts = np.sqrt(np.diag(covariance)[places])
    np.testing.assert_allclose(np.ravel(found.shifts), shifts, rtol=1e-6)


def test_placed_signals_simulate_as_before(estimate: GainEstimate) -> None:
    placed, K, S = estimate.problem.with_signals_placed(), estimate.K, estimate.S
    assert placed.signal_errors == ()
    assert placed.unlikely == 0
    pair = [simulated(one, np.array(K), np.array(S)) for one in (estimate.problem, placed)]
    for before, after in zip(*pair, strict=True):
        np.testing.assert_allclose(after.x, before.x, atol=1e-12)


def test_the_prior_counts_in_the_objective() -> None:
    problem = timed(DT / 2).problem
    errors = np.array(problem.errors)
    errors[:, SHIFT, 2] = [0.5, -1.0]
    moved = problem.at(np.array(problem.starts), np.zeros(0), errors)
    assert moved.unlikely == pytest.approx(1.0**2 + 2.0**2)


@pytest.mark.parametrize(("name", "value"), [("wind", 0.1), ("push", -1.0), ("push", np.inf)])
def test_a_timing_that_cannot_be_is_refused(name: str, value: float) -> None:
    law = controller()
    y: Array = frozen(np.zeros((20, 2)))
    with pytest.raises(DataError, match=name):
        impc.Recording(law.plant, y, timing={name: value})
