"""Compile what the tests share, once, while the checks run on the other core.

    python -m tests.warm

Each process of the tests would otherwise compile the loop and the filter for itself, 40 s and more.
"""

from __future__ import annotations

from impc.assess.expected import expected_intervals
from tests.assess.test_expected import NOISE, PRICES, cart_problem
from tests.control.test_joint_likelihood import Someone, likelihood, recorded


def main() -> None:
    """The loop with its derivatives, and a filter that meets a bound."""
    expected_intervals(cart_problem(), PRICES, NOISE)
    who = Someone(limit=0.8, horizon=1, sensory=(0.1, 0.2))
    likelihood(who, recorded(who, 40).outputs)


if __name__ == "__main__":
    main()
