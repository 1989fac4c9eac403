"""All methods on the recordings of a subject, in sample and on trials left out.

docs/comparing.md says what each method is and where it breaks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.assess.held_out import left_out_vaf
from impc.assess.judged import judge, without_gain
from impc.checking import replace
from impc.inverse.initial_states import with_fitted_starts
from impc.inverse.methods import METHODS, estimate_all

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.assess.judged import MethodFit
    from impc.inverse.methods import Estimate
    from impc.inverse.problem import Problem

__all__ = ["MethodComparison", "bounds_of_method", "compare_recordings", "stages"]


@dataclass(frozen=True)
class MethodComparison(Frozen):
    """One method.

    Attributes
    ----------
    name : str
        One of `METHODS`.
    fit : MethodFit
        On all trials.
    held_out : Array
        VAF of each trial predicted from the others (trials, p), %; NaN where there is no gain or
        the simulation ends early; (0, p) for a single trial.
    """

    name: str
    fit: MethodFit
    held_out: Array


def stages(trials: int) -> int:
    """Number of estimates that `compare_recordings` makes for so many `trials`."""
    return len(METHODS) * (1 + (trials if trials > 1 else 0))


def bounds_of_method(problem: Problem, name: str) -> Problem:
    """The problem with the bounds that the method `name` knows: inverse MPC alone has any."""
    return problem if name.startswith("inverse_mpc") else problem.without_bounds()


def compare_recordings(
    problem: Problem,
    settle: float,
    remember: Callable[[str, Callable[[], Estimate]], Estimate] = lambda _, compute: compute(),
) -> tuple[MethodComparison, ...]:
    """Run every method on all trials, then on all but each one.

    Parameters
    ----------
    problem : Problem
        Of `fit_problem`.
    settle : float
        Seconds at the start of a left-out trial that find its start and do not count.
    remember : callable
        (stage, compute) -> the estimate; stages are named "all/METHOD" and "without K/METHOD".
    """
    count = len(problem.recordings)
    whole = estimate_all(problem, _within("all", remember))
    parts = []
    for index in range(count if count > 1 else 0):
        others = problem.recordings[:index] + problem.recordings[index + 1 :]
        stage = f"without {index + 1}"
        parts.append(estimate_all(replace(problem, recordings=others), _within(stage, remember)))
    return tuple(
        MethodComparison(
            name,
            _judged(problem, name, whole[name]),
            _held_out(problem, name, [part.get(name) for part in parts], settle),
        )
        for name in METHODS
        if name in whole
    )


def _within(
    stage: str, remember: Callable[[str, Callable[[], Estimate]], Estimate]
) -> Callable[[str, Callable[[], Estimate]], Estimate]:
    return lambda name, compute: remember(f"{stage}/{name}", compute)


def _judged(problem: Problem, name: str, estimate: Estimate) -> MethodFit:
    if estimate.K is None or estimate.S is None:
        return without_gain(name, problem, estimate.seconds, estimate.reason)
    K, S = np.array(estimate.K), np.array(estimate.S)
    here = problem.at(np.array(estimate.starts), np.array(estimate.logarithms))
    known = replace(here, family=None, logarithms=frozen([]), unknown_start=False)
    own = bounds_of_method(known, name)
    started = with_fitted_starts(own, K, S) if problem.unknown_start else own
    return judge(
        name,
        started,
        problem.bounds,
        K,
        S,
        weights=estimate.weights,
        seconds=estimate.seconds,
        reason=estimate.reason,
    )


def _held_out(
    problem: Problem, name: str, estimates: list[Estimate | None], settle: float
) -> Array:
    p = len(problem.plant.outputs)
    rows = np.full((len(estimates), p), np.nan)
    for index, estimate in enumerate(estimates):
        if estimate is None or estimate.K is None or estimate.S is None:
            continue
        trial = problem.recordings[index]
        one = replace(problem, recordings=(trial,))
        here = one.at(np.array([trial.x0]), np.array(estimate.logarithms))
        alone = bounds_of_method(replace(here, family=None, logarithms=frozen([])), name)
        rows[index], _ = left_out_vaf(alone, np.array(estimate.K), np.array(estimate.S), settle)
    return frozen(rows)
