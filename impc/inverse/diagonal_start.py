"""The diagonal weights that fit recordings best: where a search for a gain starts.

A regulator always stabilises, and n prices of states, with R = I, describe enough of them
to come near any gain. So the search for the prices rarely leaves what can be simulated,
and from its end the search for the gain itself has a short way. On the noisy seat at three torque
limits it finds the right basin from here where it misses it from Bryson's rule
(docs/fitting.md; experiments/benchmarks/search.py).

The unknowns are the logarithms of q_i, Q = diag(q_i (u / x_i)^2), where x_i and u are the sizes
that states and command have under the best of `bryson_weights`; a normal prior of a factor e^3
about that start keeps those prices where they are that the recordings do not see.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.optimize

from impc.arrays import Array, frozen
from impc.checking import replace
from impc.control.closed_loop import simulate
from impc.errors import SolverError, WeightsError
from impc.inverse.one_step import one_step
from impc.inverse.problem import controller_for, scenarios
from impc.inverse.residuals import Evaluation, evaluate, misfit_or_reason, unusable
from impc.model.riccati import LqrSolution, gain_gradients, solve_lqr
from impc.model.weights import Weights

if TYPE_CHECKING:
    from impc.inverse.problem import Problem

__all__ = ["bryson_regulators", "bryson_weights", "diagonal_weights"]

# Nine decades below the price of a command as large as the outputs to three above: what angles and
# torques need, metres and newtons, and plants without units.
_PRICES = 10.0 ** np.arange(-9, 4)
# Mean square of an output that is zero throughout.
_NOTHING = 1e-300
_SPREAD = 3.0
# A price that no output tells of starts at this share of the cost of the command.
_SMALL = 1e-2
# The end is only a start: a decrease of 1e-3 of the misfit is not worth another step.
_TOLERANCE = 1e-3


def bryson_weights(problem: Problem) -> list[Weights]:
    """Weights that price each recorded output by its size (Bryson's rule), over a range of efforts.

    Q = C'diag(p/mean(y^2))C plus 1e-8 of its mean diagonal, R = rho I for rho from 1e-9 to 1e3,
    with p the geometric mean of the outputs' mean(y^2): with all numbers a million times larger the
    weights are the same.
    """
    plant = problem.plant
    recorded = np.concatenate([trial.outputs for trial in problem.recordings])
    power = np.maximum(np.mean(recorded**2, axis=0), _NOTHING)
    seen = power > _NOTHING
    common = np.exp(np.mean(np.log(power[seen]))) if np.any(seen) else _NOTHING
    Q = plant.C.T @ np.diag(common / power) @ plant.C
    Q += 1e-8 * np.trace(Q) / plant.n * np.eye(plant.n)
    return [Weights(Q, rho * np.eye(plant.m)) for rho in _PRICES]


def bryson_regulators(problem: Problem) -> list[tuple[Weights, LqrSolution]]:
    """Those of `bryson_weights` that have a regulator to working precision, with it.

    Raises
    ------
    WeightsError
        When none has.
    """
    found: list[tuple[Weights, LqrSolution]] = []
    refused: list[WeightsError] = []
    for weights in bryson_weights(problem):
        try:
            found.append((weights, solve_lqr(problem.plant, weights)))
        except WeightsError as error:  # so cheap a command that R is lost beside B'PB
            refused.append(error)
    if not found:
        raise refused[-1]
    return found


def diagonal_weights(problem: Problem, *, max_evaluations: int = 15) -> Weights:
    """Fit the prices of the states, at given initial states, plant and R = I.

    Where no regulator of `bryson_weights` can be simulated to the end, sample by sample
    (`one_step`).

    `max_evaluations` bounds the number of simulations of all trials.

    Raises
    ------
    WeightsError, SolverError
        When none of `bryson_weights` has a regulator, or none can be simulated, or nothing moves in
        the simulation.
    """
    known = replace(problem, unknown_start=False, family=None, logarithms=frozen([]))
    try:
        ranked = _ranked(known)
    except SolverError:  # every one diverges, which takes more than a step
        known = one_step(known)
        ranked = _ranked(known)
    search = _first_usable(known, ranked)
    start = search.start
    noise = float(np.linalg.norm(search.at(start).residual)) / np.sqrt(search.samples)
    weight = noise / _SPREAD

    def residual(z: Array) -> Array:
        return np.concatenate([search.at(z).residual, weight * (z - start)])

    def derivative(z: Array) -> Array:
        return np.vstack([search.derivative(z), weight * np.eye(len(z))])

    found = scipy.optimize.least_squares(
        residual, start, jac=derivative, ftol=_TOLERANCE, max_nfev=max_evaluations
    )
    return search.weights(found.x)


def _ranked(problem: Problem) -> list[tuple[Weights, LqrSolution]]:
    """Those of `bryson_weights` that can be simulated, least misfit first.

    The others stand by what was seen until they were farther off than the best so far.
    """
    candidates, reason, best = [], "", np.inf
    for weights, solution in bryson_regulators(problem):
        size, why = misfit_or_reason(problem, solution.K, solution.S, best)
        reason = reason or why
        if not why:
            best = min(best, size)
            candidates.append((size, weights, solution))
    if not candidates:
        raise SolverError(
            "gain", f"no regulator can be simulated: {reason}", "check the plant and the bounds"
        )
    candidates.sort(key=lambda item: item[0])
    return [(weights, solution) for _, weights, solution in candidates]


def _first_usable(problem: Problem, ranked: list[tuple[Weights, LqrSolution]]) -> _Prices:
    """The search from the best weights whose diagonal has a regulator that can be simulated too.

    A price on each state is another regulator than that of Bryson's rule: beside a command that is
    all but free its Riccati equation may have no solution in double precision.
    """
    searches = (_Prices(problem, *item) for item in ranked)
    reason = ""
    for search in searches:
        reason = search.at(search.start).evaluation.reason
        if not reason:
            return search
    raise SolverError(
        "gain", f"no diagonal weights can be simulated: {reason}", "check the plant and the bounds"
    )


@dataclass(frozen=True)
class _Evaluated:
    evaluation: Evaluation
    solution: LqrSolution

    @property
    def residual(self) -> Array:
        return self.evaluation.residual


class _Prices:
    """The residual as a function of the logarithms of the prices; keeps the last evaluation."""

    def __init__(self, problem: Problem, weights: Weights, solution: LqrSolution) -> None:
        self.problem, self.solution = problem, solution
        controller = controller_for(problem, solution.K, solution.S)
        runs = [simulate(controller, drive) for drive in scenarios(problem)]
        x, u = (np.concatenate([getattr(run, name) for run in runs]) for name in "xu")
        state, command = np.sqrt(np.mean(x**2, axis=0)), np.sqrt(np.mean(u**2))
        if not np.any(state) or command == 0:
            raise SolverError(
                "recordings", "nothing drives them", "record a disturbance, or give initial states"
            )
        moving = state > 1e-12 * np.max(state)
        self.unit = (command / np.where(moving, state, np.min(state[moving]))) ** 2
        self.samples = sum(trial.outputs.size for trial in problem.recordings)
        priced = np.diag(weights.Q) / weights.R[0, 0] / self.unit
        self.start = np.log(np.maximum(priced, _SMALL))
        self.last: tuple[bytes, _Evaluated] | None = None

    def weights(self, z: Array) -> Weights:
        return Weights(np.diag(np.exp(z) * self.unit), np.eye(self.problem.plant.m))

    def at(self, z: Array) -> _Evaluated:
        key = z.tobytes()
        if self.last is None or self.last[0] != key:
            try:
                solution = solve_lqr(self.problem.plant, self.weights(z))
            except WeightsError as error:  # a trial step too far: the search steps back from it
                self.last = (key, _Evaluated(unusable(self.problem, str(error)), self.solution))
                return self.last[1]
            found = evaluate(self.problem, solution.K, solution.S)
            self.last = (key, _Evaluated(found, solution))
        return self.last[1]

    def derivative(self, z: Array) -> Array:
        """Through the gain alone: that of the metric is small, and this is a start."""
        here = self.at(z)
        change = gain_gradients(here.solution).Q  # (m, n, n, n)
        diagonal = np.einsum("mnii->mni", change) * np.exp(z) * self.unit
        return np.asarray(np.tensordot(here.evaluation.dK, diagonal, 2))
