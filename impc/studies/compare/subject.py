"""Fit all methods to the recordings of a subject and predict left-out trials.

docs/howto/compare.md describes the methods and their limitations.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import numpy as np

from impc.arrays import Array, frozen
from impc.assess.assessments import MethodFit, evaluate_method
from impc.assess.variance_accounted_for import predicted
from impc.checking import replace
from impc.errors import SolverError, WeightsError
from impc.inverse.cross_check import cross_checked
from impc.inverse.estimates import Estimate
from impc.inverse.methods import METHODS, fit
from impc.inverse.problem import Problem
from impc.studies.methods_table import method_label

#: (title, compute) -> the estimate, stored or computed.
Remember = Callable[[str, Callable[[], Estimate]], Estimate]

# Excluded: needs `feedback_states`; is compared in its two branches; needs a structure.
_NOT_COMPARED = ("preliminary", "inverse_lqr", "structured")
# What follows the method in a title; `impc.studies.fit.memory` reads it.
_LEFT_OUT = ", trial {} left out"


def compared_methods() -> tuple[str, ...]:
    """Names of the compared methods, in the order of the registry."""
    return tuple(name for name in METHODS if name not in _NOT_COMPARED)


def stages(trials: int, *, held_out: bool = True) -> tuple[str, ...]:
    """Titles of the estimates that `compare_recordings` computes for `trials`, in order."""
    names = sorted(compared_methods(), key=lambda name: name != "inverse_mpc")
    parts = [
        "",
        *(_LEFT_OUT.format(k + 1) for k in range(trials if held_out and trials > 1 else 0)),
    ]
    return tuple(f"{method_label(name)}{part}" for part in parts for name in names)


def compare_recordings(
    problem: Problem,
    settle: float,
    remember: Remember = lambda _, compute: compute(),
    *,
    held_out: bool = True,
) -> tuple[MethodFit, ...]:
    """Fit every method to all trials, then to all trials except each one."""
    count, names = len(problem.recordings), compared_methods()
    whole = cross_checked(problem, _all(problem, names, "", remember))
    parts = []
    for index in range(count if held_out and count > 1 else 0):
        part, others = _LEFT_OUT.format(index + 1), problem.leaving_out(index)
        try:
            parts.append(_all(others, names, part, remember))
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
    problem: Problem, names: Sequence[str], part: str, remember: Remember
) -> dict[str, Estimate]:
    """Fit every method to the trials without those of `part`, in the order of the names."""
    start = remember(f"{method_label('inverse_mpc')}{part}", functools.partial(fit, problem))
    found = {}
    for name in names:
        compute = functools.partial(METHODS[name].estimate, problem, start)
        own = name == "inverse_mpc"
        found[name] = start if own else remember(f"{method_label(name)}{part}", compute)
    return found


def _held_out(problem: Problem, estimates: list[Estimate | None], settle: float) -> Array:
    rows = np.full((len(estimates), len(problem.plant.outputs)), np.nan)
    for index, estimate in enumerate(estimates):
        if estimate is not None and estimate.K is not None:
            pair = np.array(estimate.gain), np.array(estimate.metric)
            trial = problem.recordings[index]
            rows[index] = predicted(estimate.problem, *pair, trial, settle).vaf
    return frozen(rows)
