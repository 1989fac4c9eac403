"""The first fits of a subject: a search, a diagnosis of what the model lacks, and the whole fit."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from impc.assess.diagnosis import Diagnosis, diagnosed
from impc.assess.lack_of_fit import LackOfFit, lack_of_fit
from impc.assess.printed_gain import GainEstimate, gain_estimate
from impc.checking import replace
from impc.errors import ImpcError
from impc.inverse.estimates import Estimate
from impc.inverse.methods import fit
from impc.inverse.noisy_fit import first_end, fit_controller
from impc.inverse.problem import Problem
from impc.inverse.refit import refit
from impc.inverse.search import FEW
from impc.inverse.unknowns import Fitted
from impc.studies.methods_table import method_label

# Evidence (-log p) of an alarm in a first search that cannot come from its early end.
_PLAIN = 50.0


@dataclass(frozen=True)
class FitProgress:
    """Callbacks that report progress and return stored results of an interrupted fit."""

    done: Callable[[str], None] = lambda _: None  # Called with the title of each completed stage
    # (title of stage, compute) -> estimate, stored (`impc.studies.fit.memory`) or computed
    estimate: Callable[[str, Callable[[], Estimate]], Estimate] = lambda _, compute: compute()
    # (title of stage, compute, decode, encode) -> any other result, stored or computed
    part: Callable[..., Any] = lambda _name, compute, _decode, _encode: compute()
    # Callbacks for a problem with one more unknown; None if nothing is stored
    about: Callable[[Problem], FitProgress] | None = None
    failures: dict[str, str] = field(default_factory=dict)  # Reasons, by stage

    def anew(self, problem: Problem) -> FitProgress:
        """Callbacks for another problem."""
        other = FitProgress(self.done) if self.about is None else self.about(problem)
        return replace(other, failures=self.failures)

    def attempt(self, stage: str, compute: Callable[[], Any], default: Any) -> Any:
        """Result of a stage; if it fails, the default, with the reason in `failures`."""
        try:
            return compute()
        except (ImpcError, np.linalg.LinAlgError) as error:
            self.failures[stage] = str(error)
            return default


def first_fits(
    problem: Problem, progress: FitProgress
) -> tuple[Problem, FitProgress, Estimate, GainEstimate, tuple[LackOfFit | None, ...]]:
    """Inverse MPC, with one more unknown if tests of a first search or of the fit point to it."""
    attempt, title = progress.attempt, method_label("inverse_mpc")

    def tested(at: GainEstimate | Fitted) -> LackOfFit | None:
        found: LackOfFit | None
        found = attempt("test of the model", functools.partial(lack_of_fit, at), None)
        return found

    def cause_of(at: Fitted, found: LackOfFit | None, least: float = 0.0) -> Diagnosis | None:
        compute = functools.partial(diagnosed, problem, at, found, least)
        cause: Diagnosis | None = attempt("diagnosis", compute, None)
        return cause

    search = functools.partial(first_end, problem)
    first = attempt("first search", search, None) if problem.recorded_numbers > FEW else None
    begins: tuple[Fitted, ...] = () if first is None else (first,)
    cause = None if first is None else cause_of(first, tested(first), _PLAIN)
    while True:
        if cause is not None and cause.problem is not None:
            problem, begins = cause.problem, cause.ends
            progress = progress.anew(problem)
        fitted = progress.estimate(title, functools.partial(_whole_fit, problem, begins))
        estimate = gain_estimate(fitted)
        last = tested(estimate)
        if cause is None and last is not None and last.alarm:
            at = np.array(estimate.K), np.array(estimate.S)
            cause = cause_of(refit(estimate.problem, *at, rounds=0), last)
            if cause is not None and cause.problem is not None:
                continue
        progress.done(title)
        freed = cause is not None and cause.problem is not None
        before = (cause.found,) if cause is not None and freed else ()
        return problem, progress, fitted, estimate, (*before, last)


def _whole_fit(problem: Problem, begins: tuple[Fitted, ...]) -> Estimate:
    """Fit from the ends of first searches, if there are any."""
    if not begins:
        return fit(problem)
    started = time.perf_counter()
    return replace(fit_controller(problem, begins), seconds=time.perf_counter() - started)
