"""Likelihood of a seated subject with sensory noise, compared with simulations with Jacobian.

These rows only, in a minute: python -m experiments.benchmarks.likelihood
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import numpy as np

from experiments.benchmarks.table import Row, compare
from experiments.benchmarks.timing import side_by_side
from experiments.benchmarks.workloads import seat
from experiments.noisy_people import Subject, recorded, subject
from impc.checking import replace
from impc.inverse.laws import GainLaw
from impc.inverse.problem import Problem
from impc.inverse.unknowns import Point, Unknowns, linear_at
from impc.output_feedback.unknowns import NoisyUnknowns, Request, gain_space

__all__ = ["likelihood_rows"]


def likelihood_rows(runs: int) -> list[Row]:
    """Rows for three trials of 30 s at the limit, with derivatives by gain and initial states."""
    who, work = subject("seat", 0, "both", 90.0, 6.0), seat(3)
    problem = recorded(who, 0).problem
    given = problem, np.array(who.controller.K), np.array(who.controller.S)
    law = GainLaw(*given)
    kept = _at_the_truth(who, problem)
    free = NoisyUnknowns(Unknowns(problem, law), Request(who.person, who.recorder))
    loose = replace(work.problem, unknown_start=True)
    known = GainLaw(loose, np.array(work.controller.K), np.array(work.controller.S))
    far = subject("seat", 0, "both", 90.0, 70.0)
    free_of_limits = _at_the_truth(far, recorded(far, 0).problem)
    cases: dict[str, Callable[[], object]] = {
        "no limit": partial(free_of_limits.identified, free_of_limits.start),
        "kept": partial(kept.identified, kept.start),
        "free": partial(free.identified, free.start),
        "value": partial(kept.value, kept.start),
        "W2": partial(linear_at, loose, known, known.start),
        "person": partial(linear_at, problem, law, law.start),
    }
    timings = side_by_side(cases, 4 * runs, time.process_time)
    wall = side_by_side({name: cases[name] for name in ("kept", "W2")}, 4 * runs)
    what = "likelihood of a subject on the seat, gradient and information"
    met = "W2 simulation + exact Jacobian (gain, initial states), three trials"
    return [
        compare(f"{what}, processor time", met, timings["kept"], timings["W2"], 10.0),
        compare("the same by the clock, trials side by side", met, wall["kept"], wall["W2"]),
        compare(what, "the same subject's simulation, at no limit without noise",
                timings["kept"], timings["person"]),
        compare("the same with any gain, ten numbers instead of five", met,
                timings["free"], timings["W2"]),
        compare("three trials of a subject without a limit", met,
                timings["no limit"], timings["W2"]),
        compare("the likelihood alone", met, timings["value"], timings["W2"]),
    ]  # fmt: skip


def _at_the_truth(who: Subject, problem: Problem) -> NoisyUnknowns:
    """Coordinates at the truth, restricted to gains that cost weights can have."""
    point = Point(np.array(who.controller.K), np.array(who.controller.S), problem)
    return NoisyUnknowns(gain_space(point, None), Request(who.person, who.recorder))


if __name__ == "__main__":
    for row in likelihood_rows(7):
        print(row)
