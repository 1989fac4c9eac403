"""Fit all methods to the recordings of a subject and predict left-out trials.

docs/howto/compare.md describes the methods and their limitations.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, frozen
from impc.assess.assessments import evaluate_method
from impc.assess.variance_accounted_for import predicted
from impc.checking import replace
from impc.errors import SolverError, WeightsError
from impc.inverse.cross_check import cross_checked
from impc.inverse.methods import METHODS, fit

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from impc.assess.assessments import MethodFit
    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem

    #: (stage, compute) -> the estimate, stored or computed.
    Remember = Callable[[str, Callable[[], Estimate]], Estimate]

# Excluded: needs `feedback_states`; is compared in its two branches; needs a structure.
_LEFT_OUT = ("preliminary", "inverse_lqr", "structured")


def compared_methods() -> tuple[str, ...]:
    """Names of the compared methods, in the order of the registry."""
    return tuple(name for name in METHODS if name not in _LEFT_OUT)


def stages(trials: int, *, held_out: bool = True) -> int:
    """Number of estimates that `compare_recordings` computes for `trials`."""
    return len(compared_methods()) * (1 + (trials if held_out and trials > 1 else 0))


def compare_recordings(
    problem: Problem,
    settle: float,
    remember: Remember = lambda _, compute: compute(),
    *,
    held_out: bool = True,
) -> tuple[MethodFit, ...]:
    """Fit every method to all trials, then to all trials except each one."""
    count, names = len(problem.recordings), compared_methods()
    whole = cross_checked(problem, _all(problem, names, "all", remember))
    parts = []
    for index in range(count if held_out and count > 1 else 0):
        stage, others = f"without {index + 1}", problem.leaving_out(index)
        try:
            parts.append(_all(others, names, stage, remember))
        except (WeightsError, SolverError):  # no fit of these trials: NaN in the table
            parts.append({})
    return tuple(
        replace(
            evaluate_method(whole[name], problem.bounds),
            held_out=_held_out(problem, [part.get(name) for part in parts], settle),
        )
        for name in names
    )


def _all(
    problem: Problem, names: Sequence[str], stage: str, remember: Remember
) -> dict[str, Estimate]:
    """Fit every method to one set of trials, in the order of the names."""
    start = remember(f"{stage}/inverse_mpc", functools.partial(fit, problem))
    return {
        name: start
        if name == "inverse_mpc"
        else remember(f"{stage}/{name}", functools.partial(METHODS[name].estimate, problem, start))
        for name in names
    }


def _held_out(problem: Problem, estimates: list[Estimate | None], settle: float) -> Array:
    rows = np.full((len(estimates), len(problem.plant.outputs)), np.nan)
    for index, estimate in enumerate(estimates):
        if estimate is not None and estimate.K is not None:
            pair = np.array(estimate.gain), np.array(estimate.metric)
            trial = problem.recordings[index]
            rows[index] = predicted(estimate.problem, *pair, trial, settle).vaf
    return frozen(rows)
