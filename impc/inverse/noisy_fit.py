"""Inverse MPC for noisy recordings: gain, weights, initial states and physical parameters.

    gain with initial states and parameters  ->  weights with that gain, or the direct form (3.6)

A gain that explains the recordings to 1e-9 is converted to weights by one semidefinite program, or
by the reduced form if none have it. With noise, a fitted gain usually has no weights: then the
direct form in whitened coordinates (`natural_search`) fits the weights. It starts from balanced
weights and, if these leave more than noise, from those with the nearest gain in
|J (K(Q, R) - K)|^2, J the derivative of the residual. Finally the initial states are refitted with
the controller fixed.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import numpy as np
import scipy.special

from impc.arrays import Array
from impc.checking import replace
from impc.errors import InputError, SolverError, WeightsError
from impc.inverse.equivalent_weights import least_condition_weights
from impc.inverse.estimates import Estimate, SearchEnd, simulated_estimate
from impc.inverse.explaining_weights import weights_behind
from impc.inverse.inverse_lqr import inverse_lqr_gradient
from impc.inverse.laws import GainLaw
from impc.inverse.metric_family import metric_family, unidentified_metrics
from impc.inverse.minimiser import CREASE
from impc.inverse.natural_search import (
    CONDITION_SHARE,
    best_conditioned,
    in_natural_units,
    in_plant_units,
    inverse_mpc_natural,
)
from impc.inverse.problem import (
    EXPLAINED,
    Problem,
    explains,
    misfit,
    recorded_size,
    with_or_without_set,
)
from impc.inverse.proximal_search import ConditionedFit, weights_near
from impc.inverse.refit import refit, several_ends
from impc.inverse.residuals import keeps_hard, misfit_or_reason, verify_hard
from impc.inverse.search import (
    FEW,
    best_of,
    free_gain,
    gain_ends,
    noise_of,
    with_fitted_starts,
    with_jumps,
)
from impc.inverse.solution_set import gain_fibre, natural_coordinates
from impc.inverse.starts import regulators
from impc.inverse.table31 import reduced_from
from impc.inverse.unknowns import Fitted, Unknowns
from impc.model.plant import change_coordinates
from impc.model.riccati import LqrSolution, solve_lqr
from impc.model.weights import Weights, condition_number, normalised

# Promise at which a first search ends.
_ROUGH = 0.1
# Continue the search if the free gain fits better at this significance level (likelihood ratio).
_RARE = 0.01
# Relative difference below which two misfits count as equal.
_SAME = 1e-3
# Largest numbers of regulators used as starts, and of gain searches from weights that fit better.
_BEGINNINGS, _AGAIN = 3, 3


def first_end(problem: Problem) -> Fitted | None:
    """End of a first search, from which `fit_controller` can go on; None for exact recordings."""
    found = gain_ends(problem)[0]
    if found.explained:
        return None
    if found.promised < CREASE:
        return found
    return refit(found.problem, np.array(found.K), np.array(found.S), _ROUGH)


def fit_controller(problem: Problem, start: Weights | tuple[Fitted, ...] | None = None) -> Estimate:
    """Fit the weights of the constrained controller to the recordings.

    With weights as a start the search is one from there; ends of first searches save these.
    """
    problem = with_jumps(problem)

    before: list[Estimate] = []  # Without the set, where both are tried

    def fit(posed: Problem) -> Estimate:
        if before and posed.recorded_numbers > FEW:  # a set costs ten times as much
            there = before[0].problem
            values = there.starts, there.logarithms, there.errors
            begin = posed.at(*map(np.array, values))
            found = replace(_fitted(begin, before[0].weights), rivals=before[0].rivals)
        else:
            found = _fitted(posed, start)
        before.append(found)
        tried = posed.terminal_set and problem.terminal_set is None
        if tried and not keeps_hard(found.problem, found.stage_weights):
            raise SolverError(
                "terminal set", "the fitted controller leaves it", "pass terminal_set=False"
            )
        return found

    def settled(found: Estimate) -> bool:
        return found.explained or not _set_may_matter(found)

    return with_or_without_set(problem, fit, settled)


def _set_may_matter(found: Estimate) -> bool:
    """Whether a terminal set would change the fit; decides if the search with one is run.

    If the fitted controller cannot keep the set, another one might, unless the residuals are white.
    With many samples, the misfit at the fitted controller must decrease with the set.
    """
    posed = replace(found.problem, terminal_set=True)
    if posed.recorded_numbers > FEW:
        left, reason = misfit_or_reason(posed, found.gain, found.metric)
        return not reason and left < found.misfit
    try:
        runs = verify_hard(posed, found.stage_weights)
    except (WeightsError, SolverError, InputError):  # the plant has no such set
        return False
    if not all(run.complete for run in runs):
        return not found.fit.white
    return abs(misfit(posed, runs) - found.misfit) > EXPLAINED * recorded_size(posed)


def _fitted(problem: Problem, start: Weights | tuple[Fitted, ...] | None) -> Estimate:
    """Fit for a decided terminal set."""
    if isinstance(start, tuple):
        chosen = {"terminal_set": problem.terminal_set}
        ends = [replace(end, problem=replace(end.problem, **chosen)) for end in start]
        start = None
    else:
        ends = gain_ends(problem) if start is None else [free_gain(problem, start)]
    free = ends[0]
    exact = _exact(free, 0)
    if exact is not None:
        return exact
    found, spent = _weights(free, start)
    refitted = None
    if problem.recorded_numbers > FEW and not free.explained:
        first = refit(free.problem, np.array(found.solution.K), np.array(found.solution.S))
        ends = several_ends(problem, [first, *ends[1:]]) if start is None else [first]
        free = replace(ends[0], unconfirmed=start is None and best_of(ends)[1] == 1)
        refitted = SearchEnd.of(free)
        found, again = _weights(free, found.weights)
        spent += again + sum(end.evaluations for end in ends)
    else:
        for _ in range(_AGAIN):
            if found.misfit >= free.misfit:
                break
            free = free_gain(free.problem, found.weights)  # the one before is in a local minimum
            exact = _exact(free, spent)
            if exact is not None:
                return exact
            ends = [free, *ends]
            found, more = _weights(free, found.weights)
            spent += more
    settled = free.problem
    if problem.own_unknowns:
        settled = with_fitted_starts(free.problem, found.solution.K, found.solution.S)
    one = _finish(free, settled, found.weights, evaluations=spent, converged=found.converged)
    if not one.explained:
        one = replace(one, refitted=refitted, rivals=tuple(map(SearchEnd.of, ends[1:])))
    return one if start is None else _not_worse(problem, free, one, start)


def _exact(free: Fitted, evaluations: int) -> Estimate | None:
    """Estimate of weights that explain the recordings as the gain does, with this gain or not."""
    if not free.explained:
        return None
    behind, problem = weights_behind(free), free.problem
    weights = behind.weights
    if weights is None or not behind.accepted:
        other = reduced_from(behind)
        if not other.explained:
            return None
        problem, weights = other.problem, other.stage_weights
        evaluations += other.evaluations
    return _finish(free, problem, weights, evaluations=evaluations, converged=True)


def _not_worse(problem: Problem, free: Fitted, one: Estimate, start: Weights) -> Estimate:
    """The estimate, or that of the given weights if these fit better."""
    solution, there = solve_lqr(problem.plant, start), problem
    if problem.own_unknowns:
        there = with_fitted_starts(problem, solution.K, solution.S)
    left, reason = misfit_or_reason(there, solution.K, solution.S)
    if reason or left >= one.misfit:
        return one
    return _finish(free, there, start, evaluations=one.evaluations, converged=one.converged)


def _weights(free: Fitted, start: Weights | None) -> tuple[ConditionedFit, int]:
    """Weights of the direct form, from several starts."""
    best, spent, reason = None, 0, ""
    enough = _unlikely(free) * free.misfit
    for begin in _beginnings(free, start):
        try:
            found = inverse_mpc_natural(free.problem, begin, noise_of(free))
        except (WeightsError, SolverError) as error:  # try the next start
            reason = reason or str(error)
            continue
        spent += found.evaluations
        again = best is not None and abs(found.misfit - best.misfit) <= _SAME * best.misfit
        best = found if best is None or found.misfit < best.misfit else best
        if best.misfit <= enough or (again and not free.explained):
            break
    if best is None:
        raise SolverError(
            "weights", f"no start can be simulated ({reason})", "pass start=Weights(Q, R)"
        )
    return best, spent


def _unlikely(free: Fitted) -> float:
    """Ratio of the misfits of truth and best gain that noise exceeds with probability `_RARE`."""
    plant, problem = free.problem.plant, free.problem
    unknowns = plant.m * plant.n + plant.m * (plant.m + 1) // 2 - 1 + len(problem.logarithms)
    unknowns += problem.own_unknowns * len(problem.recordings)
    samples = problem.recorded_numbers
    return float(np.exp(scipy.special.chdtri(unknowns, _RARE) / (2 * samples)))


def _beginnings(free: Fitted, start: Weights | None) -> Iterator[Weights]:
    """Starting weights: the given ones, balanced regulators, those nearest to the free gain.

    The last start is nearest entry by entry: near its bound an unstable plant diverges with others.
    """
    if start is not None:
        yield start
    for regulator in regulators(free.problem)[:_BEGINNINGS]:
        if not free.explained:
            yield regulator.weights
        if free.stabilises:  # without bounds a search may end at an unstable gain
            yield _nearest(free, regulator)
        if free.explained:
            yield regulator.weights
    with contextlib.suppress(WeightsError, SolverError):  # skip this start
        nearest = inverse_lqr_gradient(free.problem.plant, free.K).weights
        if nearest is not None:
            yield nearest


def _nearest(free: Fitted, regulator: LqrSolution) -> Weights:
    """Weights whose gain is nearest to the free one in the metric of the recordings."""
    problem, plant = free.problem, free.problem.plant
    law = GainLaw(problem, np.array(free.K), np.array(free.S))
    space, count = Unknowns(problem, law), free.K.size
    triangle: Array = np.asarray(np.linalg.qr(space.without_nuisance(space.start), mode="r"))
    form = triangle[:, :count]
    T, G = natural_coordinates(plant, np.array(regulator.K))
    natural = change_coordinates(plant, T, G)
    # Transform from whitened coordinates of the free gain to those of the regulator.
    back = law.natural(G @ np.eye(count).reshape(-1, plant.m, plant.n) @ np.linalg.inv(T))
    form = form @ back.reshape(count, -1).T / noise_of(free)
    target = np.asarray(np.linalg.solve(G, free.K @ T))
    own = gain_fibre(natural, np.linalg.solve(G, regulator.K @ T), G.T @ regulator.S @ G)
    begin = best_conditioned(own, in_natural_units(regulator.weights, T, G))
    samples = problem.recorded_numbers
    share = CONDITION_SHARE / samples / condition_number(begin)
    return in_plant_units(weights_near(natural, form, target, begin, share).weights, T, G)


def _finish(
    free: Fitted, problem: Problem, weights: Weights, *, evaluations: int, converged: bool
) -> Estimate:
    metrics = _metrics(problem, solve_lqr(problem.plant, weights))
    weights = _by_convention(problem, weights, metrics)
    solution = solve_lqr(problem.plant, weights)
    return simulated_estimate(
        "inverse_mpc",
        problem,
        np.array(solution.K),
        np.array(solution.S),
        weights=weights,
        metrics=metrics,
        noise=noise_of(free),
        evaluations=free.evaluations + evaluations,
        settled=converged,
        unconfirmed=free.unconfirmed,
    )


def _by_convention(problem: Problem, weights: Weights, metrics: Array) -> Weights:
    """Reported weights with the same gain; `weights` if the program fails or they fit worse.

    Metrics that the recordings do not identify to first order can still differ at a few samples.
    """
    plant = problem.plant
    solution = solve_lqr(plant, weights)
    try:
        fibre = gain_fibre(plant, solution.K, metrics)
        found = least_condition_weights(fibre, weights).weights
    except (WeightsError, SolverError):  # numerically at the edge of the cone
        return normalised(weights)
    if plant.m == 1:
        return found
    other = solve_lqr(plant, found)
    least, most = (misfit_or_reason(problem, one.K, one.S)[0] for one in (solution, other))
    worse = most > (1 + _SAME) * least and not explains(problem, most)
    return normalised(weights) if worse else found


def _metrics(problem: Problem, solution: LqrSolution) -> Array:
    """Metric, then metric directions that the recordings do not identify (k, m, m)."""
    gain, metric = np.array(solution.K), np.array(solution.S)
    family = metric_family(problem.plant, gain) if problem.plant.m > 1 else None
    if family is None:
        return metric[None]
    return unidentified_metrics(problem, gain, family, family.nearest(metric))
