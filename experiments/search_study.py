"""Share of default searches that find the right gain: a table of experiments/coverage.md.

python -m experiments.search_study                 # all rows: a quarter of an hour on one core
python -m experiments.search_study --rows sticks   # one row
"""

from __future__ import annotations

import argparse
import itertools
import time
from typing import TYPE_CHECKING

import scipy.stats

from experiments.search_problems import Known, random_problem, stick_problem
from impc.errors import ImpcError
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.problem import recorded_size
from impc.inverse.search import refine_gain

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from impc.inverse.estimates import Estimate

__all__ = ["is_right", "warned"]

# Right: a misfit of at most this multiple of that of a search from the truth, or for exact
# recordings of at most this share of the recorded outputs.
_NOISY, _EXACT = 1.01, 1e-6


def is_right(known: Known, found: Estimate) -> bool:
    """Whether an estimate fits as well as the truth: its weights if exact, its gain if noisy."""
    truth = refine_gain(known.problem, known.K, known.S)
    exact = _EXACT * recorded_size(known.problem)
    if truth.misfit <= exact:
        return found.misfit <= exact
    return found.noise <= _NOISY * truth.misfit


def warned(found: Estimate) -> bool:
    """Whether an estimate carries a warning."""
    return bool(found.doubts) or not found.converged


def _sticks() -> Iterator[Known]:
    known = (stick_problem(seed) for seed in itertools.count())
    return (one for one in known if one is not None and 0.05 <= one.saturated < 0.45)


def _random(inputs: int, half: bool) -> Iterator[Known]:
    known = (random_problem(seed, inputs, half=half) for seed in itertools.count())
    return (one for one in known if one is not None and 0.05 <= one.saturated < 0.4)


_ROWS: dict[str, tuple[str, Callable[[], Iterator[Known]], int]] = {
    "sticks": ("a stick, 5 to 45 % at the limit, noise", _sticks, 100),
    "one": ("one input, exact, all states", lambda: _random(1, False), 200),
    "half": ("one input, exact, half of the outputs", lambda: _random(1, True), 67),
    "two": ("two inputs, exact, all states", lambda: _random(2, False), 100),
    "three": ("three inputs, exact, all states", lambda: _random(3, False), 100),
    "two-half": ("two inputs, exact, half of the outputs", lambda: _random(2, True), 100),
}


def main() -> None:
    """Print the right answers of each row with their interval, and the warnings of wrong ones."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rows", nargs="+", choices=list(_ROWS), default=list(_ROWS))
    parser.add_argument("--count", type=int, help="number of problems in each row")
    chosen = parser.parse_args()
    for row in chosen.rows:
        name, make, usual = _ROWS[row]
        count, right, loud, began = chosen.count or usual, 0, 0, time.process_time()
        for known in itertools.islice(make(), count):
            try:
                found = fit_controller(known.problem)
            except ImpcError:
                loud += 1
                continue
            fine = is_right(known, found)
            right, loud = right + fine, loud + (not fine and warned(found))
        low, high = scipy.stats.binomtest(right, count).proportion_ci()
        seconds = (time.process_time() - began) / count
        print(
            f"{name}: {right} of {count} right (95 %: {100 * low:.0f} to {100 * high:.0f} %), "
            f"{loud} of {count - right} others warn, {seconds:.2f} s of processor time each",
            flush=True,
        )


if __name__ == "__main__":
    main()
