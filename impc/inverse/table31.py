"""Table 3.1 of the dissertation for noise-free recordings, in the units of the plant.

    line 1      feedback gain without bounds (3.12)
    lines 2-7   inverse LQR: weights with exactly that gain (LMI), else those with the nearest gain
                (gradient), then well-conditioned weights (3.7)
    line 9      inverse MPC (3.6) from there; (3.16) is the same without bounds

The direct form (3.6) searches weights. The reduced form fits the gain (and metric), then computes
the weights of least condition number with that gain by one semidefinite program.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from impc.arrays import Array
from impc.checking import checked, replace
from impc.control.terminal_set import TerminalSet
from impc.errors import SolverError
from impc.inverse.estimates import Estimate, no_estimate, simulated_estimate
from impc.inverse.explaining_weights import WeightsBehind, weights_behind
from impc.inverse.inverse_lqr import inverse_lqr_gradient, inverse_lqr_lmi
from impc.inverse.laws import GainLaw
from impc.inverse.problem import (
    EXPLAINED,
    Problem,
    recorded_size,
    typical_output,
    with_or_without_set,
)
from impc.inverse.proximal_search import (
    AUXILIARY_CONDITION_WEIGHT,
    Objective,
    Residual,
    auxiliary_weights,
    conditioned_fit,
    definite,
)
from impc.inverse.search import fit_gain, refine_gain
from impc.inverse.starts import regulators
from impc.inverse.unknowns import linear_at
from impc.model.riccati import LqrSolution, solve_lqr
from impc.model.weights import Weights

# The value of c in (3.5) to (3.7) is unknown. This one is small enough that an exact fit
# minimises (3.6) in the 2-norm (docs/why/theory.md).
#: Weight of the condition number in (3.6) and (3.16); a typical-output misfit has weight 1.
CONDITION_WEIGHT = 1e-4
# Iterations of the direct form within the reduced one: it only has to leave a local minimum.
_DETOUR = 60


@checked
def table_3_1(
    problem: Problem,
    *,
    absolute: bool = False,
    progress: Callable[[str], None] = lambda _: None,
) -> dict[str, Estimate]:
    """Run all methods of Table 3.1 on noise-free recordings.

    Parameters
    ----------
    problem : Problem
        Recordings and the closed loop to identify.
    absolute : bool, default False
        If True, use condition-number weights 1e-3 in (3.7) and 1e-4 in (3.6) and (3.16), in the
        units of the plant. If False, scale them by the norm of the gain and by a typical output, so
        that results do not depend on units.
    progress : callable, optional
        Called with the name of each completed method, e.g. `print`.

    Returns
    -------
    dict of str to Estimate
        By method, in the order of the table: feedback_gain, inverse_lqr_lmi, inverse_lqr_gradient,
        inverse_lqr_auxiliary, inverse_lqr_output, inverse_mpc, inverse_mpc_reduced. A method
        without a result gives an estimate with `reason` set.

    Raises
    ------
    WeightsError, SolverError
        If there is no feedback gain, or no weights from which inverse MPC can start.

    Examples
    --------
    >>> import impc
    >>> from plants import yalmip_example
    >>> plant = impc.Plant(yalmip_example())
    >>> bounds, weights = impc.Bounds(plant, u_min=-1, u_max=1), impc.Weights([[1, 0], [0, 1]], 1)
    >>> truth = impc.Controller(plant, weights, bounds, horizon=3)
    >>> trial = impc.Recording(plant, truth.simulate([1, 3], steps=20).x)
    >>> found = impc.table_3_1(impc.Problem(plant, bounds, 3, [trial]))["inverse_mpc"]
    >>> found.explained, impc.weight_error(found.weights, weights) < 1e-6
    (True, True)
    """
    found: dict[str, Estimate] = {}
    started = time.perf_counter()
    for line in _lines(problem, absolute):
        found[line.method] = replace(line, seconds=time.perf_counter() - started)
        progress(line.method)
        started = time.perf_counter()
    direct, reduced = found["inverse_mpc"], found["inverse_mpc_reduced"]
    if reduced.explained and not (direct.explained or absolute):  # it ended in a local minimum
        found["inverse_mpc"] = _after(direct, reduced)
    return found


def _lines(problem: Problem, absolute: bool) -> Iterator[Estimate]:
    plant, loose = problem.plant, problem.without_bounds()
    first = fit_gain(loose)
    K, size = np.array(first.K), float(np.linalg.norm(first.K)) or 1.0
    yield _simulated("feedback_gain", loose, K, evaluations=first.evaluations)
    lmi = inverse_lqr_lmi(plant, K)
    yield _regulator("inverse_lqr_lmi", loose, lmi.weights)
    gradient = inverse_lqr_gradient(plant, K)
    yield _regulator("inverse_lqr_gradient", loose, gradient.weights)
    weight = AUXILIARY_CONDITION_WEIGHT * (1.0 if absolute else size)
    auxiliary = auxiliary_weights(plant, K, gradient.weights, condition_weight=weight).weights
    yield _regulator("inverse_lqr_auxiliary", loose, auxiliary)
    start = auxiliary if lmi.weights is None else lmi.weights
    given = CONDITION_WEIGHT if absolute else None
    output = inverse_mpc(loose, start, condition_weight=given, explain=False)
    yield replace(output, method="inverse_lqr_output")
    yield inverse_mpc(problem, start, condition_weight=given)
    yield inverse_mpc_reduced(problem)


def _simulated(
    name: str, problem: Problem, K: Array, S: Array | None = None, **more: Any
) -> Estimate:
    metric = np.eye(problem.plant.m) if S is None else S
    noise = EXPLAINED * recorded_size(problem)
    return simulated_estimate(name, problem, K, metric, noise=noise, **more)


def _after(direct: Estimate, exact: Estimate) -> Estimate:
    """Estimate of the direct form that ended with that of the reduced one."""
    evaluations, seconds = direct.evaluations + exact.evaluations, direct.seconds + exact.seconds
    return replace(exact, method=direct.method, evaluations=evaluations, seconds=seconds)


def _regulator(name: str, problem: Problem, weights: Weights | None) -> Estimate:
    if weights is None:
        return no_estimate(name, problem, "no weights have the feedback gain")
    K = np.array(solve_lqr(problem.plant, weights).K)
    return _simulated(name, problem, K, weights=weights)


def starting_weights(problem: Problem) -> Weights:
    """Starting weights of inverse MPC (lines 2 to 7)."""
    _, lmi, _, auxiliary = itertools.islice(_lines(problem, absolute=False), 4)
    return auxiliary.stage_weights if lmi.weights is None else lmi.weights


@checked(condition_weight=0, max_iterations=1)
def inverse_mpc(
    problem: Problem,
    start: Weights,
    *,
    condition_weight: float | None = None,
    squared: bool = False,
    max_iterations: int = 200,
    explain: bool = True,
) -> Estimate:
    """Direct inverse MPC (3.6): misfit of the constrained closed loop plus condition number.

    Terminal weight and terminal set follow (Q, R) at every iterate. Without bounds and `explain` it
    is inverse LQR on the outputs (3.16).

    Parameters
    ----------
    start : Weights
        Positive definite starting weights.
    condition_weight : float, optional
        Weight of the condition number; None: 1e-4 of a typical scaled output. The misfit has 1.
    squared : bool
        Whether the misfit is the squared 2-norm; see `Objective`.
    max_iterations : int
        Largest number of steps.
    explain : bool
        Whether to search for weights that explain the recordings exactly if the minimum does not
        (docs/why/theory.md); only in the 2-norm and with the default `condition_weight`.
    """
    weight = condition_weight
    if weight is None:
        weight = CONDITION_WEIGHT * typical_output(problem)
    explain = explain and not squared and condition_weight is None

    def fit(posed: Problem) -> Estimate:
        objective = Objective(_closed_loop_residual(posed), 1.0, weight, squared)
        found = conditioned_fit(
            posed.plant, objective, definite(start), max_iterations=max_iterations
        )
        K, S = np.array(found.solution.K), np.array(found.solution.S)
        more = {"evaluations": found.evaluations, "settled": found.converged}
        direct = _simulated("inverse_mpc", posed, K, S, weights=found.weights, **more)
        if direct.explained or not explain:
            return direct
        behind = weights_behind(refine_gain(posed, K, S))
        return _after(direct, reduced_from(behind)) if behind.explained else direct

    return with_or_without_set(problem, fit, lambda found: found.explained)


@checked
def inverse_mpc_reduced(problem: Problem) -> Estimate:
    """Reduced inverse MPC: fit the gain of the constrained controller, then solve for weights.

    If the gain does not explain the recordings or has no weights, the direct form runs, and a gain
    search continues from its solution. The estimate then has this gain, the nearest weights if they
    can be simulated, and the reason why they do not explain the recordings.
    """

    def fit(posed: Problem) -> Estimate:
        return reduced_from(weights_behind(fit_gain(posed)))

    return with_or_without_set(problem, fit, lambda found: found.explained)


def reduced_from(first: WeightsBehind) -> Estimate:
    """Reduced form from the weights behind a fitted gain."""
    if first.explained:
        return _with_gain(first, first.weights)
    problem = first.gain.problem
    try:
        direct = inverse_mpc(
            problem, _most_promising(problem), max_iterations=_DETOUR, explain=False
        )
    except SolverError:  # the loop diverges with every starting regulator
        return _with_gain(first, first.weights)
    second = weights_behind(refine_gain(problem, direct.gain, direct.metric))
    best = min(first, second, key=lambda item: item.misfit)
    if best.explained or best.misfit <= direct.misfit:
        return _with_gain(best, best.weights)
    return _with_gain(first, direct.stage_weights)


def _with_gain(behind: WeightsBehind, weights: Weights | None) -> Estimate:
    """Estimate of a fitted gain, or that of the weights if these explain the recordings."""
    gain = behind.gain
    K, S = gain.K, gain.S
    if behind.explained and weights is not None:
        solution = solve_lqr(gain.problem.plant, weights)
        K, S = solution.K, solution.S
    return _simulated(
        "inverse_mpc_reduced",
        gain.problem,
        np.array(K),
        np.array(S),
        weights=weights,
        metrics=behind.metrics,
        evaluations=gain.evaluations,
        reason=behind.reason,
    )


def _most_promising(problem: Problem) -> Weights:
    """Balanced regulator with the least misfit, complete simulation or not."""

    def distance(solution: LqrSolution) -> float:
        return float(np.linalg.norm(closed_loop_residual(problem, solution)[0].values))

    return min(regulators(problem), key=distance).weights


def _closed_loop_residual(problem: Problem) -> Callable[[LqrSolution], Residual]:
    near: TerminalSet | None = None

    def residual(solution: LqrSolution) -> Residual:
        nonlocal near
        found, terminal = closed_loop_residual(problem, solution, near)
        near = terminal or near
        return found

    return residual


def closed_loop_residual(
    problem: Problem, solution: LqrSolution, near: TerminalSet | None = None
) -> tuple[Residual, TerminalSet | None]:
    """Residual of a regulator with its bounds, and its terminal set."""
    law = GainLaw(problem, np.array(solution.K), np.array(solution.S))
    found = linear_at(problem, law, law.start, near)
    slopes = found.parts(problem)[0]
    residual = Residual(
        found.residual, lambda dK, dS: slopes @ law.along(dK, dS).T, usable=not found.reason
    )
    return residual, found.terminal
