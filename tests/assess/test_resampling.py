"""Bootstrap and profile likelihood against the covariance, and on known noise."""

from __future__ import annotations

import control
import numpy as np
import pytest
import scipy.linalg
import scipy.signal

import impc
from experiments.coverage import cart, noisy_trial
from impc.arrays import Array
from impc.assess import printed_gain, resampling
from impc.assess.covariance import GainCovariance, gain_covariance
from impc.assess.long_run_covariance import white_noise
from impc.assess.profiles import FitCurve, profile_likelihood
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.residuals import misfit_or_reason
from tests.assess.cart_fits import cart_fit, cart_gain, cart_problem
from tests.support import posed, regulator

SEED = 4
both_roots = pytest.mark.parametrize("root", [0.0, 0.9], ids=["white", "coloured"])


def test_replicates_draw_what_is_known_of_the_body_again() -> None:
    """A mass known to 10 % makes a gain on force equally uncertain; there is no other noise."""
    plant = cart()
    family = impc.PlantFamily(
        lambda mass: impc.replace(plant, B=plant.B / mass[0]), ["mass"], [1.0], {"mass": "10 %"}
    )
    push = 0.4 * np.random.default_rng(0).standard_normal(300)
    law = regulator(plant, np.diag([4.0, 1.0]), 9, 10, terminal_set=True)
    y = law.simulate([0, 0], disturbance=push).outputs
    noise = 1e-3 * np.random.default_rng(1).standard_normal(y.shape)
    trial = impc.Recording(plant, y + noise, push)
    at = printed_gain.gain_estimate(
        fit_controller(posed(law, trial, unknown_start=True, family=family))
    )
    repeated = [replicate(at, index) for index in range(40)]
    spread = np.std([np.log(one.K[0, 0] / at.K[0, 0]) for one in repeated])
    assert 0.07 < spread < 0.13
    found = resampling.bootstrap_intervals(at, repeated, "bootstrap", 0.95)
    assert [one.name for one in found] == list(printed_gain.entry_names(plant))


def replicate(at: printed_gain.GainEstimate, index: int, seed: int = SEED) -> resampling.Replicate:
    return resampling.replicate(at.problem, np.array(at.K), np.array(at.S), index, seed)


def white_covariance(estimate: printed_gain.GainEstimate) -> GainCovariance:
    """Covariance for white residuals."""
    at = estimate.problem, np.array(estimate.K), np.array(estimate.S)
    return gain_covariance(*at, white_noise, curvature=True)


def width(found: tuple[printed_gain.Interval, ...]) -> Array:
    return np.array([item.high - item.low for item in found])


@pytest.mark.full
@both_roots
def test_bootstrap_and_profiles_agree_with_the_sandwich(root: float) -> None:
    """30 replicates, seed 4: widths within a third of the sandwich's; nearly quadratic profiles."""
    estimate = cart_gain(SEED, root=root)
    sandwich = printed_gain.covariance_intervals(estimate, estimate.covariance, "sandwich")
    found = [replicate(estimate, index) for index in range(30)]
    ratio = width(resampling.bootstrap_intervals(estimate, found, "bootstrap", 0.95)) / width(
        sandwich
    )
    assert np.all(np.abs(np.log(ratio)) < np.log(1.5)), ratio
    for item in sandwich:
        profile, near = profile_likelihood(estimate, item.name), item.high - item.low
        assert profile.low == pytest.approx(item.low, abs=0.15 * near)
        assert profile.high == pytest.approx(item.high, abs=0.15 * near)
        assert profile.low < profile.value < profile.high  # type: ignore[operator]
    if root:  # plain intervals are narrower with coloured noise
        plain = width(
            printed_gain.covariance_intervals(estimate, white_covariance(estimate), "white")
        )
        assert np.all(width(sandwich) > 2 * plain)


@pytest.mark.full
@both_roots
def test_profile_against_brute_force(root: float) -> None:
    """D at one value against a grid search over the other entry, initial state refitted."""
    fitted = cart_fit(SEED, root=root)
    problem = impc.replace(fitted.problem, unknown_start=False)
    known = printed_gain.gain_estimate(impc.replace(fitted, problem=problem, refitted=None))
    name, K, S = printed_gain.entry_names(problem.plant)[0], np.array(known.K)[0], np.array(known.S)
    curve = FitCurve(problem, np.array(known.K), S, name)
    away = 2 * known.covariance.entries[0, 0]
    curve.loss(0.0)
    curve.refine(0.01 * away, away)

    def least(first: float) -> float:
        gains = [np.array([[first, K[1] + step]]) for step in np.linspace(-0.5, 0.5, 401)]
        return min(misfit_or_reason(problem, gain, S)[0] ** 2 for gain in gains)

    best = least(K[0] + curve.best)
    variance = best / sum(trial.outputs.size for trial in problem.recordings)
    distance = (least(K[0] - away) - best) / variance
    assert curve.rise(-away) == pytest.approx(distance, rel=0.05, abs=0.05)


def test_what_is_not_determined_has_no_end() -> None:
    """A third state that nothing excites: its gain entry is not identified."""
    base = cart()
    A = scipy.linalg.block_diag(base.A, np.array([[0.5]]))
    B = np.vstack([np.hstack([base.B, base.E]), [0, 0]])
    system = control.ss(A, B, np.hstack([base.C, [[0]]]), 0, base.dt, inputs=["force", "push"])
    plant, trial = impc.Plant(system, ["force"]), noisy_trial(SEED, 0.0)
    again = impc.Recording(plant, trial.outputs, trial.disturbance)
    settings = impc.FitSettings(horizon=10, u_max=1.0)
    fitted = fit_controller(impc.fit_problem(plant, [again], settings))
    estimate = printed_gain.gain_estimate(fitted)
    names = printed_gain.entry_names(plant)
    assert np.isinf(profile_likelihood(estimate, names[2]).high)
    assert np.isfinite(profile_likelihood(estimate, names[0]).high)
    assert estimate.covariance.individually_identified.tolist() == [[True, True, False]]
    with pytest.raises(impc.InputError, match=r"choose from: K\.force"):
        profile_likelihood(estimate, "mass")


@both_roots
def test_a_replicate_depends_on_seed_and_number_only(root: float) -> None:
    at = cart_gain(SEED, root=root)
    alone, after = replicate(at, 3), [replicate(at, index) for index in (2, 3)][1]
    np.testing.assert_array_equal(alone.K, after.K)
    assert not np.array_equal(replicate(at, 3, SEED + 1).K, alone.K)


@both_roots
def test_a_replicate_ends_where_a_whole_fit_of_its_recordings_does(root: float) -> None:
    """Against a full fit of the same draws (weights, then gain): within 0.01 standard errors."""
    at = cart_gain(SEED, root=root)
    rng = np.random.default_rng(np.random.SeedSequence(SEED, spawn_key=(0,)))
    trials = resampling.resampled_trials(at.problem, np.array(at.K), np.array(at.S), rng)
    asked = impc.replace(cart_problem(SEED, root=root), recordings=trials)
    found, whole = replicate(at, 0), printed_gain.gain_estimate(fit_controller(asked))
    assert np.all(np.abs(found.K - whole.K) < 0.01 * whole.covariance.entries)
    assert np.all(np.abs(found.K - at.K) > 0.01 * whole.covariance.entries)
