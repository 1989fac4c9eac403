"""Observers: arguments, and the subject's filter against SciPy and against differences."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.linalg

import impc
from impc.output_feedback.observer import (
    believed_filter,
    believed_matrices,
    filter_changes,
    stationary_filter,
)
from tests.support import extrapolated_slope, named_plant, random_weights


def cart() -> impc.Plant:
    A, B = [[1, 0.1], [0, 0.9]], [[0, 0], [0.1, 0.2]]
    return named_plant(A, B, [[2, 0], [0, 1]], 0.1, "x v", "u d", "seen v")


def test_signals_are_states_and_outputs_by_name() -> None:
    person = impc.Observer(cart(), ["x", "seen - v"], sensory=[0.1, 0.2], motor=1)
    np.testing.assert_array_equal(person.C, [[1, 0], [2, -1]])
    assert person.names(cart()) == (
        "motor u", "share u", "process x", "process v", "sensory x", "sensory seen - v"
    )  # fmt: skip


def test_levels_are_read_and_written_in_one_order() -> None:
    person = impc.Observer(cart(), ["x"], motor=1, share=0.2, process=[3, 4], sensory=5, walk=6)
    np.testing.assert_array_equal(person.levels, [1, 0.2, 3, 4, 5, 6])
    twice = person.with_levels(2 * person.levels)
    np.testing.assert_array_equal(twice.levels, 2 * person.levels)
    assert twice.walk is not None
    known = impc.Observer(cart(), ["x"], motor=1, sensory=5)
    assert known.with_levels(known.levels).walk is None


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"sensed": ["angle"], "sensory": 1}, "angle"),
        ({"sensed": ["x"], "sensory": 0}, "sensory: has a zero"),
        ({"motor": -1}, "motor: got"),
        ({"walk": 1}, "walk: is given, but all states are observed"),
        ({"persistence": 1.1}, "persistence: got \\[1.1\\]; give numbers between 0 and 1"),
    ],
)
def test_what_cannot_be_meant_is_refused(given: dict[str, object], message: str) -> None:
    with pytest.raises(impc.InputError, match=message):
        impc.Observer(cart(), **given)  # type: ignore[arg-type]


def test_a_perturbation_that_is_not_known_is_a_state_of_the_belief() -> None:
    person = impc.Observer(cart(), ["x"], motor=0.3, sensory=0.1, walk=0.5)
    F, C, Q, R = believed_matrices(cart(), person)
    np.testing.assert_allclose(F, np.array([[1.0, 0.1, 0.0], [0.0, 0.9, 0.2], [0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(C, [[1, 0, 0]])
    np.testing.assert_allclose(Q, np.diag(np.array([0.0, 9e-4, 0.25])))
    assert float(R[0, 0]) == pytest.approx(0.01)
    # A constant push is learned: its estimate converges to its value.
    L, true, estimate = believed_filter(cart(), person).L, np.zeros(2), np.zeros(3)
    for _ in range(400):
        error = true[:1] - C @ estimate
        true = cart().A @ true + cart().E @ [0.7]
        estimate = F @ estimate + L @ error
    assert estimate[2] == pytest.approx(0.7, abs=1e-6)  # decays by 0.8 a sample


def test_who_is_never_disturbed_and_does_not_decay_has_no_filter() -> None:
    with pytest.raises(impc.SolverError, match="no stationary Kalman filter"):
        believed_filter(cart(), impc.Observer(cart(), ["v"], motor=1, sensory=1))


@pytest.mark.parametrize("radius", [0.7, 0.99, 1.3])
def test_it_is_the_riccati_solution_of_scipy(radius: float) -> None:
    rng = np.random.default_rng([1, round(100 * radius)])
    for n, p in ((1, 1), (4, 2), (9, 3)):
        F = rng.normal(size=(n, n))
        F *= radius / np.max(np.abs(np.linalg.eigvals(F)))
        C, Q, R = rng.normal(size=(p, n)), random_weights(rng, n), random_weights(rng, p)
        found = stationary_filter(F, C, Q, R)
        expected = scipy.linalg.solve_discrete_are(F.T, C.T, Q, R)
        # Both are off by rounding: at most 1e-12 here.
        np.testing.assert_allclose(found.P, expected, rtol=0, atol=1e-10 * np.max(expected))
        np.testing.assert_allclose(found.S, C @ found.P @ C.T + R, rtol=1e-12)


def test_units_of_states_do_not_disturb_it() -> None:
    rng = np.random.default_rng(2)
    F, C = rng.normal(size=(4, 4)) / 3, rng.normal(size=(2, 4))
    Q, R = random_weights(rng, 4), random_weights(rng, 2)
    unit = np.diag([1e-6, 1.0, 1e4, 1e-3])
    plain = stationary_filter(F, C, Q, R)
    scaled = stationary_filter(
        unit @ F @ np.linalg.inv(unit), C @ np.linalg.inv(unit), unit @ Q @ unit, R
    )
    np.testing.assert_allclose(np.linalg.inv(unit) @ scaled.L, plain.L, rtol=0, atol=1e-11)


def test_derivatives_equal_differences() -> None:
    rng = np.random.default_rng(3)
    F, C = rng.normal(size=(4, 4)) / 2, rng.normal(size=(2, 4))
    Q, R = random_weights(rng, 4), random_weights(rng, 2)
    dF, dC = rng.normal(size=(1, 4, 4)), rng.normal(size=(1, 2, 4))
    dQ, dR = random_weights(rng, 4)[None], random_weights(rng, 2)[None]
    found = filter_changes(stationary_filter(F, C, Q, R), (F, C), (dF, dC, dQ, dR))

    def at(step: float) -> np.ndarray:
        parts = stationary_filter(F + step * dF[0], C + step * dC[0], Q + step * dQ[0],
                                  R + step * dR[0])  # fmt: skip
        return np.concatenate([np.ravel(part) for part in parts])

    exact = np.concatenate([np.ravel(part) for part in found])
    slope = extrapolated_slope(at, 1e-3)
    np.testing.assert_allclose(exact, slope, rtol=0, atol=1e-8 * np.max(np.abs(slope)))


@pytest.mark.parametrize(
    ("F", "C", "Q", "R"),
    [
        # A mode that is not seen and does not decay.
        ([[1.2, 0], [0, 0.5]], [[0, 1]], np.eye(2), [[1]]),
        # Observed but without process noise: the filter that never forgets is not stable.
        ([[1.2, 0], [0, 0.5]], np.eye(2), np.zeros((2, 2)), np.eye(2)),
        # Two almost equal signals with almost no noise: their covariance is singular.
        ([[1, 0.1], [0, 1]], [[1, 0], [1, 1e-12]], np.eye(2), 1e-40 * np.eye(2)),
    ],
)
def test_where_there_is_no_filter(F: Any, C: Any, Q: Any, R: Any) -> None:
    with pytest.raises(impc.SolverError, match="no stationary Kalman filter"):
        stationary_filter(*(np.array(one, dtype=np.float64) for one in (F, C, Q, R)))
