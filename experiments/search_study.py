"""Share of default searches that find the right gain: a table of experiments/coverage.md.

python -m experiments.search_study                 # all rows: a quarter of an hour
python -m experiments.search_study --rows sticks   # one row
"""

from __future__ import annotations

import argparse
import itertools
import time

from experiments.driver import each
from experiments.search_problems import Known, random_problem, stick_problem
from experiments.summary import counted
from impc.errors import ImpcError
from impc.inverse.estimates import Estimate
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.problem import recorded_size
from impc.inverse.search import refine_gain

__all__ = ["is_right", "warned"]

# Right: a misfit of at most this multiple of that of a search from the truth, or for exact
# recordings of at most this share of the recorded outputs.
_NOISY, _EXACT = 1.01, 1e-6
# Number of inputs (0: the stick), half of the outputs or all states, and number of problems.
_ROWS = {
    "sticks": (0, False, 100),
    "one": (1, False, 200),
    "half": (1, True, 67),
    "two": (2, False, 100),
    "three": (3, False, 100),
    "two-half": (2, True, 100),
}


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


def _posed(task: tuple[str, int]) -> Known | None:
    """Problem of a row and a seed; None if its share of samples at the limit is extreme."""
    row, seed = task
    inputs, half, _ = _ROWS[row]
    known = random_problem(seed, inputs, half=half) if inputs else stick_problem(seed)
    if known is None or not 0.05 <= known.saturated < (0.4 if inputs else 0.45):
        return None
    return known


def _answer(task: tuple[str, int]) -> tuple[bool, bool, float]:
    """Whether the search of a problem is right, whether it warns, and its processor time, s."""
    known, began = _posed(task), time.process_time()
    assert known is not None
    try:
        found = fit_controller(known.problem)
    except ImpcError:
        return False, True, time.process_time() - began
    return is_right(known, found), warned(found), time.process_time() - began


def main() -> None:
    """Print the right answers of each row with their interval, and the warnings of wrong ones."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rows", nargs="+", choices=list(_ROWS), default=list(_ROWS))
    parser.add_argument("--count", type=int, help="number of problems in each row")
    chosen = parser.parse_args()
    for row in chosen.rows:
        count = chosen.count or _ROWS[row][2]
        tasks = ((row, seed) for seed in itertools.count())
        found = each(_answer, list(itertools.islice(filter(_posed, tasks), count)))
        right = sum(fine for fine, _, _ in found)
        loud = sum(warns and not fine for fine, warns, _ in found)
        print(
            f"{row}: {counted(right, count)} right, {loud} of {count - right} others warn, "
            f"{sum(seconds for *_, seconds in found) / count:.2f} s of processor time each",
            flush=True,
        )


if __name__ == "__main__":
    main()
