"""Registry of estimation methods and the functions that run them.

A method is a function (problem, inverse MPC estimate) -> estimate. All methods use the initial
states and physical parameters of inverse MPC and start from its weights, so that no method is
penalised for its starting point; the initial states are then refitted for the gain of each method.
Searches run in whitened coordinates, with misfits relative to the residual of the best gain. For
Table 3.1 in the units of the plant see `impc.inverse.table31`.
"""

from __future__ import annotations

import functools
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from impc.arrays import Array
from impc.checking import checked, replace
from impc.errors import ImpcError, InputError, WeightsError
from impc.inverse.command_regression import regress_commands
from impc.inverse.delayed_feedback import preliminary_gain
from impc.inverse.equivalent_weights import least_condition_weights
from impc.inverse.estimates import Estimate, no_estimate, simulated_estimate
from impc.inverse.explaining_weights import weights_behind
from impc.inverse.inverse_lqr import inverse_lqr_gradient, inverse_lqr_lmi
from impc.inverse.natural_search import in_plant_units, inverse_mpc_natural
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.problem import Problem, require_riccati
from impc.inverse.proximal_search import auxiliary_weights
from impc.inverse.search import free_gain, noise_of, refine_gain, with_fitted_starts
from impc.inverse.solution_set import gain_fibre, natural_coordinates
from impc.inverse.structured import fit_structured, fit_weights
from impc.inverse.unknowns import Fitted
from impc.model.plant import Plant, change_coordinates
from impc.model.riccati import solve_lqr, stabilises
from impc.model.weights import Weights

_LOG = logging.getLogger("impc")
# Relative misfit by which weights may exceed the gain for which they were found.
_AS_GOOD = 1e-3
# Relative decrease at which the auxiliary problem ends: where the largest eigenvalue is a repeated
# one, steps creep.
_CREEPS = 1e-5


@dataclass(frozen=True)
class Method:
    """Estimation method: from recordings to a controller."""

    name: str  # Identifier in result.json, in TOML files and on the command line
    label: str  # Label in tables and figures
    sentence: str  # Explanation for readers who do not know the method
    # Maps the posed problem to the one that this method solves (inverse LQR: bounds removed)
    restrict: Callable[[Problem], Problem]
    # (posed problem, estimate of inverse MPC) -> estimate of this method
    find: Callable[[Problem, Estimate], Estimate]

    def estimate(self, problem: Problem, start: Estimate) -> Estimate:
        """Run the method; if it fails, the estimate states the reason."""
        started = time.perf_counter()
        try:
            found = self.find(problem, start)
        except ImpcError as error:
            found = no_estimate(
                self.name, self.restrict(start.problem.with_nuisance_fixed()), str(error)
            )
        return replace(found, seconds=time.perf_counter() - started)


def of_gain(
    name: str,
    problem: Problem,
    start: Estimate,
    K: Array,
    S: Array | None = None,
    *,
    seen: Problem | None = None,
    weights: Weights | None = None,
    reason: str = "",
    evaluations: int = 0,
) -> Estimate:
    """Estimate from a gain (m, n), metric (m, m; default: that of inverse MPC) and weights.

    `seen` is the problem at initial states and parameters of the method's own.
    """
    metric = start.metric if S is None else S
    settled = METHODS[name].restrict(start.problem.with_nuisance_fixed()) if seen is None else seen
    if problem.own_unknowns:
        settled = with_fitted_starts(settled, K, metric)
    return simulated_estimate(
        name,
        settled,
        K,
        metric,
        noise=start.noise,
        weights=weights,
        reason=reason,
        evaluations=evaluations,
    )


def of_weights(
    name: str, problem: Problem, start: Estimate, weights: Weights | None, evaluations: int = 0
) -> Estimate:
    """Estimate from the weights of a method; raises WeightsError without weights."""
    if weights is None:
        raise WeightsError(
            "weights",
            "no (Q, R) has exactly this gain",
            "use inverse_lqr_gradient for the nearest gain",
        )
    K = np.array(solve_lqr(problem.plant, weights).K)
    return of_gain(name, problem, start, K, weights=weights, evaluations=evaluations)


def feedback_gain(problem: Problem, start: Estimate) -> Estimate:
    """Best gain without bounds (3.12)."""
    return of_fitted_gain(problem, start, _feedback(start))


def of_fitted_gain(problem: Problem, start: Estimate, found: Fitted) -> Estimate:
    """Estimate of a gain without bounds."""
    K, seen = np.array(found.K), found.problem.with_nuisance_fixed()
    evaluations = found.evaluations
    return of_gain("feedback_gain", problem, start, K, seen=seen, evaluations=evaluations)


# Methods run in threads: the second one waits for what the first one computes.
_one_at_a_time = threading.Lock()


def _feedback(start: Estimate) -> Fitted:
    """Best gain without bounds, shared by five methods."""
    with _one_at_a_time:
        return _searched_feedback(start)


@functools.lru_cache(maxsize=4)
def _searched_feedback(start: Estimate) -> Fitted:
    """Best gain without bounds.

    The search is repeated from its own solution, because the prior is centred at the start. Without
    bounds the best gain may be unstable (saturated commands); it then has no whitened coordinates.
    """
    first = free_gain(start.problem.without_bounds().with_body_fixed(), start.stage_weights)
    if not stabilises(start.problem.plant, np.array(first.K)):
        return first
    again = refine_gain(first.problem, np.array(first.K), np.array(first.S), prior=1.0)
    return replace(again, evaluations=first.evaluations + again.evaluations)


@functools.lru_cache(maxsize=4)
def _coordinates(start: Estimate) -> tuple[Plant, Array, Weights, Array, Array]:
    """Plant, feedback gain and starting weights in whitened coordinates, T and G."""
    plant, K, own = start.problem.plant, np.array(_feedback(start).K), np.array(start.gain)
    T, G = natural_coordinates(plant, K if stabilises(plant, K) else own)
    natural = change_coordinates(plant, T, G)
    target, near = (np.asarray(np.linalg.solve(G, gain @ T)) for gain in (K, own))
    return natural, target, least_condition_weights(gain_fibre(natural, near)).weights, T, G


def _lmi(start: Estimate) -> Weights | None:
    """Weights with exactly the gain of `_feedback`; None if there are none."""
    natural, target, _, T, G = _coordinates(start)
    found = inverse_lqr_lmi(natural, target).weights
    return None if found is None else in_plant_units(found, T, G)


def _gradient(start: Estimate) -> Weights | None:
    """Weights with the nearest gain."""
    natural, target, centre, T, G = _coordinates(start)
    found = inverse_lqr_gradient(natural, target, centre).weights
    return None if found is None else in_plant_units(found, T, G)


def _auxiliary(start: Estimate) -> Weights:
    """Weights of the auxiliary problem (3.7)."""
    natural, target, centre, T, G = _coordinates(start)
    found = auxiliary_weights(natural, target, centre, tolerance=_CREEPS)
    return in_plant_units(found.weights, T, G)


def output_penalty(problem: Problem, start: Estimate, begin: Weights | None = None) -> Estimate:
    """Inverse LQR on the outputs (3.16), started at `begin` or at the weights of inverse MPC."""
    loose, noise = start.problem.with_nuisance_fixed().without_bounds(), noise_of(_feedback(start))
    found = inverse_mpc_natural(loose, begin or start.stage_weights, noise)
    name = "inverse_lqr_output"
    return of_weights(name, problem, start, found.weights, found.evaluations)


def _reduced(problem: Problem, start: Estimate) -> Estimate:
    """Fit the gain under the bounds, then compute weights with that gain."""
    behind = weights_behind(free_gain(start.problem.with_nuisance_fixed(), start.stage_weights))
    gain, weights = behind.gain, behind.weights
    # The misfit of the gain itself is noise and does not count against the weights.
    missed = weights is None or behind.misfit > (1 + _AS_GOOD) * gain.misfit
    return of_gain(
        "inverse_mpc_reduced",
        problem,
        start,
        np.array(gain.K),
        np.array(gain.S),
        weights=weights,
        reason=behind.reason if missed else "",
        evaluations=gain.evaluations,
    )


def _preliminary(problem: Problem, start: Estimate) -> Estimate:
    K, there = preliminary_gain(problem, problem.feedback_states)
    return of_gain("preliminary", problem, start, K, seen=there.with_nuisance_fixed())


def _commands(problem: Problem, start: Estimate) -> Estimate:
    seen = start.problem.with_nuisance_fixed()
    found = regress_commands(seen, np.array(start.gain), np.array(start.metric))
    return of_gain("command_regression", problem, start, np.array(found.K))


def _structured(problem: Problem, start: Estimate) -> Estimate:
    if problem.structure is None:
        raise InputError(
            "structured", "the problem has no structure", "pass Problem(..., structure=...)"
        )
    return fit_structured(problem, problem.structure, start)


def _as_posed(problem: Problem) -> Problem:
    return problem


def _without_bounds(problem: Problem) -> Problem:
    return problem.without_bounds()


def _cut_off(problem: Problem) -> Problem:
    """Horizon of one sample, without state bounds or terminal set: clipping without preview."""
    given, plant = problem.bounds, problem.plant
    free = ~np.isin(plant.states, plant.commands)
    limits = replace(
        given,
        x_min=np.where(free, -np.inf, given.x_min),
        x_max=np.where(free, np.inf, given.x_max),
    )
    return replace(problem, bounds=limits, horizon=1, terminal_set=False)


_TABLE = (
    Method(
        "preliminary",
        "preliminary gains and parameters",
        "Gains on a few states alone, fitted together with the physical parameters.",
        _without_bounds,
        _preliminary,
    ),
    Method(
        "feedback_gain",
        "no limit, gain only",
        "The gain whose movement comes nearest to the recorded one, as if there were no limit. It "
        "has no cost weights.",
        _without_bounds,
        feedback_gain,
    ),
    Method(
        "inverse_lqr_lmi",
        "no limit, inverse LQR (exact)",
        "Cost weights whose best gain is exactly that gain. There may be none, and for a gain "
        "fitted to noisy recordings there usually are none.",
        _without_bounds,
        lambda problem, start: of_weights("inverse_lqr_lmi", problem, start, _lmi(start)),
    ),
    Method(
        "inverse_lqr_gradient",
        "no limit, inverse LQR (nearest)",
        "Cost weights whose best gain comes nearest to that gain.",
        _without_bounds,
        lambda problem, start: of_weights("inverse_lqr_gradient", problem, start, _gradient(start)),
    ),
    Method(
        "inverse_lqr_auxiliary",
        "no limit, inverse LQR (regular)",
        "The same, with a penalty on the condition number that keeps the cost weights away from "
        "singular ones.",
        _without_bounds,
        lambda problem, start: of_weights(
            "inverse_lqr_auxiliary", problem, start, _auxiliary(start)
        ),
    ),
    Method(
        "inverse_lqr",
        "no limit, classical inverse LQR",
        "The classical method: cost weights with exactly that gain where there are any, otherwise "
        "regular ones whose gain is near to it.",
        _without_bounds,
        lambda problem, start: of_weights(
            "inverse_lqr", problem, start, _lmi(start) or _auxiliary(start)
        ),
    ),
    Method(
        "inverse_lqr_output",
        "no limit, fitted to movement",
        "Cost weights whose controller, as if there were no limit, fits the movement best.",
        _without_bounds,
        output_penalty,
    ),
    Method(
        "clipped_lqr",
        "no planning ahead, cut at the limit",
        "The gain of inverse MPC with its command cut off at the limit: it does not plan ahead.",
        _cut_off,
        lambda problem, start: of_gain(
            "clipped_lqr", problem, start, np.array(start.gain), weights=start.weights
        ),
    ),
    Method(
        "inverse_mpc_reduced",
        "with limit, gain first",
        "First the gain whose controller, with its limits, fits the movement best, then cost "
        "weights with this gain, if there are any.",
        _as_posed,
        _reduced,
    ),
    Method(
        "inverse_mpc",
        "with limit, inverse MPC",
        "Cost weights whose controller, with its limits, fits the movement best.",
        _as_posed,
        lambda problem, start: fit_controller(problem, start.stage_weights),
    ),
    Method(
        "command_regression",
        "regression on recorded commands",
        "The gain that the recorded commands follow where no limit is reached.",
        _as_posed,
        _commands,
    ),
    Method(
        "structured",
        "with limit, named cost weights",
        "Cost weights of the features that you name, whose controller, with its limits, fits the "
        "movement best.",
        _as_posed,
        _structured,
    ),
)

#: All methods by name.
METHODS: dict[str, Method] = {method.name: method for method in _TABLE}


@checked
def method_named(name: str) -> Method:
    """Return the registered method called `name`."""
    if name == "inverse_kkt":
        raise InputError(
            "method",
            "inverse_kkt is not part of impc",
            "remove it from methods; experiments/inverse_kkt.py has the code",
        )
    if name not in METHODS:
        raise InputError("method", f"got {name!r}", f"choose one of {', '.join(METHODS)}")
    return METHODS[name]


@checked
def fit(
    problem: Problem,
    method: str = "inverse_mpc",
    *,
    start: Estimate | Weights | None = None,
) -> Estimate:
    """Identify the controller behind recordings.

    The logger "impc" reports each completed stage; `logging.basicConfig(level="INFO")` prints it.

    Parameters
    ----------
    problem : Problem
        Recordings and the closed loop to identify.
    method : str, default "inverse_mpc"
        A key of `METHODS`: "inverse_mpc", or a method to compare with it, such as "feedback_gain",
        "inverse_lqr_lmi", "inverse_lqr_gradient", "inverse_lqr_output" or "clipped_lqr".
    start : Estimate or Weights, optional
        Starting point: weights, or an earlier inverse MPC estimate of these or other recordings. By
        default several starts are tried. Other methods start from the inverse MPC estimate, which
        is computed first if it is not given.

    Returns
    -------
    Estimate
        Gain, weights and diagnostics; `status` states how the method ended.

    Raises
    ------
    InputError
        If the method is unknown.
    WeightsError, SolverError
        If no starting controller can be simulated on the recordings.

    Examples
    --------
    >>> import control
    >>> import impc
    >>> plant = impc.Plant(control.ss([[2, -1], [1, 0.2]], [[1], [0]], [[1, 0], [0, 1]], 0, 1))
    >>> bounds = impc.Bounds(plant, u_min=-1, u_max=1)
    >>> truth = impc.Controller(plant, impc.Weights([[1, 0], [0, 1]], 1), bounds, horizon=3)
    >>> trial = impc.Recording(plant, truth.simulate([1, 3], steps=20).x)
    >>> found = impc.fit(impc.Problem(plant, bounds, 3, [trial]))
    >>> found.weights.Q.round(6) + 0.0
    array([[1., 0.],
           [0., 1.]])
    """
    chosen, first = method_named(method), start
    if chosen.name != "inverse_mpc":
        require_riccati(problem)
    if chosen.name == "inverse_mpc" or not isinstance(first, Estimate):
        started = time.perf_counter()
        if problem.terminal_weight is None:
            first = fit_controller(*_begun(problem, start))
        elif start is None:
            first = fit_weights(problem)
        else:
            raise InputError("start", "cannot be combined with terminal_weight", "remove start")
        first = replace(first, seconds=time.perf_counter() - started)
        _LOG.info("%s", first)
    if chosen.name == "inverse_mpc":
        return first
    found = chosen.estimate(problem, first)
    _LOG.info("%s", found)
    return found


def _begun(problem: Problem, start: Estimate | Weights | None) -> tuple[Problem, Weights | None]:
    """Problem and weights from which a search starts."""
    if not isinstance(start, Estimate):
        return problem, start
    there, same = start.problem, start.problem.starts.shape == problem.starts.shape
    if problem.unknown_start and same and there.logarithms.shape == problem.logarithms.shape:
        own = (np.array(part) for part in (there.starts, there.logarithms, there.errors))
        problem = problem.at(*own)
    return problem, start.stage_weights
