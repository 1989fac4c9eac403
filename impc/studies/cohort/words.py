"""What the columns of units.csv are, in words: for the pages of a cohort (docs/cohorts.md)."""

from __future__ import annotations

_WORDS = {
    "K": "gain of {1} to {0}",
    "K_of_weights": "gain of the weights, {1} to {0}",
    "vaf": "VAF of {0}",
    "held_out_vaf": "VAF of {0}, left out",
    "price": "price of {0}",
    "centre_price": "price of {0}, analytic centre",
    "largest_input": "largest {0}",
    "log_price": "logarithm of the price of {0}",
}


def measure_words(name: str) -> str:
    """A column by its `name` in words: "K.command.theta1" is "gain of theta1 to command"."""
    kind, *rest = name.split(".", 2 if name.startswith("K") else 1)
    return _WORDS[kind].format(*rest) if kind in _WORDS and rest else name.replace("_", " ")
