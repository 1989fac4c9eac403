"""Every method for the weights behind recordings, by the name that it has everywhere.

A method is a function (problem, start) -> estimate. It starts from what inverse MPC found: initial
states and physical parameters are its, every search begins at its weights, so that none loses by
where it began, and each method's own gain has its initial states fitted again. All work in natural
coordinates, and weigh squared misfits against the noise that the best gain leaves
(docs/fitting.md). Table 3.1 as printed, in the units of the plant, is `impc.inverse.table31`.

The names are those in result.json, the labels those of tables and figures; commands and tests
choose from `METHODS`.
"""

from __future__ import annotations

import functools
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.checking import checked, replace
from impc.errors import ImpcError, InputError, WeightsError
from impc.inverse.command_regression import regress_commands
from impc.inverse.delayed_feedback import preliminary_gain
from impc.inverse.equivalent_weights import least_condition_weights
from impc.inverse.estimates import Estimate, no_estimate, simulated_estimate
from impc.inverse.explaining_weights import weights_behind
from impc.inverse.gain_search import refine_gain
from impc.inverse.inverse_lqr import inverse_lqr_gradient, inverse_lqr_lmi
from impc.inverse.natural_search import in_plant_units, inverse_mpc_natural
from impc.inverse.noisy_fit import fit_controller, free_gain, noise_of, with_fitted_starts
from impc.inverse.problem import require_riccati
from impc.inverse.proximal_search import auxiliary_weights
from impc.inverse.solution_set import gain_fibre, natural_coordinates
from impc.inverse.structured_fit import fit_structured
from impc.inverse.weight_fit import fit_weights
from impc.model.plant import change_coordinates
from impc.model.riccati import solve_lqr, stabilises
from impc.model.weights import Weights

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.inverse.gain_search import GainFit
    from impc.inverse.problem import Problem
    from impc.model.plant import Plant

_LOG = logging.getLogger("impc")
# Share by which weights may miss the recordings by more than the gain that they were found for.
_AS_GOOD = 1e-3


@dataclass(frozen=True)
class Method:
    """A way from recordings to a controller."""

    name: str  # In result.json, in TOML and at the command line
    label: str  # In tables and figures
    sentence: str  # For readers who do not know it
    # The problem as posed -> as the method sees it: inverse LQR knows no bounds
    restrict: Callable[[Problem], Problem]
    # The problem as posed, the estimate of inverse MPC -> its own
    find: Callable[[Problem, Estimate], Estimate]

    def estimate(self, problem: Problem, start: Estimate) -> Estimate:
        """Run the method; one that ends without a gain says why in its estimate."""
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
    """The estimate of a method from its gain (m, n), metric (m, m) and weights.

    Without a metric it has that of inverse MPC; `seen` is the problem at initial states and
    parameters of its own.
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
    """The estimate of a method from its weights, if it has found any."""
    if weights is None:
        raise WeightsError("weights", "none have the feedback gain", "see the gradient method")
    K = np.array(solve_lqr(problem.plant, weights).K)
    return of_gain(name, problem, start, K, weights=weights, evaluations=evaluations)


def feedback_gain(problem: Problem, start: Estimate) -> Estimate:
    """The best gain without bounds (3.12)."""
    return of_fitted_gain(problem, start, _feedback(start))


def of_fitted_gain(problem: Problem, start: Estimate, found: GainFit) -> Estimate:
    """The estimate of a gain without bounds."""
    K, seen = np.array(found.K), found.problem.with_nuisance_fixed()
    evaluations = found.evaluations
    return of_gain("feedback_gain", problem, start, K, seen=seen, evaluations=evaluations)


@functools.lru_cache(maxsize=4)
def _feedback(start: Estimate) -> GainFit:
    """That gain, which five methods share.

    Searched again from where it ends: the prior is about the start, which may be far. Without
    bounds the best gain may be unstable, of a person who saturates; it has no coordinates.
    """
    first = free_gain(start.problem.without_bounds().with_body_fixed(), start.stage_weights)
    if not stabilises(start.problem.plant, np.array(first.K)):
        return first
    again = refine_gain(first.problem, np.array(first.K), np.array(first.S), prior=1.0)
    return replace(again, evaluations=first.evaluations + again.evaluations)


@functools.lru_cache(maxsize=4)
def _coordinates(start: Estimate) -> tuple[Plant, Array, Weights, Array, Array]:
    """Plant and feedback gain in natural coordinates, weights to start from, T and G."""
    plant, K, own = start.problem.plant, np.array(_feedback(start).K), np.array(start.gain)
    T, G = natural_coordinates(plant, K if stabilises(plant, K) else own)
    natural = change_coordinates(plant, T, G)
    target, near = (np.asarray(np.linalg.solve(G, gain @ T)) for gain in (K, own))
    return natural, target, least_condition_weights(gain_fibre(natural, near)).weights, T, G


def _lmi(start: Estimate) -> Weights | None:
    """Weights with exactly that gain, if there are any."""
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
    return in_plant_units(auxiliary_weights(natural, target, centre).weights, T, G)


def output_penalty(problem: Problem, start: Estimate, begin: Weights | None = None) -> Estimate:
    """(3.16), from some weights, or those of inverse MPC."""
    loose, noise = start.problem.with_nuisance_fixed().without_bounds(), noise_of(_feedback(start))
    found = inverse_mpc_natural(loose, begin or start.stage_weights, noise)
    name = "inverse_lqr_output"
    return of_weights(name, problem, start, found.weights, found.evaluations)


def _reduced(problem: Problem, start: Estimate) -> Estimate:
    """Gain under the bounds, then weights with that gain."""
    behind = weights_behind(free_gain(start.problem.with_nuisance_fixed(), start.stage_weights))
    weights = None if behind.equivalent is None else behind.equivalent.weights
    gain = behind.gain
    # What the gain leaves too is noise, and no fault of the weights.
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
            "structured", "the problem names no structure", "give Problem(..., structure=...)"
        )
    return fit_structured(problem, problem.structure, start)


def _as_posed(problem: Problem) -> Problem:
    return problem


def _without_bounds(problem: Problem) -> Problem:
    return problem.without_bounds()


def _cut_off(problem: Problem) -> Problem:
    """A horizon of one sample without state bounds or terminal set: cut off, no foresight."""
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
        "cut off at the limit",
        "The gain of inverse MPC, its command cut off at the limit: it does not plan ahead.",
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

#: Every method by its name. A new one is one more entry.
METHODS: dict[str, Method] = {method.name: method for method in _TABLE}


@checked
def method_named(name: str) -> Method:
    """Return the method of the registry that is called `name`."""
    if name == "inverse_kkt":
        raise InputError(
            "method", "inverse_kkt was removed", "take it out; experiments/inverse_kkt.py has it"
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
    """Find the controller behind recordings.

    Each stage is named in the log "impc" when it is done; logging.basicConfig(level="INFO") shows
    it.

    Parameters
    ----------
    problem : Problem
    method : str
        A key of `METHODS`: "inverse_mpc", or one to compare it with, such as "feedback_gain",
        "inverse_lqr_lmi", "inverse_lqr_gradient", "inverse_lqr_output" or "clipped_lqr".
    start : Estimate or Weights, optional
        Where the search begins: an earlier estimate of inverse MPC, of the same recordings or
        others, or weights. By default several starts are tried. The methods beside inverse MPC
        begin with its estimate, which is fitted first where none is given.

    Raises
    ------
    InputError
        When there is no such method.
    WeightsError, SolverError
        When no regulator can be simulated on the recordings.

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
            raise InputError("start", "has no use beside a terminal_weight", "leave it out")
        first = replace(first, seconds=time.perf_counter() - started)
        _LOG.info("%s", first)
    if chosen.name == "inverse_mpc":
        return first
    found = chosen.estimate(problem, first)
    _LOG.info("%s", found)
    return found


def _begun(problem: Problem, start: Estimate | Weights | None) -> tuple[Problem, Weights | None]:
    """The problem and the weights from which a search begins."""
    if not isinstance(start, Estimate):
        return problem, start
    there, same = start.problem, start.problem.starts.shape == problem.starts.shape
    if problem.unknown_start and same and there.logarithms.shape == problem.logarithms.shape:
        own = (np.array(part) for part in (there.starts, there.logarithms, there.shifts))
        problem = problem.at(*own)
    return problem, start.stage_weights
