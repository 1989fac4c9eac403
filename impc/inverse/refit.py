"""Refit everything from an answer, along the directions of the controller that recordings identify.

The gain of fitted weights is biased by the penalty on their condition number, and an unrestricted
gain drifts along hardly identified directions, often to the edge of stability, where standard
errors are too small. Therefore the gain moves by least squares along identified directions only,
jointly with S, initial states, errors of signals and parameters:

    K = K_start + sum over identified directions i of  w_i  direction_i     (whitened coordinates)

Other directions of the gain keep a prior of SD 1 at the start, and S one at the last end. Initial
states, errors and free parameters have a weak one there: the rounds are repeated from it, with
directions of the new gain, until -2 log L stays.

In short recordings F = -2 log posterior has a flat, bent valley (gain against delay) with creases
where the set of saturated samples changes: searches end anywhere in it, and the curvature at an end
says little about its extent. The ends of refits from several starts do (`several_ends`):

    the answer  ->  its multiples with the body as posed, and answers of parts of the recordings
                ->  initial states  ->  everything

More starts are tried until enough ends agree: two where the gain is known well, more the less it
is. All ends within noise of the lowest are kept (`Estimate.rivals`). Searches from other starts end
early; one that ends lower is continued.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator

import numpy as np
import scipy.linalg

from impc.arrays import Array
from impc.checking import replace
from impc.errors import ImpcError
from impc.inverse.laws import GainLaw
from impc.inverse.minimiser import CREASE, PROMISE, Ended
from impc.inverse.problem import Problem, explains, require_riccati
from impc.inverse.search import best_of, cut, seen_at, stop_at, with_fitted_starts
from impc.inverse.unknowns import Fitted, Unknowns

#: Largest standard error, in whitened units, of an identified direction. Beyond it the prior of the
#: search and the curvature of the problem matter.
IDENTIFIED = 0.2
# Prior SD of free parameters, and 1 / SD of initial states and errors, about the last end: states
# that hardly move in the trials have tiny units.
_SPREAD, _OWN = 3.0, 0.0033
# Largest numbers of rounds and of evaluations of each.
_ROUNDS, _EVALUATIONS = 12, 100
# Decrease of the objective in a round below which the prior no longer matters.
_STAYS = 0.1


def refit(
    problem: Problem,
    gain: Array,
    metric: Array,
    promise: float = 0.1 * PROMISE,
    rounds: int = _ROUNDS,
) -> Fitted:
    """Refit from a `gain` (m, n) and `metric` (m, m), at the other values of the problem.

    A round ends where an undamped step promises a decrease of at most `promise` in the objective.
    """
    require_riccati(problem)
    law = GainLaw(problem, gain, metric)
    space = Unknowns(problem, law)
    end, spent = space.ended(space.start), 0
    for _ in range(0 if explains(problem, end.misfit) else rounds):
        rows, errors = space.deviations(space.start, gain.size)
        beside, parameters = len(law.start) - gain.size, len(problem.logarithms)
        centre = space.centre
        centre[space.controller] = law.at_gain(gain)
        there = space.search(
            space.start,
            stop_at(problem, promise, _EVALUATIONS),
            shared=np.repeat(
                [*(errors >= IDENTIFIED), 1.0, 1 / _SPREAD],
                [*np.ones(gain.size, int), beside, parameters],
            ),
            own=_OWN,
            along=scipy.linalg.block_diag(rows.T, np.eye(beside + parameters)),
            centre=centre,
        )
        spent += there.evaluations
        if not there.stabilises:  # no covariance there: keep the last gain
            break
        gained, end = end.objective - there.objective, there
        crease = there.ended is Ended.STUCK and there.promised < CREASE
        if gained < max(_STAYS, promise) or crease:
            break
        law = GainLaw(end.problem, np.array(end.K), np.array(end.S))
        space = Unknowns(end.problem, law)
    return replace(end, evaluations=spent)


# Multiples of the gain that starts with the body as posed: first ones, and after the parts.
_FIRST, _FAR = (1.0, 0.7, 1.4), (0.5, 2.0)
# Shares of all trials that are fitted alone, and how many single trials.
_PARTS, _SINGLE = ((0.5, 1.0), (0.0, 0.5)), 3
# Decrease of F that counts as none in searches from other starts.
_ROUGH = 0.5
# Relative standard error of the gain up to which two ends and three have to agree.
_KNOWN, _DOUBTFUL = 0.06, 0.1
# The same from which some ends suffice, because the gain is not determined anyway.
_UNKNOWN, _ANYWAY = 0.3, 3


def several_ends(problem: Problem, ends: list[Fitted]) -> list[Fitted]:
    """The `ends` and those of refits from other starts, the lowest first; `problem` is as posed."""
    first, ends = ends[0], list(ends)
    for start in _starts(problem):
        best, agreed = best_of(ends)
        if best.explained or agreed >= _enough(best, len(ends)):
            break
        with contextlib.suppress(ImpcError):  # it cannot be simulated: skip it
            begin, K, S = start(best)
            ends.append(_rough(begin, K, S))
    best, _ = best_of(ends)
    if best is not first:
        further = refit(best.problem, np.array(best.K), np.array(best.S))
        ends = [further if end is best else end for end in ends]
    return sorted(ends, key=lambda end: end.objective)


def _rough(problem: Problem, gain: Array, metric: Array) -> Fitted:
    return refit(problem, gain, metric, _ROUGH)


def _enough(end: Fitted, count: int) -> float:
    """Number of ends that must agree, of the `count` so far."""
    uncertain = relative_error(end)
    if uncertain > _UNKNOWN and count >= _ANYWAY:
        return 0
    return 2 if uncertain < _KNOWN else 3 if uncertain < _DOUBTFUL else np.inf


def relative_error(end: Fitted) -> float:
    """Standard error of the entry of the gain that moves the command most, over its value.

    Other directions have a prior of SD 1 in whitened units.
    """
    K = np.array(end.K)
    law, slopes, noise, _ = seen_at(end)
    moved = np.abs(law.natural(np.eye(K.size).reshape(-1, *K.shape) * K))
    largest = int(np.argmax(np.sum(moved**2, axis=(1, 2))))
    along = law.gains.reshape(K.size, -1)[:, largest]
    variance = along @ np.linalg.solve(slopes.T @ slopes / noise**2 + np.eye(K.size), along)
    return float(np.sqrt(variance) / abs(np.ravel(K)[largest]))


def _starts(problem: Problem) -> Iterator[Callable[[Fitted], tuple[Problem, Array, Array]]]:
    """Starts of further refits from the best end: problem at its values, gain and metric."""
    yield from (functools.partial(_scaled, problem, scale) for scale in _FIRST)
    if problem.unknown_start:
        trials = range(len(problem.recordings))
        yield from (functools.partial(_of_part, problem, trials, *pair) for pair in _PARTS)
        if len(trials) > 1:
            for trial in trials[:_SINGLE]:
                yield functools.partial(_of_part, problem, trials[trial : trial + 1], 0.0, 1.0)
    yield from (functools.partial(_scaled, problem, scale) for scale in _FAR)


def _scaled(problem: Problem, scale: float, best: Fitted) -> tuple[Problem, Array, Array]:
    """Start at a multiple of the gain with the body as posed; a stated body is fixed at first.

    Gain and uncertain body, searched together, can end in a local minimum with a good fit and
    wrong gains.
    """
    K, S = scale * np.array(best.K), np.array(best.S)
    begin = with_fitted_starts(problem.with_body_fixed(), K, S)
    if np.any(problem.stated):
        fixed = _rough(begin, K, S)
        begin, K, S = fixed.problem, np.array(fixed.K), np.array(fixed.S)
    starts, errors = np.array(begin.starts), np.array(begin.errors)
    return problem.at(starts, np.array(problem.logarithms), errors), K, S


def _of_part(
    problem: Problem, trials: range, low: float, high: float, best: Fitted
) -> tuple[Problem, Array, Array]:
    """Start at the gain and body of some trials from share `low` to `high`, from the best end."""
    there, K, S = best.problem, np.array(best.K), np.array(best.S)
    whole = [there.recordings[trial] for trial in trials]
    parts = tuple(cut(one, int(low * one.samples), int(high * one.samples)) for one in whole)
    alone = with_fitted_starts(replace(there, recordings=parts), K, S)
    found = _rough(alone, K, S)
    K, S = np.array(found.K), np.array(found.S)
    body = np.array(found.problem.logarithms)
    begin = problem.at(np.array(there.starts), body, np.array(there.errors))
    return with_fitted_starts(begin, K, S), K, S
