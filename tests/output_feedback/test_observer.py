"""Observers: accepted and rejected arguments, and the subject's filter."""

from __future__ import annotations

import control
import numpy as np
import pytest

from impc.errors import InputError, SolverError
from impc.model.plant import Plant
from impc.output_feedback.observer import Observer, believed_filter, believed_matrices


def cart() -> Plant:
    system = control.ss(
        [[1, 0.1], [0, 0.9]], [[0, 0], [0.1, 0.2]], [[2, 0], [0, 1]], 0, 0.1,
        states=["x", "v"], inputs=["u", "d"], outputs=["seen", "v"],
    )  # fmt: skip
    return Plant(system, ["u"])


def test_signals_are_states_and_outputs_by_name() -> None:
    person = Observer(cart(), ["x", "seen - v"], sensory=[0.1, 0.2], motor=1)
    np.testing.assert_array_equal(person.C, [[1, 0], [2, -1]])
    assert person.names(cart()) == (
        "motor u", "share u", "process x", "process v", "sensory x", "sensory seen - v"
    )  # fmt: skip


def test_levels_are_read_and_written_in_one_order() -> None:
    person = Observer(cart(), ["x"], motor=1, share=0.2, process=[3, 4], sensory=5, walk=6)
    np.testing.assert_array_equal(person.levels, [1, 0.2, 3, 4, 5, 6])
    twice = person.with_levels(2 * person.levels)
    np.testing.assert_array_equal(twice.levels, 2 * person.levels)
    assert twice.walk is not None
    known = Observer(cart(), ["x"], motor=1, sensory=5)
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
    with pytest.raises(InputError, match=message):
        Observer(cart(), **given)  # type: ignore[arg-type]


def test_a_perturbation_that_is_not_known_is_a_state_of_the_belief() -> None:
    person = Observer(cart(), ["x"], motor=0.3, sensory=0.1, walk=0.5)
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
    with pytest.raises(SolverError, match="no stationary Kalman filter"):
        believed_filter(cart(), Observer(cart(), ["v"], motor=1, sensory=1))
