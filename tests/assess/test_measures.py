"""VAF and its ceiling, whiteness, measures of an estimate, frequency and lasting responses."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal
from statsmodels.stats.diagnostic import acorr_ljungbox
from statsmodels.stats.multitest import multipletests

import impc
from experiments import uncertain_body
from experiments.coverage import cart
from impc.arrays import Array
from impc.assess.assessments import ASSESSMENTS, MethodFit, assessed, evaluate_method
from impc.assess.ceiling import ceiling
from impc.assess.frequency_response import frequency_response
from impc.assess.printed_gain import follows_command, gain_estimate, lasting_responses
from impc.assess.several_tests import holm
from impc.assess.variance_accounted_for import centred_vaf, saturated_share, whiteness
from impc.inverse import methods
from impc.inverse.noisy_fit import fit_controller
from plants import seated_balance_for
from tests.assess.cart_fits import cart_problem
from tests.support import differences, named_plant, posed, present, regulator


def test_variance_accounted_for_by_hand() -> None:
    recorded = np.array([[3.0, 1.0], [4.0, 1.0]])
    simulated = np.array([[3.0, 0.0], [3.0, 1.0]])
    np.testing.assert_allclose(impc.vaf(recorded, simulated), [100 * (1 - 1 / 25), 50.0])
    # The second output is constant zero: VAF is undefined.
    np.testing.assert_allclose(centred_vaf(recorded, simulated), [0.0, np.nan])
    assert np.isnan(impc.vaf(np.zeros((5, 1)), np.ones((5, 1)))[0])
    # A shift counts in VAF and not in the centred one.
    y = np.sin(np.arange(100.0))[:, None]
    assert centred_vaf(y, y + 1)[0] == pytest.approx(100)
    assert impc.vaf(y, y + 1)[0] < 0


def test_whiteness_is_ljung_and_box() -> None:
    """Against statsmodels; seed 1."""
    noise = np.random.default_rng(1).standard_normal(500) + 0.3
    expected = acorr_ljungbox(noise, lags=[20])["lb_pvalue"].iloc[0]
    assert whiteness(noise[:, None], 20)[0] == pytest.approx(expected, rel=1e-9)
    coloured = scipy.signal.lfilter(
        [1.0], [1.0, -0.5], np.random.default_rng(2).standard_normal((2000, 1)), axis=0
    )
    assert whiteness(coloured, 50)[0] < 1e-6
    assert np.isnan(whiteness(np.zeros((100, 1)), 10)[0])


def test_saturated_share_counts_samples() -> None:
    u = np.array([[1.0, 0.0], [0.5, 0.0], [0.2, -2.0], [0.0, 0.0]])
    limits = np.array([1.0, 2.0])
    assert saturated_share(u, -limits, limits) == 0.5
    free = np.full(2, np.inf)
    assert saturated_share(u, -free, free) == 0.0


def test_correction_for_several_tests_is_statsmodels() -> None:
    """Equal to the last bit, including ties, values capped at 1, and NaN."""
    rng = np.random.default_rng(5)
    for count in (0, 1, 2, 7):
        given = rng.uniform(0, 0.3, count).round(1)
        expected = multipletests(given, method="holm")[1] if count else []
        np.testing.assert_array_equal(holm(given), expected)
        np.testing.assert_array_equal(holm(np.append(np.nan, given)), [np.nan, *expected])


@pytest.fixture(scope="module")
def fit() -> MethodFit:
    """Gain that exceeds the bound of the cart."""
    problem = cart_problem(21, 22)
    return evaluate_method(methods.fit(problem, "feedback_gain"), problem.bounds)


def test_numbers_of_a_gain(fit: MethodFit) -> None:
    found, u = assessed(fit), np.concatenate([run.u for run in fit.runs])
    problem = fit.estimate.problem
    recorded = np.concatenate([trial.outputs for trial in problem.recordings])[:, 0]
    simulated = np.concatenate([run.x @ problem.plant.C.T for run in fit.runs])[:, 0]
    share = 100 * (1 - np.sum((recorded - simulated) ** 2) / np.sum(recorded**2))
    plant = problem.plant
    assert found["vaf"] == pytest.approx({plant.outputs[0]: share})
    assert found["largest_input"] == {plant.controls[0]: np.max(np.abs(u))}
    assert found["beyond_bound"] == pytest.approx(100 * np.mean(np.abs(u) > 1 + 1e-6))
    for name in ("first_fall", "condition_number"):
        assert np.isnan(found[name])  # type: ignore[arg-type]
    assert np.all(np.isnan(ASSESSMENTS["held_out_vaf"].find(fit)))
    left = impc.replace(fit, held_out=np.array([[80.0], [90.0]]), fell=(None, 1.5))
    assert assessed(left)["held_out_vaf"] == {plant.outputs[0]: 85.0}
    assert assessed(left)["first_fall"] == 1.5


def test_a_method_without_a_gain(fit: MethodFit) -> None:
    none = evaluate_method(impc.replace(fit.estimate, K=None, S=None), fit.estimate.problem.bounds)
    for item in ASSESSMENTS.values():
        values = item.find(none)
        assert len(values) == len(item.signals(none.estimate.problem.plant))
        assert np.all(np.isnan(values)), item.name


def test_the_condition_number_is_that_of_both_weights(fit: MethodFit) -> None:
    problem = fit.estimate.problem
    found = methods.fit(problem, "inverse_lqr_output")
    values = np.concatenate(
        [np.linalg.eigvalsh(found.stage_weights.Q), np.linalg.eigvalsh(found.stage_weights.R)]
    )
    assert assessed(evaluate_method(found, problem.bounds))["condition_number"] == pytest.approx(
        values.max() / values.min()
    )


GAIN = np.array([[2.5, 2.2]])


def driven() -> tuple[impc.Problem, list[impc.Simulation]]:
    """Three trials of a cart under linear feedback with random pushes, and its simulations."""
    plant, rng = cart(), np.random.default_rng(0)
    bounds = impc.Bounds(plant, u_min=-1e3, u_max=1e3)
    law = impc.Controller.from_gain(plant, GAIN, bounds, 5, terminal_set=False)
    pushes = 0.3 * np.repeat(rng.standard_normal((3, 1600))[:, :400], 3, axis=1)
    runs = [law.simulate([0, 0], disturbance=push) for push in pushes]
    trials = [impc.Recording(plant, run.outputs[:-1], push)
              for run, push in zip(runs, pushes, strict=True)]  # fmt: skip
    return posed(law, *trials, unknown_start=True), runs


def test_the_response_is_the_transfer_function() -> None:
    """Magnitude and phase of the closed loop at coherent frequencies."""
    asked, runs = driven()
    found, plant = present(frequency_response(asked, runs)), asked.plant
    low = (found.frequencies > 0.2) & (found.frequencies < 1.0)
    z = np.exp(2j * np.pi * found.frequencies * plant.dt)
    closed = plant.A - plant.B @ GAIN
    gains = [plant.C @ np.linalg.solve(one * np.eye(2) - closed, plant.E) for one in z]
    true = np.array(gains)[:, 0, 0]
    np.testing.assert_allclose(found.recorded[low, 0], np.abs(true)[low], rtol=0.1)
    turned = np.degrees(np.angle(true)[low]) - found.recorded_phase[low, 0]
    assert np.max(np.abs((turned + 180) % 360 - 180)) < 8
    np.testing.assert_allclose(found.recorded, found.modelled, rtol=1e-6)
    assert np.all(found.coherence[low] > 0.9)


def test_errors_hold_what_noise_does() -> None:
    """95 % intervals cover the noise-free response in about 95 of 100."""
    (asked, runs), held = driven(), list[bool]()
    clean = present(frequency_response(asked, runs))
    for seed in range(12):
        rng = np.random.default_rng(seed + 100)
        noisy = [
            impc.replace(one, outputs=one.outputs + 0.05 * rng.standard_normal(one.outputs.shape))
            for one in asked.recordings
        ]
        found = present(frequency_response(impc.replace(asked, recordings=noisy), runs))
        k = min(len(found.frequencies), len(clean.frequencies), 25)
        off = np.abs(found.recorded[:k, 0] / clean.recorded[:k, 0] - 1)
        held += list(off <= 1.96 * found.errors[:k, 0])
    assert 0.88 < np.mean(held) < 1.0


def test_where_nothing_drives_there_is_none() -> None:
    asked, runs = driven()
    still = [impc.replace(one, disturbance=0 * one.disturbance) for one in asked.recordings]
    assert frequency_response(impc.replace(asked, recordings=still), runs) is None


def test_states_of_nerves_and_muscles_are_found() -> None:
    plant = impc.Plant(seated_balance_for(mass=70.0, height=1.7), ["command"])
    inner = dict(zip(plant.states, follows_command(plant), strict=True))
    assert [name for name, own in inner.items() if own] == [
        *(f"delay_{k}" for k in range(1, 6)), "muscle_torque"
    ]  # fmt: skip


def test_the_command_settles_at_it() -> None:
    """Tilt held at one while delay and muscle settle."""
    A = [[1.0, 0.1, 0.0], [0.2, 0.9, 0.1], [0.0, 0.0, 0.7]]
    B = [[0, 0], [0, 0.1], [0.4, 0]]
    plant = named_plant(A, B, [[1, 0, 0]], 0.1, "tilt rate muscle", "u push", "angle")
    law = regulator(plant, np.diag([4.0, 1.0, 0.1]), 9, 8, terminal_set=True)
    rng = np.random.default_rng(1)
    push = 0.5 * np.repeat(rng.standard_normal(80), 5)
    y = law.simulate([0, 0, 0], disturbance=push).outputs[:-1]
    trial = impc.Recording(plant, y + 1e-3 * rng.standard_normal(y.shape), push)
    estimate = gain_estimate(fit_controller(posed(law, trial, unknown_start=True)))
    (found,) = lasting_responses(estimate)
    K, muscle, u = np.array(estimate.K)[0], 0.0, 0.0
    for _ in range(500):
        u = -K[0] - K[2] * muscle
        muscle = 0.7 * muscle + 0.4 * u
    np.testing.assert_allclose(found.value, -u, rtol=1e-9)
    # Interval of the linearised value.
    slopes = differences(
        lambda K: np.array(lasting_responses(impc.replace(estimate, K=K))[0].value), K[None]
    )
    (error,), _ = estimate.covariance.combinations(slopes)
    np.testing.assert_allclose((found.high - found.low) / 2, 1.96 * error, rtol=1e-3)


def pushed_problem(pushes: list[Array], noise: float, seed: int = 0) -> tuple[impc.Problem, float]:
    """Pushed carts with white noise, and the noise share of the outputs, %."""
    rng, plant = np.random.default_rng(seed), uncertain_body.cart()
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
    asked, truth = pushed_problem([push(1)] * 4, 0.03)
    found = present(ceiling(asked, 0.0))
    assert found.repetitions == 4
    assert found.low[0] <= truth <= found.high[0]
    values = [
        one.vaf[0] - share
        for seed in range(20)
        for made, share in [pushed_problem([push(1)] * 4, 0.03, seed)]
        if (one := ceiling(made, 0.0)) is not None
    ]
    assert abs(np.mean(values)) < 4 * np.std(values) / np.sqrt(20)
    assert 0.4 < (found.high[0] - found.low[0]) / 3.92 / np.std(values) < 3


def test_a_periodic_perturbation_in_one_trial() -> None:
    """Five periods: the first is excluded, four repetitions remain."""
    asked, truth = pushed_problem([np.tile(push(2, 150), 5)], 0.03)
    found = present(ceiling(asked, 7.5))
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
    assert (ceiling(pushed_problem(pushes, 0.03)[0], 0.0) is not None) == repeats


def test_targets_count_as_what_drives() -> None:
    """The same push towards two targets is no repetition; towards one target it is."""
    plant, rng, force = uncertain_body.cart(), np.random.default_rng(3), push(1)
    bounds = impc.Bounds(plant, u_min=-5, u_max=5)
    paths = [np.repeat(rng.standard_normal(40), 15) for _ in range(2)]
    for pair in (paths, [paths[0]] * 2):
        trials = [
            impc.Recording(plant, rng.standard_normal((600, 1)), force, target={"pos": path})
            for path in pair
        ]
        found = ceiling(impc.Problem(plant, bounds, 10, trials, unknown_start=True), 0.0)
        assert (found is None) == (pair is paths)
