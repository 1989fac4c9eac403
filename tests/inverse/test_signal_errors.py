"""Errors of recorded signals are unknowns with exact derivatives, and are found."""

from __future__ import annotations

import itertools

import casadi as ca
import control
import numpy as np
import pytest

import impc
from impc.inverse.laws import GainLaw
from impc.inverse.unknowns import Unknowns
from impc.model.signal_errors import CLOCK, KINDS, distorted, resampled, undistorted
from tests.support import extrapolated_jacobian, extrapolated_slope, regulator
from tests.support import posed as asked

DT, SAMPLES, LIMIT, Q = 0.02, 300, 2.4, np.diag([40.0, 4.0])
# Units of `Recording.errors`, with time in samples: offset, drift, scale, shift, clock.
SIZES = (0.1, 2e-4, 0.1, 0.6, 2e-3)


def pushed_mass(*, bent: bool = False) -> impc.Plant:
    """Pushed mass; `bent`: the spring is a sine, and pushes depend on the angle."""
    system = control.ss(
        [[0, 1], [4, -0.3]], [[0, 0], [1, 1]], np.eye(2), 0, states=["angle", "rate"],
        inputs=["torque", "push"], outputs=["angle", "rate"],
    )  # fmt: skip
    sampled = control.c2d(system, DT, copy_names=True)
    x, w = ca.SX.sym("x", 2), ca.SX.sym("w", 2)
    given = ca.vertcat(ca.sin(x[0]), x[1]), ca.vertcat(w[0], w[1] * (1 + 0.3 * x[0]))
    ahead = ca.DM(sampled.A) @ given[0] + ca.DM(sampled.B) @ given[1]
    body = ca.Function("bent", [x, w], [ahead]) if bent else None
    return impc.Plant(sampled, controls=["torque"], body=body)


def posed(
    errors: dict[str, list[str]], noise: float = 0.0, *, bent: bool = False
) -> tuple[impc.Problem, np.ndarray]:
    """A pushed mass at its limit at times, recorded with known errors; and these errors."""
    plant, rng = pushed_mass(bent=bent), np.random.default_rng(5)
    law = regulator(plant, Q, LIMIT, 10)
    push = np.repeat(rng.choice([-2.0, 2.0], SAMPLES // 10), 10)[:, None]
    truth = np.zeros((len(KINDS), 3))
    signals = ["angle", "rate", "push"]
    for kind, names in errors.items():
        for name in names:
            row = list(KINDS).index(kind)
            truth[row, signals.index(name)] = SIZES[row]
    acting, _ = distorted(push, truth[:, 2:], held=True)
    run = law.simulate([0.05, 0.0], disturbance=acting)
    assert np.any(np.abs(run.u) > LIMIT - 1e-9)
    y = distorted(run.x, truth[:, :2], held=False)[0]
    y = y + noise * rng.standard_normal(y.shape)
    trial = impc.Recording(plant, y, push)
    problem = asked(law, trial, signal_errors=errors, unknown_start=True, terminal_set=False)
    return problem, truth


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_derivatives_of_a_distorted_signal_are_differences(kind: str, held: bool) -> None:
    rng = np.random.default_rng(0)
    signal = rng.standard_normal((60, 2))
    errors = rng.uniform(0.5, 1, (len(KINDS), 2)) * np.array(SIZES)[:, None]
    row = list(KINDS).index(kind)
    slope = distorted(signal, errors, held=held)[1][..., row]

    def moved(step: float) -> np.ndarray:
        other = errors.copy()
        other[row] += step
        return distorted(signal, other, held=held)[0]

    wanted = extrapolated_slope(moved, 1e-5)
    assert slope == pytest.approx(wanted, rel=1e-6, abs=1e-6 * np.max(np.abs(wanted)))


def test_a_shift_and_back_is_the_mean_of_neighbours_and_none_changes_nothing() -> None:
    assert list(KINDS)[CLOCK] == "clock"
    signal = np.random.default_rng(1).standard_normal((50, 1))
    none = np.zeros((len(KINDS), 1))
    for held in (False, True):
        np.testing.assert_allclose(distorted(signal, none, held=held)[0], signal, atol=1e-14)
    late = none.copy()
    late[3] = 0.25  # a quarter of a sample later
    found = distorted(signal, late, held=True)[0]
    np.testing.assert_allclose(found[1:], 0.75 * signal[1:] + 0.25 * signal[:-1])


def test_what_is_compared_has_no_errors() -> None:
    """A late, slow, wrongly scaled recording of a smooth signal is the signal again."""
    signal = np.sin(np.arange(200) / 15)[:, None]
    errors = np.array([0.1, 1e-3, 0.1, 4.6, 2e-3])[:, None]
    found = undistorted(distorted(signal, errors, held=False)[0], errors)
    known = np.isfinite(found)
    assert np.count_nonzero(~known) == 5  # the end has not been recorded
    assert found[known] == pytest.approx(signal[known], abs=2e-3)


def test_derivatives_of_outputs_are_moved_with_them() -> None:
    rng = np.random.default_rng(2)
    table, errors = rng.standard_normal((40, 2, 3)), np.array(SIZES)[:, None] * np.ones(2)
    wanted = [distorted(table[..., k], errors, held=False)[0] for k in range(3)]
    less = [distorted(0 * table[..., 0], errors, held=False)[0]]  # offset and drift do not move
    np.testing.assert_allclose(
        resampled(table.copy(), errors), np.stack(wanted, axis=2) - less[0][..., None]
    )


@pytest.mark.parametrize("bent", [False, True])
@pytest.mark.parametrize("signal", ["angle", "push"])
@pytest.mark.parametrize("kind", KINDS)
def test_every_column_of_the_search_is_a_difference(kind: str, signal: str, bent: bool) -> None:
    problem, truth = posed({kind: [signal]}, bent=bent)
    errors = np.array([0.5 * truth])
    here = problem.at(problem.starts, problem.logarithms, errors)
    space = Unknowns(here, GainLaw(here, np.array([[9.0, 3.0]]), np.eye(1)))
    residual = space.evaluated(space.start)[0]

    def moved(z: np.ndarray) -> np.ndarray:
        found = space.residual(z)
        assert found is not None
        return found

    wanted = residual.residual @ extrapolated_jacobian(moved, space.start, 1e-4)
    found = space.pulled(space.start, residual.residual)
    assert found == pytest.approx(wanted, rel=2e-4, abs=1e-6)


@pytest.mark.parametrize(
    ("kind", "signal"), [*itertools.product(KINDS, ["angle"]), ("scale", "push"), ("shift", "push")]
)
def test_an_error_of_a_signal_is_found_with_the_gain(kind: str, signal: str) -> None:
    problem, truth = posed({kind: [signal]}, noise=1e-4)
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
    problem, _ = posed({"shift": ["push"]}, noise=1e-3)
    free = impc.fit(problem)
    fixed = impc.fit(impc.replace(problem, signal_errors=()))
    gain = regulator(problem.plant, Q, LIMIT, 10).K
    assert free.misfit < 0.5 * fixed.misfit
    assert np.linalg.norm(free.gain - gain) < 0.3 * np.linalg.norm(fixed.gain - gain)


@pytest.mark.parametrize(
    ("errors", "said"),
    [({"shift": ["nose"]}, "no signal is named 'nose'"), ({"bend": ["angle"]}, "got 'bend'")],
)
def test_unknown_kinds_and_signals_are_refused(errors: dict[str, list[str]], said: str) -> None:
    problem, _ = posed({})
    with pytest.raises(impc.InputError, match=said):
        impc.Problem(problem.plant, problem.bounds, 10, problem.recordings, signal_errors=errors)


def test_a_push_that_the_controller_knows_cannot_be_moved() -> None:
    problem, _ = posed({})
    plant = impc.with_observer(problem.plant, 2.0)
    trial = impc.Recording(plant, problem.recordings[0].outputs, problem.recordings[0].disturbance)
    with pytest.raises(impc.InputError, match="known to the controller"):
        impc.Problem(plant, impc.Bounds(plant), 10, [trial], signal_errors={"shift": ["push"]})


@pytest.mark.parametrize("finer", [False, True])
def test_a_fit_takes_the_jumps_that_predict_better(finer: bool) -> None:
    """A push held over each sample and one that jumps between samples look alike in a file."""
    plant, rng = pushed_mass(), np.random.default_rng(8)
    law = regulator(plant, Q, LIMIT, 10)
    levels = rng.choice([-2.0, 2.0], 120)
    places = np.arange(SAMPLES * 20) / 20 / 2.5  # jumps every 2.5 samples
    fine = levels[np.floor(places).astype(int)].reshape(SAMPLES, 20)
    held, means = fine[:, :1], fine.mean(axis=1, keepdims=True)
    run = law.simulate([0.05, 0.0], disturbance=means if finer else held)
    y = run.x + 2e-3 * rng.standard_normal(run.x.shape)
    trial = impc.Recording(plant, y, held, finer=np.vstack([means, means[-1:]]))
    found = impc.fit(asked(law, trial, unknown_start=True, terminal_set=False))
    (taken,) = found.problem.recordings
    np.testing.assert_array_equal(taken.disturbance[:SAMPLES], means if finer else held)
    assert taken.finer.size == 0
    assert found.gain == pytest.approx(law.K, rel=0.1)
