"""Errors of recorded signals are unknowns; stated timing is a prior of a time shift."""

from __future__ import annotations

import itertools

import casadi as ca
import control
import numpy as np
import pytest

import impc
from impc.arrays import Array, frozen
from impc.assess.printed_gain import GainEstimate, gain_estimate
from impc.inverse.problem import simulated
from impc.model.signal_errors import CLOCK, KINDS, SHIFT, distorted, undistorted
from tests.assess.cart_fits import joint_covariance
from tests.support import posed, regulator

DT, SAMPLES = 0.02, 300
# Units of `Recording.errors`, with time in samples: offset, drift, scale, shift, clock.
SIZES = (0.1, 2e-4, 0.1, 0.6, 2e-3)
Errors = dict[str, list[str]]


def controller(*, bent: bool = False) -> impc.Controller:
    """Of a pushed mass; `bent`: the spring is a sine, and pushes depend on the angle."""
    system = control.ss(
        [[0, 1], [4, -0.3]], [[0, 0], [1, 1]], np.eye(2), 0, states=["angle", "rate"],
        inputs=["torque", "push"], outputs=["angle", "rate"],
    )  # fmt: skip
    sampled = control.c2d(system, DT, copy_names=True)
    x, w = ca.SX.sym("x", 2), ca.SX.sym("w", 2)
    given = ca.vertcat(ca.sin(x[0]), x[1]), ca.vertcat(w[0], w[1] * (1 + 0.3 * x[0]))
    ahead = ca.DM(sampled.A) @ given[0] + ca.DM(sampled.B) @ given[1]
    body = ca.Function("bent", [x, w], [ahead]) if bent else None
    plant = impc.Plant(sampled, controls=["torque"], body=body)
    return regulator(plant, np.diag([40.0, 4.0]), 2.4, 10)


def recorded(
    law: impc.Controller, errors: Errors, noise: float = 0.0
) -> tuple[impc.Problem, np.ndarray]:
    """A pushed mass at its limit at times, recorded with known errors; and these errors."""
    rng, truth = np.random.default_rng(5), np.zeros((len(KINDS), 3))
    push = np.repeat(rng.choice([-2.0, 2.0], SAMPLES // 10), 10)[:, None]
    for kind, names in errors.items():
        row = list(KINDS).index(kind)
        truth[row, [["angle", "rate", "push"].index(name) for name in names]] = SIZES[row]
    acting = distorted(push, truth[:, 2:], held=True)
    run = law.simulate([0.05, 0.0], disturbance=acting)
    assert np.any(np.abs(run.u) > 2.4 - 1e-9)
    y = distorted(run.x, truth[:, :2], held=False)
    trial = impc.Recording(law.plant, y + noise * rng.standard_normal(y.shape), push)
    given = {"signal_errors": errors, "unknown_start": True, "terminal_set": False}
    return posed(law, trial, **given), truth


def test_a_shift_and_back_is_the_mean_of_neighbours_and_none_changes_nothing() -> None:
    assert list(KINDS)[CLOCK] == "clock"
    signal = np.random.default_rng(1).standard_normal((50, 1))
    none = np.zeros((len(KINDS), 1))
    for held in (False, True):
        np.testing.assert_allclose(distorted(signal, none, held=held), signal, atol=1e-14)
    late = none.copy()
    late[3] = 0.25  # a quarter of a sample later
    found = distorted(signal, late, held=True)
    np.testing.assert_allclose(found[1:], 0.75 * signal[1:] + 0.25 * signal[:-1])
    late[3] = 2.5  # before its first sample a held signal keeps its value, a sampled one its slope
    np.testing.assert_allclose(distorted(signal, late, held=True)[:2], signal[[0, 0]])
    found = distorted(signal, late, held=False)
    np.testing.assert_allclose(found[0], signal[0] - 2.5 * (signal[1] - signal[0]))


def test_what_is_compared_has_no_errors() -> None:
    """A late, slow, wrongly scaled recording of a smooth signal is the signal again."""
    signal = np.sin(np.arange(200) / 15)[:, None]
    errors = np.array([0.1, 1e-3, 0.1, 4.6, 2e-3])[:, None]
    found = undistorted(distorted(signal, errors, held=False), errors)
    known = np.isfinite(found)
    assert np.count_nonzero(~known) == 5  # the end has not been recorded
    assert found[known] == pytest.approx(signal[known], abs=2e-3)


@pytest.mark.parametrize(
    ("kind", "signal"), [*itertools.product(KINDS, ["angle"]), ("scale", "push"), ("shift", "push")]
)
def test_an_error_of_a_signal_is_found_with_the_gain(kind: str, signal: str) -> None:
    problem, truth = recorded(controller(), {kind: [signal]}, noise=1e-4)
    found = impc.fit(problem)
    row, column = problem.error_places[0]
    assert found.problem.errors[0, row, column] == pytest.approx(truth[row, column], rel=0.05)
    assert found.vaf == pytest.approx([100, 100], abs=0.05)
    ((said, name, values),) = found.problem.fitted_errors
    assert (said, name) == (kind, signal)
    assert values == pytest.approx(found.problem.errors[0, row, column] * DT ** KINDS[kind][3])
    assert KINDS[kind][0] in found.summary()


def test_a_moved_push_explains_what_a_fixed_one_does_not() -> None:
    """A push that acts 12 ms later than recorded moves the gain; as an unknown it does not."""
    law = controller()
    problem, _ = recorded(law, {"shift": ["push"]}, noise=1e-3)
    free, fixed = impc.fit(problem), impc.fit(impc.replace(problem, signal_errors=()))
    assert free.misfit < 0.5 * fixed.misfit
    assert np.linalg.norm(free.gain - law.K) < 0.3 * np.linalg.norm(fixed.gain - law.K)


@pytest.mark.parametrize(
    ("errors", "known", "said"),
    [
        ({"shift": ["nose"]}, False, "no signal is named 'nose'"),
        ({"bend": ["angle"]}, False, "got 'bend'"),
        ({"shift": ["push"]}, True, "known to the controller"),
    ],
)
def test_errors_that_cannot_be_asked_for(errors: Errors, known: bool, said: str) -> None:
    plant = controller().plant
    plant = impc.with_observer(plant, 2.0) if known else plant
    trial = impc.Recording(plant, np.ones((9, 2)), np.ones(9))
    with pytest.raises(impc.InputError, match=said):
        impc.Problem(plant, impc.Bounds(plant), 10, [trial], signal_errors=errors)


@pytest.mark.parametrize("finer", [False, True])
def test_a_fit_takes_the_jumps_that_predict_better(finer: bool) -> None:
    """A push held over each sample and one that jumps between samples look alike in a file."""
    law, rng = controller(), np.random.default_rng(8)
    levels = rng.choice([-2.0, 2.0], 120)
    places = np.arange(SAMPLES * 20) / 20 / 2.5  # jumps every 2.5 samples
    fine = levels[np.floor(places).astype(int)].reshape(SAMPLES, 20)
    held, means = fine[:, :1], fine.mean(axis=1, keepdims=True)
    run = law.simulate([0.05, 0.0], disturbance=means if finer else held)
    y = run.x + 2e-3 * rng.standard_normal(run.x.shape)
    trial = impc.Recording(law.plant, y, held, finer=np.vstack([means, means[-1:]]))
    found = impc.fit(posed(law, trial, unknown_start=True, terminal_set=False))
    (taken,) = found.problem.recordings
    np.testing.assert_array_equal(taken.disturbance[:SAMPLES], means if finer else held)
    assert taken.finer.size == 0
    assert found.gain == pytest.approx(law.K, rel=0.1)


LATE = 0.4  # samples


def timed(deviation: float) -> impc.Problem:
    """Recordings whose push acts later than recorded, with a stated standard deviation."""
    law, recordings, errors = controller(), [], np.zeros((5, 1))
    errors[SHIFT] = LATE
    for seed in range(2):
        rng = np.random.default_rng(seed)
        push = np.repeat(rng.choice([-2.0, 2.0], SAMPLES // 10), 10)[:, None]
        run = law.simulate([0.05, 0.0], disturbance=distorted(push, errors, held=True))
        y = run.x + 0.005 * rng.standard_normal(run.x.shape)
        timing = {"push": deviation} if deviation else None
        recordings.append(impc.Recording(law.plant, y, push, timing=timing))
    return posed(law, *recordings, unknown_start=True, terminal_set=False)


@pytest.fixture(scope="module")
def estimate() -> GainEstimate:
    return gain_estimate(impc.fit(timed(DT / 2)))


def test_a_push_with_uncertain_timing_is_moved_to_where_it_acts(estimate: GainEstimate) -> None:
    ((kind, name, values),) = estimate.problem.fitted_errors
    halves = 1.96 * DT * np.array(estimate.covariance.shifts)[0]
    assert (kind, name) == ("shift", "push")
    assert np.all(np.abs(values - LATE * DT) < halves)
    assert np.all(halves < LATE * DT)


def test_a_push_with_a_known_time_stays() -> None:
    assert timed(0.0).signal_errors == ()
    tight = impc.fit(timed(DT / 1000))
    values = tight.problem.errors[:, SHIFT, 2]
    assert np.all(np.abs(values) < 0.02)
    assert tight.misfit > 1.1 * impc.fit(timed(DT / 2)).misfit


def test_the_covariance_is_that_of_the_joint_curvature(estimate: GainEstimate) -> None:
    """The unknowns of each trial are its initial state and the shift, known to half a sample."""
    size, states = estimate.K.size, estimate.problem.searched_states
    places = [size + states, size + 2 * states + 1]
    found, cov = joint_covariance(estimate, dict.fromkeys(places, 0.5))
    expected = np.sqrt(np.diag(cov))
    np.testing.assert_allclose(np.ravel(found.entries), expected[:size], rtol=1e-6)
    np.testing.assert_allclose(np.ravel(found.shifts), expected[places], rtol=1e-6)


def test_placed_signals_simulate_as_before(estimate: GainEstimate) -> None:
    placed, K, S = estimate.problem.with_signals_placed(), estimate.K, estimate.S
    assert placed.signal_errors == ()
    assert placed.unlikely == 0
    pair = [simulated(one, np.array(K), np.array(S)) for one in (estimate.problem, placed)]
    for before, after in zip(*pair, strict=True):
        np.testing.assert_allclose(after.x, before.x, atol=1e-12)


@pytest.mark.parametrize(("name", "value"), [("wind", 0.1), ("push", -1.0), ("push", np.inf)])
def test_a_timing_that_cannot_be_is_refused(name: str, value: float) -> None:
    law = controller()
    y: Array = frozen(np.zeros((20, 2)))
    with pytest.raises(impc.DataError, match=name):
        impc.Recording(law.plant, y, timing={name: value})
