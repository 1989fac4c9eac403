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
from impc.assess import resampling
from impc.assess.covariance import GainCovariance, gain_covariance
from impc.assess.long_run_covariance import white_noise
from impc.assess.printed_gain import (
    GainEstimate,
    Interval,
    covariance_intervals,
    entry_names,
    gain_estimate,
)
from impc.assess.profiles import profile_likelihood
from impc.assess.resampling import (
    BootstrapModel,
    block_length,
    block_residuals,
    bootstrap_intervals,
    bootstrap_model,
    replicate,
)
from impc.checking import replace
from impc.errors import InputError
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.problem import Problem
from impc.inverse.residuals import misfit_or_reason
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.studies.fit.settings import FitSettings
from impc.studies.fit.subject import fit_problem
from tests.assess.cart_fits import cart_fit, cart_gain, cart_problem

SEED = 4


both_roots = pytest.mark.parametrize("root", [0.0, 0.9], ids=["white", "coloured"])


def test_replicates_draw_what_is_known_of_the_body_again() -> None:
    """A mass known to 10 % makes a gain on force equally uncertain; there is no other noise."""
    plant = cart()
    family = impc.PlantFamily(
        lambda mass: replace(plant, B=plant.B / mass[0]), ["mass"], [1.0], {"mass": "10 %"}
    )
    push = 0.4 * np.random.default_rng(0).standard_normal(300)
    bounds = impc.Bounds(plant, u_min=-9, u_max=9)
    law = impc.Controller(plant, impc.Weights(np.diag([4.0, 1.0]), 1), bounds, 10)
    y = law.simulate([0, 0], disturbance=push).outputs
    noise = 1e-3 * np.random.default_rng(1).standard_normal(y.shape)
    trials = [Recording(plant, y + noise, push)]
    posed = Problem(plant, bounds, 10, trials, unknown_start=True, family=family)
    at = gain_estimate(fit_controller(posed))
    model = model_of(at)
    repeated = [replicate(model, index, SEED) for index in range(40)]
    spread = np.std([np.log(one.K[0, 0] / at.K[0, 0]) for one in repeated])
    assert 0.07 < spread < 0.13
    found = bootstrap_intervals(at, repeated, "bootstrap", 0.95)
    assert [one.name for one in found] == list(entry_names(plant))


def first_order(root: float, samples: int, seed: int) -> Array:
    rng = np.random.default_rng(seed)
    white = rng.standard_normal((samples + 500, 2)) @ np.array([[1.0, 0.6], [0.0, 0.8]])
    return np.asarray(scipy.signal.lfilter([1.0], [1.0, -root], white, axis=0)[500:])


def model_of(at: GainEstimate) -> BootstrapModel:
    return bootstrap_model(at.problem, np.array(at.K), np.array(at.S))


def white_covariance(estimate: GainEstimate) -> GainCovariance:
    """Covariance for white residuals."""
    at = estimate.problem, np.array(estimate.K), np.array(estimate.S)
    return gain_covariance(*at, white_noise, curvature=True)


def width(found: tuple[Interval, ...]) -> Array:
    return np.array([item.high - item.low for item in found])


@pytest.mark.full
@both_roots
def test_bootstrap_agrees_with_the_sandwich(root: float) -> None:
    """30 replicates, seed 4: widths within a third of the sandwich's."""
    estimate = cart_gain(SEED, root=root)
    sandwich = width(covariance_intervals(estimate, estimate.covariance, "sandwich"))
    model = model_of(estimate)
    found = [replicate(model, index, SEED) for index in range(30)]
    ratio = width(bootstrap_intervals(estimate, found, "bootstrap", 0.95)) / sandwich
    assert np.all(np.abs(np.log(ratio)) < np.log(1.5)), ratio


@pytest.mark.full
@both_roots
def test_profile_agrees_with_the_sandwich(root: float) -> None:
    """Nearly quadratic, so nearly equal ends."""
    estimate = cart_gain(SEED, root=root)
    for item in covariance_intervals(estimate, estimate.covariance, "sandwich"):
        found = profile_likelihood(estimate, item.name).interval
        assert found.low == pytest.approx(item.low, abs=0.15 * (item.high - item.low))
        assert found.high == pytest.approx(item.high, abs=0.15 * (item.high - item.low))
        assert found.low < found.value < found.high  # type: ignore[operator]


@pytest.mark.full
def test_plain_intervals_are_narrower_with_coloured_noise() -> None:
    estimate = cart_gain(SEED, root=0.9)
    plain = width(covariance_intervals(estimate, white_covariance(estimate), "white"))
    sandwich = width(covariance_intervals(estimate, estimate.covariance, "sandwich"))
    assert np.all(sandwich > 2 * plain)


@pytest.mark.full
@both_roots
def test_profile_against_brute_force(root: float) -> None:
    """D at one value against a grid search over the other entry, initial state refitted."""
    fitted = cart_fit(SEED, root=root)
    problem = replace(fitted.problem, unknown_start=False)
    known = gain_estimate(replace(fitted, problem=problem))
    name = entry_names(problem.plant)[0]
    profile = profile_likelihood(known, name)
    value, distance = profile.values[0], profile.distances[0]
    S = np.array(known.S)

    def squared(first: float, second: float) -> float:
        return misfit_or_reason(problem, np.array([[first, second]]), S)[0] ** 2

    K = np.array(known.K)[0]
    grid = K[1] + np.linspace(-0.5, 0.5, 401)
    held = min(squared(value, second) for second in grid)
    best = profile.values[int(np.argmin(profile.distances))]
    least = min(squared(best, second) for second in grid)
    variance = least / sum(trial.outputs.size for trial in problem.recordings)
    factor = max((known.covariance.entries[0, 0] / white_covariance(known).entries[0, 0]) ** 2, 1.0)
    assert distance == pytest.approx((held - least) / (variance * factor), rel=0.05, abs=0.05)


def test_what_is_not_determined_has_no_end() -> None:
    """A third state that nothing excites: its gain entry is not identified."""
    base = cart()
    A, B = (
        scipy.linalg.block_diag(base.A, np.array([[0.5]])),
        np.vstack([np.hstack([base.B, base.E]), [0, 0]]),
    )
    system = control.ss(A, B, np.hstack([base.C, [[0]]]), 0, base.dt, inputs=["force", "push"])
    plant = Plant(system, ["force"])
    trial = noisy_trial(SEED, 0.0)
    again = Recording(plant, trial.outputs, trial.disturbance)
    problem = fit_problem(plant, [again], FitSettings(horizon=10, u_max=1.0))
    estimate = gain_estimate(fit_controller(problem))
    names = entry_names(plant)
    assert np.isinf(profile_likelihood(estimate, names[2]).interval.high)
    assert np.isfinite(profile_likelihood(estimate, names[0]).interval.high)
    assert estimate.covariance.individually_identified.tolist() == [[True, True, False]]


def test_an_unknown_name_is_told() -> None:
    with pytest.raises(InputError, match=r"choose from: K\.force"):
        profile_likelihood(cart_gain(SEED), "mass")


@both_roots
def test_a_replicate_depends_on_seed_and_number_only(root: float) -> None:
    at = cart_gain(SEED, root=root)
    alone = replicate(model_of(at), 3, SEED)
    model = model_of(at)
    after = [replicate(model, index, SEED) for index in (2, 3)][1]
    np.testing.assert_array_equal(alone.K, after.K)
    assert not np.array_equal(replicate(model, 3, SEED + 1).K, alone.K)


@both_roots
def test_a_replicate_ends_where_a_whole_fit_of_its_recordings_does(
    root: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Against a full fit (weights, then identified gain): within 0.01 standard errors.

    The full fit uses the recordings drawn by the replicate.
    """
    at = cart_gain(SEED, root=root)
    kept: list[list[Array]] = []

    def keep(residuals: list[Array], rng: np.random.Generator) -> list[Array]:
        kept.append(block_residuals(residuals, rng))
        return kept[-1]

    monkeypatch.setattr(resampling, "block_residuals", keep)
    model = model_of(at)
    found = replicate(model, 0, SEED)
    trials = tuple(
        replace(trial, outputs=outputs + noise)
        for trial, outputs, noise in zip(
            at.problem.recordings, model.measured, kept[0], strict=True
        )
    )
    whole = gain_estimate(fit_controller(replace(cart_problem(SEED, root=root), recordings=trials)))
    assert np.all(np.abs(found.K - whole.K) < 0.01 * whole.covariance.entries)
    assert np.all(np.abs(found.K - at.K) > 0.01 * whole.covariance.entries)


@pytest.mark.parametrize("root", [0.0, 0.9])
def test_drawn_residuals_have_the_colour_of_the_given(root: float) -> None:
    """Variance, cross-correlation and autocorrelation; 40 draws of 2 x 2000 samples."""
    given = [first_order(root, 2000, SEED), first_order(root, 1500, SEED + 1)]
    rng = np.random.default_rng(SEED)
    drawn = [block_residuals(given, rng) for _ in range(40)]
    assert [part.shape for part in drawn[0]] == [(2000, 2), (1500, 2)]

    def moments(trials: list[Array]) -> Array:
        lagged = sum(part[1:].T @ part[:-1] for part in trials) / sum(map(len, trials))
        return np.concatenate([np.cov(np.concatenate(trials).T).ravel(), np.ravel(lagged)])

    found = np.mean([moments(part) for part in drawn], axis=0)
    expected = moments([part - part.mean(axis=0) for part in given])
    np.testing.assert_allclose(found, expected, atol=0.08 * np.max(np.abs(expected)))


def test_block_length_of_first_order_noise() -> None:
    """Closed form of Politis and White at the estimated coefficient."""
    given = [first_order(0.9, 4000, SEED)]
    assert block_length(given) == pytest.approx(
        np.cbrt(6 * 0.81 / (1 - 0.81) ** 2 * 4000), rel=0.15
    )
    assert block_length([np.zeros((50, 1))]) == 1
