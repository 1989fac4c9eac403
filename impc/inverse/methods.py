"""Every method for the weights behind recordings, each on the same problem.

    feedback_gain          any gain, no bounds (3.12)
    inverse_lqr_lmi        weights of least condition number with exactly that gain
    inverse_lqr_gradient   weights whose regulator's gain is nearest to it
    inverse_lqr_auxiliary  the same with a condition-number penalty (3.7)
    inverse_lqr_output     weights whose regulator, without bounds, fits the outputs best (3.16)
    inverse_kkt            least stationarity residual on smoothed trajectories
    inverse_mpc_reduced    any gain, under the bounds; then weights with exactly that gain
    inverse_mpc_direct     weights whose constrained controller fits the outputs best (3.6)

Searches begin at the best diagonal weights and go on in natural coordinates. Initial states and
physical parameters are those that the reduced form finds; each method's initial states are fitted
again for its own gain before it is judged.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.checking import replace
from impc.errors import ImpcError, SolverError, WeightsError
from impc.inverse.diagonal_start import diagonal_weights
from impc.inverse.direct_and_reduced import auxiliary_weights
from impc.inverse.equivalent_weights import least_condition_weights
from impc.inverse.explaining_weights import weights_behind
from impc.inverse.inverse_lqr import inverse_lqr_gradient, inverse_lqr_lmi
from impc.inverse.natural_search import in_plant_units, inverse_mpc_natural
from impc.inverse.noisy_fit import free_gain, noise_of
from impc.inverse.solution_set import gain_fibre, natural_coordinates
from impc.inverse.stationarity import inverse_kkt
from impc.model.plant import change_coordinates
from impc.model.riccati import is_stable, solve_lqr
from impc.model.weights import Weights

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.inverse.problem import Problem
    from impc.model.plant import Plant

__all__ = ["METHODS", "Estimate", "decode_estimate", "encode_estimate", "estimate_all"]

#: Names of the methods, in the order in which they are estimated.
METHODS = (
    "feedback_gain",
    "inverse_lqr_lmi",
    "inverse_lqr_gradient",
    "inverse_lqr_auxiliary",
    "inverse_lqr_output",
    "inverse_kkt",
    "inverse_mpc_reduced",
    "inverse_mpc_direct",
)


@dataclass(frozen=True)
class Estimate(Frozen):
    """What one method makes of one set of recordings.

    Attributes
    ----------
    K, S : Array or None
        Gain (m, n) and metric (m, m); None when the method ended without them.
    weights : Weights or None
        None when the method ended without them.
    starts : Array
        Initial states that were taken (trials, n).
    logarithms : Array
        Of the physical parameters (k,).
    noise : float
        2-norm of the residual that counts as noise for the methods that follow.
    seconds : float
        Time that it took, s.
    reason : str
        Why there is no gain, or no weights.
    """

    K: Array | None
    S: Array | None
    weights: Weights | None
    starts: Array
    logarithms: Array
    noise: float
    seconds: float
    reason: str


def estimate_all(
    problem: Problem,
    remember: Callable[[str, Callable[[], Estimate]], Estimate] = lambda _, compute: compute(),
) -> dict[str, Estimate]:
    """Run every method of the module's text.

    Parameters
    ----------
    problem : Problem
    remember : callable
        (name, compute) -> the estimate: from memory, or computed now.
    """
    begin = _Begin(problem)
    reduced = remember("inverse_mpc_reduced", lambda: _timed(begin, _reduced, problem))
    found = {"inverse_mpc_reduced": reduced}
    if reduced.K is None:
        return found
    here = problem.at(np.array(reduced.starts), np.array(reduced.logarithms))
    known = replace(here, unknown_start=False, family=None, logarithms=frozen([]))
    feedback = remember("feedback_gain", lambda: _timed(begin, _feedback, known.without_bounds()))
    found["feedback_gain"] = feedback
    finders: dict[str, Callable[[], Weights]] = {
        "inverse_lqr_lmi": lambda: _lmi(*_natural(known.plant, feedback, begin)),
        "inverse_lqr_gradient": lambda: _gradient(*_natural(known.plant, feedback, begin)),
        "inverse_lqr_auxiliary": lambda: _auxiliary(*_natural(known.plant, feedback, begin)),
        "inverse_lqr_output": lambda: _direct(known.without_bounds(), begin, feedback),
        "inverse_kkt": lambda: inverse_kkt(known, begin.gain),
        "inverse_mpc_direct": lambda: _direct(known, begin, reduced),
    }
    for name, find in finders.items():
        found[name] = remember(name, lambda find=find: _weights(find, reduced, known.plant))  # type: ignore[misc]
    return {name: found[name] for name in METHODS}


class _Begin:
    """The best diagonal weights, computed when first asked for."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.found: Weights | None = None

    @property
    def weights(self) -> Weights:
        if self.found is None:
            self.found = diagonal_weights(self.problem)
        return self.found

    @property
    def gain(self) -> Array:
        return np.array(solve_lqr(self.problem.plant, self.weights).K)


def _timed(
    begin: _Begin, find: Callable[[_Begin, Problem], Estimate], problem: Problem
) -> Estimate:
    begin.weights  # noqa: B018 - the start is common to all methods and not in any one's time
    started = time.perf_counter()
    try:
        found = find(begin, problem)
    except (WeightsError, SolverError) as error:
        found = _nothing(problem, str(error))
    return replace(found, seconds=time.perf_counter() - started)


def _weights(find: Callable[[], Weights], reduced: Estimate, plant: Plant) -> Estimate:
    """The estimate of a method that ends with weights, at the states of the reduced form."""
    started = time.perf_counter()
    try:
        weights = find()
        solution = solve_lqr(plant, weights)
    except ImpcError as error:
        found = replace(reduced, K=None, S=None, weights=None, reason=str(error))
    else:
        found = replace(reduced, K=solution.K, S=solution.S, weights=weights, reason="")
    return replace(found, seconds=time.perf_counter() - started)


def _reduced(begin: _Begin, problem: Problem) -> Estimate:
    behind = weights_behind(free_gain(problem, begin.weights))
    free, reason = behind.gain, behind.reason
    weights = None if behind.equivalent is None else behind.equivalent.weights
    starts = frozen([trial.x0 for trial in free.problem.recordings])
    return Estimate(
        free.K, free.S, weights, starts, free.problem.logarithms, noise_of(free), 0.0, reason
    )


def _feedback(begin: _Begin, loose: Problem) -> Estimate:
    free = free_gain(loose, begin.weights)
    starts = frozen([trial.x0 for trial in loose.recordings])
    return Estimate(free.K, free.S, None, starts, loose.logarithms, noise_of(free), 0.0, "")


def _nothing(problem: Problem, reason: str) -> Estimate:
    starts = frozen([trial.x0 for trial in problem.recordings])
    return Estimate(None, None, None, starts, problem.logarithms, np.nan, 0.0, reason)


def _natural(
    plant: Plant, feedback: Estimate, begin: _Begin
) -> tuple[Plant, Array, Array, Array, Array]:
    """Plant, feedback gain and starting gain in natural coordinates, with the coordinates."""
    if feedback.K is None:
        raise SolverError("feedback gain", f"none was found: {feedback.reason}", "see there")
    K = np.array(feedback.K)
    stable = is_stable(plant.A - plant.B @ K, discrete=True)
    T, G = natural_coordinates(plant, K if stable else begin.gain)
    natural = change_coordinates(plant, T, G)
    scaled = [np.asarray(np.linalg.solve(G, gain @ T)) for gain in (K, begin.gain)]
    return natural, scaled[0], scaled[1], T, G


def _lmi(natural: Plant, target: Array, _: Array, T: Array, G: Array) -> Weights:
    found = inverse_lqr_lmi(natural, target)
    if found.weights is None:
        raise WeightsError("feedback gain", found.status, "see the gradient method")
    return in_plant_units(found.weights, T, G)


def _gradient(natural: Plant, target: Array, start: Array, T: Array, G: Array) -> Weights:
    centre = least_condition_weights(gain_fibre(natural, start)).weights
    found = inverse_lqr_gradient(natural, target, centre)
    if found.weights is None:
        raise WeightsError("feedback gain", found.status, "give longer recordings")
    return in_plant_units(found.weights, T, G)


def _auxiliary(natural: Plant, target: Array, start: Array, T: Array, G: Array) -> Weights:
    centre = least_condition_weights(gain_fibre(natural, start)).weights
    return in_plant_units(auxiliary_weights(natural, target, centre).weights, T, G)


def _direct(problem: Problem, begin: _Begin, before: Estimate) -> Weights:
    return inverse_mpc_natural(problem, begin.weights, before.noise).weights


def encode_estimate(estimate: Estimate) -> dict[str, Any]:
    """Values that JSON keeps to the last digit."""
    given = estimate.weights
    return {
        "K": None if estimate.K is None else estimate.K.tolist(),
        "S": None if estimate.S is None else estimate.S.tolist(),
        "Q": None if given is None else given.Q.tolist(),
        "R": None if given is None else given.R.tolist(),
        "starts": estimate.starts.tolist(),
        "logarithms": estimate.logarithms.tolist(),
        "noise": None if np.isnan(estimate.noise) else estimate.noise,
        "seconds": estimate.seconds,
        "reason": estimate.reason,
    }


def decode_estimate(kept: dict[str, Any]) -> Estimate:
    """Inverse of `encode_estimate`, of what it `kept`."""
    return Estimate(
        None if kept["K"] is None else frozen(kept["K"]),
        None if kept["S"] is None else frozen(kept["S"]),
        None if kept["Q"] is None else Weights(kept["Q"], kept["R"]),
        frozen(kept["starts"]),
        frozen(kept["logarithms"]),
        np.nan if kept["noise"] is None else kept["noise"],
        kept["seconds"],
        kept["reason"],
    )
