"""Fit the gain to recordings, with or without bounds.

    a start  ->  least prediction error  ->  initial states  ->  least simulation error

The simulation misfit has local minima, and some gains diverge; the one-step prediction misfit has
few and exists at every gain (`prediction`). Each search minimises it first. No local method leaves
a wrong minimum, so starts decide: a regulator by Bryson's rule, then random ones near it, for short
recordings also screened ones. Starts are added until enough searches from different starts end at
the same minimum.

Without bounds this is line 1 of Table 3.1; with bounds the reduced form of inverse MPC: the
recordings determine K and, with several inputs and active bounds, S (docs/why/theory.md).
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from impc.arrays import Array
from impc.checking import replace
from impc.errors import ImpcError, SolverError
from impc.inverse.explaining_weights import weights_behind
from impc.inverse.laws import FixedLaw, GainLaw
from impc.inverse.minimiser import PROMISE, Stop
from impc.inverse.prediction import correction
from impc.inverse.problem import EXPLAINED, Problem, recorded_size, require_riccati
from impc.inverse.residuals import misfit_or_reason
from impc.inverse.starts import (
    balanced_regulator,
    drawn_starts,
    pair_of_inactive_samples,
    regulators,
)
from impc.inverse.unknowns import Fitted, Unknowns
from impc.model.recordings import Recording
from impc.model.riccati import LqrSolution, solve_lqr, stabilises
from impc.model.weights import Weights

#: Largest number of recorded values for which the search is repeated many times.
FEW = 2000
# Searches of short recordings that must agree, and of very short ones: three wrong searches agreed
# in 2 of 80 problems.
_AGREE, _HANDFUL, _SURE = 3, 200, 5
# Two ends agree if their gains differ by at most the first in standard errors, and their objectives
# by at most the second: on the seat creases, mostly along initial states, leave 0.2 and 1.7 between
# ends that no step leaves.
_SAME, _NEAR = 0.25, 2.0
# Factor above the best prediction at which a start is dropped.
_HOPELESS = 30.0
# Largest autocorrelation of residuals that counts.
_LONGEST = 0.98
# Command errors assumed by the filter, in units of the command size: 10 and 1 both find all 67
# sticks; a fast filter keeps the gains of delays bounded.
_RATIOS = (10.0, 1.0)
# 1 / SD of the prior in whitened coordinates for a search without a start.
_WEAK = 1e-3
# Largest numbers of evaluations of predictions, of initial states and of simulations, of which one
# of a short recording takes a millisecond; decrease per recorded value at which a prediction ends.
_PREDICTED, _STATES, _SIMULATED, _SHORT, _ROUGH = 25, 20, 200, 2000, 1e-3
# Promise at which a search of long recordings ends, since it is a start of a refit, and that of
# short ones per recorded value.
_START, _FINE = 0.5, 1e-8
# Misfit of rounding relative to the recorded outputs.
_ROUNDING = 1e-13
# Factor of each step back towards a stabilising gain.
_BACK = 0.8
# Random regulators; for short recordings also rounds of screened ones: rounds, draws per round,
# evaluations to fit their initial states, and how many are searched from.
_MORE, _ROUNDS, _DRAWN, _QUICK, _KEPT = 2, 2, 100, 4, 12


def fit_gain(problem: Problem) -> Fitted:
    """Fit K, S (several inputs), and unknown initial states, errors and parameters."""
    return gain_ends(problem)[0]


def gain_ends(problem: Problem) -> list[Fitted]:
    """Ends of searches for the gain, the best first (`best_of`).

    The end of long recordings is that of one search, a start for others (`ends`).
    """
    require_riccati(problem)
    exact = pair_of_inactive_samples(problem)
    if exact is not None and not misfit_or_reason(problem, *exact)[1]:
        first = refine_gain(problem, *exact)
        if first.explained:
            return [first]
    count = problem.recorded_numbers
    few = count <= FEW
    wanted = (_SURE if count <= _HANDFUL else _AGREE) if few else 1
    ends: list[Fitted] = []
    spent, predicted, reason = 0, np.inf, ""
    for attempt, (there, regulator) in enumerate(_starts(problem, few)):
        try:
            begin, error = _predicted(there, regulator, _RATIOS[attempt % 2])
            spent += begin.evaluations
            if error > _HOPELESS * predicted:
                continue
            predicted = min(predicted, error)
            ends.append(_simulated(there, regulator, begin))
        except ImpcError as refused:
            reason = reason or str(refused)
            continue
        spent += ends[-1].evaluations
        best, agreed = best_of(ends)
        if agreed >= wanted or (best.explained and weights_behind(best).accepted):
            break
    if not ends:
        raise SolverError(
            "gain", f"no start can be simulated: {reason}", "check the plant and the bounds"
        )
    best, agreed = best_of(ends)
    # With so few values and unobserved initial states wrong searches agree as well.
    unsure = agreed == 1 or (count <= _HANDFUL and _hides_states(problem))
    alone = few and unsure and not best.explained
    others = sorted((end for end in ends if end is not best), key=lambda end: end.objective)
    return [replace(best, evaluations=spent, unconfirmed=alone), *others]


def refine_gain(
    problem: Problem,
    gain: Array,
    metric: Array,
    *,
    max_evaluations: int = _SIMULATED,
    prior: float = 0.0,
) -> Fitted:
    """Minimise the simulation misfit from one gain and metric."""
    _, reason = misfit_or_reason(problem, gain, metric)
    if reason:
        raise SolverError(
            "gain",
            f"the closed loop cannot be simulated at the start ({reason})",
            "pass a stabilising gain, e.g. that of solve_lqr",
        )
    space = Unknowns(problem, GainLaw(problem, gain, metric))
    count = problem.recorded_numbers
    promise = min(_FINE * count, PROMISE) if count <= FEW else _START
    return space.search(
        space.start, stop_at(problem, promise, max_evaluations), shared=prior, own=prior
    )


def with_jumps(problem: Problem) -> Problem:
    """Copy with the pushes, recorded or finer, with which the recordings are predicted better."""
    if not any(len(trial.finer) for trial in problem.recordings):
        return problem
    other = [trial.finer if len(trial.finer) else trial.disturbance for trial in problem.recordings]
    posed = []
    for pushes in ([trial.disturbance for trial in problem.recordings], other):
        trials = [
            replace(trial, disturbance=push, finer=trial.finer[:0])
            for trial, push in zip(problem.recordings, pushes, strict=True)
        ]
        posed.append(replace(problem, recordings=tuple(trials)))
    return min(posed, key=prediction_misfit)


def prediction_misfit(problem: Problem) -> float:
    """Least misfit of one-step predictions from a first start."""
    return _predicted(problem, regulators(problem)[0], _RATIOS[0])[1]


def free_gain(problem: Problem, begin: Weights) -> Fitted:
    """Best unrestricted gain near that of `begin`, with all other unknowns."""
    solution = solve_lqr(problem.plant, begin)
    return refine_gain(problem, np.array(solution.K), np.array(solution.S), prior=1.0)


def with_fitted_starts(
    problem: Problem, gain: Array, metric: Array, samples: int | None = None
) -> Problem:
    """Fit initial states and errors of each trial to its first samples, all else fixed.

    A normal prior of the size of the states of the trial (`own_unit`) keeps unidentified components
    at the given values. `gain` (m, n); `metric` (m, m).
    """
    fitted = []
    for trial in problem.recordings:
        short = cut(trial, 0, trial.samples if samples is None else samples)
        one = replace(problem, recordings=(short,), unknown_start=True).with_parameters_fixed()
        space = Unknowns(one, FixedLaw(gain, metric))
        end = space.search(space.start, stop_at(one, 0.1 * PROMISE, _STATES), own=1.0)
        (found,) = end.problem.recordings
        fitted.append(replace(trial, x0=found.x0, errors=found.errors))
    return replace(problem, recordings=tuple(fitted))


def cut(trial: Recording, first: int, last: int) -> Recording:
    """Samples of a trial from `first` to `last` - 1."""
    names = ("outputs", "disturbance", "target", "commands")
    return replace(trial, **{name: getattr(trial, name)[first:last] for name in names})


def stop_at(problem: Problem, promise: float, evaluations: int) -> Stop:
    """Stopping rule, with the squared residual that is rounding."""
    return Stop(promise, (_ROUNDING * recorded_size(problem)) ** 2, evaluations)


def best_of(ends: list[Fitted]) -> tuple[Fitted, int]:
    """End of least objective, and the number of ends at the same minimum.

    Of ends that explain the recordings, one whose gain weights have.
    """
    best = min(ends, key=lambda end: end.objective)
    if best.explained:
        exact = [end for end in ends if end.explained]
        return next((end for end in exact if weights_behind(end).accepted), best), len(exact)
    longer = seen_at(best).colour if best.stabilises else 1.0
    near = [end for end in ends if end.objective - best.objective <= _NEAR * longer]
    if len(near) < 2 or not best.stabilises:
        return best, len(near)
    law, slopes, noise, _ = seen_at(best)
    steps = np.array([law.natural(np.array(end.K) - best.K).ravel() for end in near])
    left, _, _ = np.linalg.svd(slopes, full_matrices=False)
    moved = np.max(np.abs(left.T @ slopes @ steps.T), axis=0) / noise
    return best, int(np.count_nonzero(moved <= _SAME * np.sqrt(longer)))


class Seen(NamedTuple):
    """What the recordings say about the gain at an end."""

    law: GainLaw  # Its whitened coordinates
    slopes: Array  # Derivative of the residual by them, after projection on all else (r, m n)
    noise: float  # RMS residual
    # Long-run over white variance of the residuals by their first autocorrelation, at least 1:
    # differences of -2 log L for white noise are too large by this factor
    colour: float


@functools.lru_cache(maxsize=16)
def seen_at(end: Fitted) -> Seen:
    """What the recordings say about the gain at an end; it must stabilise."""
    law = GainLaw(end.problem, np.array(end.K), np.array(end.S))
    space = Unknowns(end.problem, law)
    width, above, below = len(end.problem.measured), 0.0, 1e-300
    for part in space.evaluated(space.start)[0].residuals:
        rows = part.reshape(-1, width)
        above, below = above + np.sum(rows[1:] * rows[:-1]), below + np.sum(rows**2)
    root = float(np.clip(above / below, 0.0, _LONGEST))
    slopes = space.without_nuisance(space.start)[:, : end.K.size]
    noise = end.misfit / np.sqrt(end.problem.recorded_numbers)
    return Seen(law, slopes, noise, (1 + root) / (1 - root))


def _hides_states(problem: Problem) -> bool:
    """Whether initial states are searched that no output shows."""
    searched = problem.searched_states
    C = problem.plant.C[:, :searched]
    return searched > 0 and bool(np.linalg.matrix_rank(C) < searched)


def _starts(problem: Problem, few: bool) -> Iterator[tuple[Problem, LqrSolution]]:
    """Starting regulators with initial states; deterministic."""
    yield problem, balanced_regulator(problem)
    drawn = drawn_starts(problem)
    yield from itertools.islice(drawn, _MORE)
    for _ in range(_ROUNDS if few else 0):
        yield from _ranked(list(itertools.islice(drawn, _DRAWN)))


def _ranked(drawn: list[tuple[Problem, LqrSolution]]) -> list[tuple[Problem, LqrSolution]]:
    """Best starts by prediction misfit, initial states fitted to each."""
    ranked = []
    filters = [correction(_predictable(drawn[0][0]), ratio) for ratio in _RATIOS]
    for place, (problem, regulator) in enumerate(drawn):
        known = _predictable(problem)
        law = FixedLaw(np.array(regulator.K), np.array(regulator.S))
        space = Unknowns(known, law, filters[place % 2])
        end = space.search(space.start, stop_at(known, _ROUGH * known.recorded_numbers, _QUICK),
                           own=_WEAK)  # fmt: skip
        there = problem.at(np.array(end.problem.starts), np.array(problem.logarithms))
        ranked.append((end.misfit, place, (there, regulator)))
    return [pair for _, _, pair in sorted(ranked, key=lambda item: item[:2])[:_KEPT]]


def _predicted(problem: Problem, begin: LqrSolution, ratio: float) -> tuple[Fitted, float]:
    """Minimise the prediction misfit: end, and its misfit."""
    known = _predictable(problem)
    law = GainLaw(known, np.array(begin.K), np.array(begin.S))
    space = Unknowns(known, law, correction(known, ratio))
    stop = stop_at(known, _ROUGH * known.recorded_numbers, _PREDICTED)
    end = space.search(space.start, stop, shared=_WEAK, own=_WEAK)
    return end, end.misfit


def _predictable(problem: Problem) -> Problem:
    """Linear plant without terminal set, only gain and initial states unknown."""
    return replace(
        problem.with_parameters_fixed(),
        plant=problem.plant.linear(),
        terminal_set=False,
        signal_errors=(),
    )


def _simulated(problem: Problem, begin: LqrSolution, predicted: Fitted) -> Fitted:
    """Minimise the simulation misfit from the end of a prediction search."""
    K, S = np.array(begin.K), np.array(predicted.S)
    there = problem.at(np.array(predicted.problem.starts), np.array(problem.logarithms))
    share, reason = 1.0, ""
    most = _SHORT if problem.recorded_numbers <= FEW else _SIMULATED
    for _ in range(_PREDICTED):
        gain = K + share * (predicted.K - K)
        if stabilises(problem.plant, gain):
            _, reason = misfit_or_reason(there, gain, S)
            if not reason:
                return refine_gain(there, gain, S, prior=_WEAK, max_evaluations=most)
        share *= _BACK
    raise SolverError(
        "gain", reason or "no gain stabilises the plant", "check the plant and the bounds"
    )


def noise_of(free: Fitted) -> float:
    """Misfit of the unrestricted gain, at least rounding level."""
    return max(free.misfit, EXPLAINED * recorded_size(free.problem))
