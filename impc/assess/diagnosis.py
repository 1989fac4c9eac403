"""Name the cause of an alarm: which error of recordings, settings or body explains the residual.

    tests (`lack_of_fit`)  ->  a mistake in the meaning of a signal, which predictions show at once:
                               signs, exchanged signals, sums and differences of signals
                           ->  else refits with each likely error as a further unknown,
                               the two best again from the body as posed, a limit from a lower one

A test is linear about a fit that has compensated for part of the error, so refits decide. The error
of least -2 log L is named if no test rejects its fit, or if it explains more than the likeliest
test promises, times the ratio of long-run to white variance; otherwise that test is named.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from impc.arrays import Array, frozen
from impc.assess.lack_of_fit import (
    DELAY,
    LEAN,
    LIMIT,
    PARAMETERS,
    LackOfFit,
    ModelError,
    lack_of_fit,
    signal_of,
)
from impc.checking import replace
from impc.errors import ImpcError
from impc.inverse.further_unknowns import (
    with_delay_unknown,
    with_errors_unknown,
    with_limit_unknown,
)
from impc.inverse.noisy_fit import first_end
from impc.inverse.problem import Problem
from impc.inverse.refit import refit
from impc.inverse.search import prediction_misfit, seen_at
from impc.inverse.unknowns import Fitted
from impc.model.plant import Plant
from impc.model.signal_errors import OFFSET

#: Mistakes in the meaning of a signal.
SIGN, EXCHANGED, SUM, DIFFERENCE = "sign", "exchanged", "sum", "difference"
# Errors of signals that are refitted, decrease of -2 log L at which a refit ends, and the logarithm
# of the limit from which a search begins: where a fit does without one, a refit does not find it.
_REFITTED, _PROMISE, _LOWER = 4, 1.0, -0.5
# Number of the best refits that begin anew.
_AGAIN = 2
# Share of the misfit of predictions below which a mistake is tried.
_CLEARLY = 0.8
# Mean of an output over its standard deviation from which a search begins with an offset.
_DISPLACED = 0.3


class Diagnosis(NamedTuple):
    """What an alarm points to."""

    found: LackOfFit  # The tests, that of the named error first
    problem: Problem | None  # With the error as a further unknown, or corrected; None if neither
    ends: tuple[Fitted, ...]  # Fits with it, the lowest first


def diagnosed(
    problem: Problem, at: Fitted, found: LackOfFit | None, least: float = 0.0
) -> Diagnosis | None:
    """Cause of an alarm in the tests `found` of a fit `at` of the problem as posed.

    None without an alarm, or with one of less evidence than `least`: of the end of a first search.
    """
    if found is None or not found.alarm or found.errors[0].evidence < least:
        return None
    first, mistakes = found.errors[0], _mistake(problem)
    ends = _tried({_like(first, name): other for name, other in mistakes.items()})
    ends = ends or _refits(problem, at, found)
    named: ModelError = first
    if ends:
        best, last = min(ends, key=lambda pair: pair[1].objective)
        promised = 2 * seen_at(at).colour * first.evidence
        if _passes(last) or at.objective - last.objective > promised:
            named = best
    others = tuple(one for one in found.errors if one is not named)
    further = mistakes.get(named.name) or _freed(problem, named.name)
    same = sorted((end for one, end in ends if one.name == named.name),
                  key=lambda end: end.objective)  # fmt: skip
    return Diagnosis(replace(found, errors=(named, *others)), further, tuple(same))


def _refits(problem: Problem, at: Fitted, found: LackOfFit) -> list[tuple[ModelError, Fitted]]:
    """Fits with one more unknown: of likely errors from `at`, of the best from the posed body."""
    first = found.errors[0]
    likely = [one for one in found.errors if signal_of(one.name)][:_REFITTED]
    likely += [one for one in found.errors if one.name in _CURES]
    pairs = ((one, _refitted(at, one.name)) for one in likely)
    ends = sorted(
        ((one, end) for one, end in pairs if end is not None), key=lambda pair: pair[1].objective
    )
    again: dict[ModelError, Problem] = {}
    for one, end in ends:
        there = _freed(problem, one.name)
        if one not in again and there is not None and len(again) < _AGAIN:
            body = np.array(end.problem.logarithms)
            body[there.stated] = 0.0
            errors = np.array(end.problem.errors)
            again[one] = there.at(np.array(there.starts), body, errors)
    limit = next((one for one in likely if one.name == LIMIT), None)
    lower = _lower_limit(problem)
    if limit is not None and lower is not None:
        again[limit] = lower
    displaced = {_like(first, name): other for name, other in _displaced(problem)}
    ends += _tried(again | displaced)
    if lower is None or any(one.name == LIMIT for one in found.errors):
        return ends
    # A limit that no sample reaches has no test of its own: its fit must pass all others.
    untested = _tried({_like(first, LIMIT): lower})
    return ends + [pair for pair in untested if _passes(pair[1])]


def _passes(end: Fitted) -> bool:
    test = lack_of_fit(end)
    return test is None or not test.alarm


def _tried(problems: Mapping[ModelError, Problem]) -> list[tuple[ModelError, Fitted]]:
    """Ends of first searches.

    A fit without an error has moved gain and body to make up for it; these begin anew.
    """
    found = []
    for error, problem in problems.items():
        with contextlib.suppress(ImpcError):  # it cannot be simulated: no candidate
            end = first_end(problem)
            found += [(error, end)] if end is not None else []
    return found


def _like(first: ModelError, name: str) -> ModelError:
    """An error without a test of its own."""
    return ModelError(name, first.probability, first.evidence, np.nan, np.nan)


def _refitted(at: Fitted, name: str) -> Fitted | None:
    """Refit with one more unknown from a fit."""
    there = _freed(at.problem, name)
    if there is None:
        return None
    K, more = np.array(at.K), there.plant.n - at.problem.plant.n
    K = np.hstack([K, np.zeros((len(K), more))])
    try:
        return refit(there, K, np.array(at.S), _PROMISE)
    except ImpcError:  # it cannot be simulated: no candidate
        return None


def _lower_limit(problem: Problem) -> Problem | None:
    """The problem with its limit as a further unknown, from a lower one; None without a limit."""
    fitted = {name.split(".")[0] for name in problem.parameter_names}
    there = with_limit_unknown(problem)
    known = PARAMETERS[LIMIT] in fitted or not np.all(problem.bounds.u_max < np.inf)
    if there is None or known:
        return None
    lower = np.array(there.logarithms)
    lower[len(problem.logarithms) :] = _LOWER
    return there.at(np.array(there.starts), lower, np.array(there.errors))


def _displaced(problem: Problem) -> Iterator[tuple[str, Problem]]:
    """Problems with an offset as a further unknown, for outputs with a large mean."""
    for column, name in enumerate(problem.plant.outputs):
        values = [trial.outputs[:, column] for trial in problem.recordings]
        means = np.array([np.nanmean(one) for one in values])
        if np.max(np.abs(means)) > _DISPLACED * np.nanstd(np.concatenate(values)):
            freed = with_errors_unknown(problem, [("offset", name)])
            errors = np.array(freed.errors)
            errors[:, OFFSET, column] = means
            yield f"offset.{name}", freed.at(np.array(freed.starts), freed.logarithms, errors)


def _mistake(problem: Problem) -> dict[str, Problem]:
    """The mistake in the meaning of a signal with which predictions are clearly best, if any."""
    best = _CLEARLY * prediction_misfit(problem)
    found: dict[str, Problem] = {}
    for name, outputs, push in _meanings(problem.plant):
        trials = tuple(
            replace(
                trial,
                outputs=frozen(trial.outputs @ outputs.T),
                disturbance=frozen(push * trial.disturbance),
            )
            for trial in problem.recordings
        )
        values = np.concatenate([trial.outputs for trial in trials])
        scale = frozen(np.sqrt(np.nanmean(values**2, axis=0)))
        other = replace(problem, recordings=trials, output_scale=scale)
        with contextlib.suppress(ImpcError):  # no prediction: no candidate
            misfit = prediction_misfit(other)
            if misfit < best:
                best, found = misfit, {name: other}
    return found


def _meanings(plant: Plant) -> list[tuple[str, Array, int]]:
    """Mistakes by name: matrix (p, p) that corrects the outputs, and sign of the perturbation."""
    unit, p = np.eye(len(plant.outputs)), len(plant.outputs)
    changes: list[tuple[str, Array, int]] = []
    for i, name in enumerate(plant.outputs):
        changes.append((f"{SIGN}.{name}", unit - 2 * np.outer(unit[i], unit[i]), 1))
    if p > 1 and len(plant.disturbances) == 1:  # with one output it is the sign of that
        changes.append((f"{SIGN}.{plant.disturbances[0]}", unit, -1))
    for i, j in itertools.permutations(range(p), 2):
        if plant.unit(plant.outputs[i]) != plant.unit(plant.outputs[j]):
            continue
        if i < j:
            swapped = unit[[j if k == i else i if k == j else k for k in range(p)]]
            changes.append((f"{EXCHANGED}.{plant.outputs[i]}", swapped, 1))
        for kind, sign in ((SUM, -1.0), (DIFFERENCE, 1.0)):
            moved = unit + sign * np.outer(unit[i], unit[j])
            changes.append((f"{kind}.{plant.outputs[i]}", moved, 1))
    return changes


def _freed(problem: Problem, name: str) -> Problem | None:
    """Problem with an error as a further unknown; None if that is not possible."""
    if name in _CURES:
        return _CURES[name](problem)
    pair = signal_of(name)
    return with_errors_unknown(problem, [pair]) if pair else None


def _with_offsets(problem: Problem) -> Problem:
    """A lean looks like an offset of every output."""
    return with_errors_unknown(problem, [("offset", name) for name in problem.plant.outputs])


_CURES: dict[str, Callable[[Problem], Problem | None]] = {
    DELAY: with_delay_unknown,
    LIMIT: with_limit_unknown,
    LEAN: _with_offsets,
}
