"""Compile what the tests share, once, while the checks run on the other core.

    python -m tests.warm

Each process of the tests would otherwise compile the loop, its saturated plans and the filter for
itself, a minute and more.
"""

from __future__ import annotations

import numpy as np

from impc.assess.expected import expected_intervals
from impc.checking import replace
from impc.control.closed_loop import prepare_loop, simulate
from impc.control.constraint_rows import directions
from impc.control.controller import Controller
from impc.control.saturated import solve_saturated
from impc.control.simulation import scenario
from impc.model.bounds import Bounds
from tests.assess.test_expected import NOISE, PRICES, cart, cart_problem
from tests.control.test_joint_likelihood import Someone, likelihood, recorded


def main() -> None:
    """The loop with its derivatives, by another solver and by stages, and a filter at a bound."""
    expected_intervals(cart_problem(), PRICES, NOISE)
    plant, structure, push = cart()
    bounds = Bounds(plant, u_min=-1, u_max=1)
    law = Controller(plant, structure.weights(PRICES), bounds, 8, terminal_set=False)
    simulate(replace(law, solver="daqp"), scenario(plant, np.zeros(2), disturbance=push))
    matrices = prepare_loop(law, directions(law, 0)).matrices
    sides = np.array(bounds.u_min), np.array(bounds.u_max)
    solve_saturated(matrices, np.array(law.S), *sides, law.horizon, np.array([9.0, 0.0]))
    who = Someone(limit=0.8, horizon=1, sensory=(0.1, 0.2))
    likelihood(who, recorded(who, 40).outputs)


if __name__ == "__main__":
    main()
