"""Gains that the recordings of a unit do not say: no data of a comparison, and left out of it.

What the columns of units.csv are, in words: for the pages of a cohort (docs/cohorts.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pandas as pd

# A deviation may be so many times the usual size of an entry. Small entries that are well
# identified stay: those of a gain whose truth is zero have a median size of 0.67 of their
# deviation. It is not compared with the unit's own value, for what stayed would then be too large
# on average.
_LARGEST = 2.0


def not_identified(units: pd.DataFrame) -> dict[str, int]:
    """How many units do not say a gain, by its column; gains that all of them say are in none.

    A unit says an entry whose standard deviation is at most twice the median size of the entry
    over the units that give a deviation. The deviation counts what the entry may owe to directions
    that are not identified (`GainCovariance.entries`), so that one identified only with others is
    data too where it is identified well enough.
    """
    gains = units.filter(regex=r"^K\.")
    lost = (only_identified(units)[gains.columns].isna() & gains.notna()).sum()
    return {str(name): int(count) for name, count in lost.items() if count}


def only_identified(units: pd.DataFrame) -> pd.DataFrame:
    """The table `units` with NaN for each gain that `not_identified` has of its unit."""
    kept = units.copy()
    for name in units.columns:
        beside = f"K_deviation{name[1:]}"
        if name.startswith("K.") and beside in units.columns:
            deviation = units[beside].astype(float)
            usual = units[name].astype(float).abs()[np.isfinite(deviation)].median()
            kept[name] = units[name].where(deviation <= _LARGEST * usual)
    return kept


def unidentified_sentences(counts: Mapping[str, int], of: int) -> list[str]:
    """What is left out for it, in one sentence; none where nothing is."""
    if not counts:
        return []
    each = "; ".join(f"the {measure_words(name)} of {count}" for name, count in counts.items())
    return [
        "A gain whose standard deviation is more than twice its usual size is not identified, and "
        f"not compared: of {of} units {each}."
    ]


_WORDS = {
    "K": "gain of {1} to {0}",
    "K_of_weights": "gain of the weights, {1} to {0}",
    "vaf": "VAF of {0}",
    "held_out_vaf": "VAF of {0}, left out",
    "cost_weight": "cost weight of {0}",
    "centre_weight": "cost weight of {0}, analytic centre",
    "largest_input": "largest {0}",
    "log_cost_weight": "logarithm of the cost weight of {0}",
}


def measure_words(name: str) -> str:
    """A column by its `name` in words: "K.command.theta1" is "gain of theta1 to command"."""
    kind, *rest = name.split(".", 2 if name.startswith("K") else 1)
    return _WORDS[kind].format(*rest) if kind in _WORDS and rest else name.replace("_", " ")
