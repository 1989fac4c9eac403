"""Machine code of a body: what is shared, and what is written."""

from __future__ import annotations

import numpy as np

from impc.control.body_steps import address, body_tape, next_state
from impc.control.compiled_body import states_along
from tests.control.hanging_body import pendulum


def test_bodies_that_differ_by_parameters_share_their_code() -> None:
    """A family of plants is translated once; the constants are those of each."""
    one, other = pendulum(2.1), pendulum(2.2)
    assert one.body is not None
    assert other.body is not None
    assert address(one.body, 2, moving=True) == address(other.body, 2, moving=True)
    assert address(one.body, 2, moving=True) != address(one.body, 2, moving=False)
    given = np.array([0.4, -0.2]), np.array([0.3]), np.array([0.1])
    assert np.any(next_state(one, *given) != next_state(other, *given))


def test_the_same_states_with_derivatives_and_without() -> None:
    """To the last digit, and without them nothing behind the states is written."""
    body = pendulum().body
    x, rest = np.random.default_rng(0).standard_normal((30, 2)), np.zeros((30, 1))
    found = []
    for moving in (False, True):
        tape, ahead = body_tape(body, 2, 4, moving=moving), np.empty((30, 2))
        states_along(tape, x, rest, rest, ahead)
        assert bool(np.any(tape.slopes)) == moving
        found.append(ahead)
    assert np.array_equal(found[0], found[1])
