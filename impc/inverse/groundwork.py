"""What methods on the same recordings start from, each part made when it is first asked for.

PlantUnits    Table 3.1 as printed, for recordings without noise: condition numbers are taken in
the units of the plant, misfits as they are
NaturalUnits  for recordings with noise (docs/fitting.md): natural coordinates, squared misfits
weighed against the noise that the best gain leaves; initial states and physical
parameters are those of inverse MPC, every search begins at its weights, so that
none loses by where it began, and each method's own gain has its initial states
fitted again
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen
from impc.checking import replace
from impc.errors import WeightsError
from impc.inverse.direct_and_reduced import (
    CONDITION_WEIGHT,
    inverse_mpc,
    inverse_mpc_reduced,
    output_penalty_weights,
)
from impc.inverse.equivalent_weights import least_condition_weights
from impc.inverse.estimates import Estimate
from impc.inverse.explaining_weights import weights_behind
from impc.inverse.gain_search import GainFit, fit_gain, refine_gain
from impc.inverse.inverse_lqr import InverseLqr, inverse_lqr_gradient, inverse_lqr_lmi
from impc.inverse.natural_search import in_plant_units, inverse_mpc_natural
from impc.inverse.noisy_fit import fit_controller, free_gain, noise_of, with_fitted_starts
from impc.inverse.problem import EXPLAINED, recorded_size
from impc.inverse.proximal_search import auxiliary_weights
from impc.inverse.solution_set import gain_fibre, natural_coordinates
from impc.model.plant import change_coordinates
from impc.model.riccati import solve_lqr, stabilises
from impc.model.weights import Weights

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.inverse.problem import Problem
    from impc.model.plant import Plant

# Share by which weights may miss the recordings by more than the gain that they were found for.
_AS_GOOD = 1e-3

#: (name, compute) -> the estimate: from memory, or computed now.
Remember = Callable[[str, Callable[[], Estimate]], Estimate]


def afresh(_name: str, make: Callable[[], Estimate]) -> Estimate:
    """`make` an estimate, whatever its `_name`: the `Remember` of whoever remembers nothing."""
    return make()


@dataclass(frozen=True)
class Found(Frozen):
    """What a method hands back, before it is simulated."""

    K: Array  # (m, n)
    weights: Weights | None = None
    evaluations: int = 0  # Simulations with derivatives
    # Metric (m, m) where it is not that of inverse MPC: without bounds it has no effect
    S: Array | None = None
    reason: str = ""  # Why there are no weights; empty otherwise
    settled: bool = True  # Whether the search ended by itself
    # At the initial states and parameters found, where they are the method's own
    problem: Problem | None = None


class PlantUnits:
    """Table 3.1 for recordings without noise, in the units of the plant."""

    def __init__(self, problem: Problem) -> None:
        self.problem = self.known = problem
        self.metric: Array = np.eye(problem.plant.m)
        self.noise = EXPLAINED * recorded_size(problem)

    def settle(self, seen: Problem, _K: Array, _S: Array) -> Problem:
        """The problem `seen`, whatever the gain `_K` (m, n) and the metric `_S` (m, m)."""
        return seen

    @cached_property
    def feedback(self) -> GainFit:
        """The best gain without bounds: line 1."""
        return fit_gain(self.problem.without_bounds())

    @cached_property
    def lmi(self) -> InverseLqr:
        """Weights with exactly that gain, if any: line 2."""
        return inverse_lqr_lmi(self.problem.plant, self.feedback.K)

    @cached_property
    def gradient(self) -> InverseLqr:
        """Weights with the nearest gain: line 4."""
        return inverse_lqr_gradient(self.problem.plant, self.feedback.K)

    @cached_property
    def auxiliary(self) -> Weights:
        """Weights of the auxiliary problem (3.7): line 5."""
        plant, start = self.problem.plant, self.gradient.weights
        return auxiliary_weights(plant, np.array(self.feedback.K), start).weights

    @property
    def start(self) -> Weights:
        """Line 5 or 7: where (3.6) and (3.16) start."""
        return self.auxiliary if self.lmi.weights is None else self.lmi.weights

    @property
    def starting_gain(self) -> Array:
        """Its gain (m, n)."""
        return np.array(solve_lqr(self.problem.plant, self.start).K)

    def output(self) -> Found:
        """(3.16)."""
        found = output_penalty_weights(self.problem, self.start, condition_weight=CONDITION_WEIGHT)
        return regulator(self, found.weights, found.evaluations)

    def inverse_mpc(self) -> Found:
        """Line 9, (3.6)."""
        found = inverse_mpc(self.problem, self.start, condition_weight=CONDITION_WEIGHT)
        K, S = np.array(found.solution.K), np.array(found.solution.S)
        return Found(K, found.weights, found.evaluations, S, settled=found.converged)

    def reduced(self) -> Found:
        """Gain under the bounds, then weights with that gain."""
        found = inverse_mpc_reduced(self.problem)
        solution = solve_lqr(self.problem.plant, found.weights)
        K, S = np.array(solution.K), np.array(solution.S)
        return Found(K, found.weights, found.gain.evaluations, S, found.reason)


class NaturalUnits:
    """For recordings with noise, in natural coordinates; `remember` (name, compute)."""

    def __init__(
        self,
        problem: Problem,
        remember: Remember = afresh,
        feedback_states: Sequence[str] = (),
        fitted: Estimate | None = None,
    ) -> None:
        self.problem, self.remember = problem, remember
        self.feedback_states = feedback_states
        if fitted is not None:
            self.fitted = fitted

    @cached_property
    def fitted(self) -> Estimate:
        """Inverse MPC; it says at which initial states and parameters the others look."""
        return self.remember("inverse_mpc", self._fit)

    def _fit(self) -> Estimate:
        started = time.perf_counter()
        found = fit_controller(self.problem)
        return replace(found, seconds=time.perf_counter() - started)

    @cached_property
    def known(self) -> Problem:
        """The problem with its initial states and physical parameters taken as known."""
        return self.fitted.problem.known()

    @property
    def metric(self) -> Array:
        """S (m, m) of inverse MPC, for methods that have none of their own."""
        return np.array(self.fitted.metric)

    @property
    def noise(self) -> float:
        """2-norm of the residual that no weights are asked to explain."""
        return self.fitted.noise

    def settle(self, seen: Problem, K: Array, S: Array) -> Problem:
        """The problem `seen`, at the initial states of a gain `K` (m, n) and metric `S` (m, m)."""
        return with_fitted_starts(seen, K, S) if self.problem.unknown_start else seen

    @cached_property
    def feedback(self) -> GainFit:
        """The best gain without bounds (3.12).

        Searched again from where it ends: the prior is about the start, which may be far. Without
        bounds the best gain may be unstable, of a person who saturates; it has no coordinates.
        """
        first = free_gain(self.fitted.problem.without_bounds(), self.fitted.stage_weights)
        if not stabilises(self.problem.plant, np.array(first.K)):
            return first
        again = refine_gain(first.problem, np.array(first.K), np.array(first.S), prior=1.0)
        return replace(again, evaluations=first.evaluations + again.evaluations)

    @property
    def starting_gain(self) -> Array:
        """That of inverse MPC (m, n)."""
        return np.array(self.fitted.gain)

    @cached_property
    def _coordinates(self) -> tuple[Plant, Array, Weights, Array, Array]:
        """Plant and feedback gain in natural coordinates, weights to start from, T and G."""
        plant, K = self.known.plant, np.array(self.feedback.K)
        stable = stabilises(plant, K)
        T, G = natural_coordinates(plant, K if stable else self.starting_gain)
        natural = change_coordinates(plant, T, G)
        target, near = (
            np.asarray(np.linalg.solve(G, gain @ T)) for gain in (K, self.starting_gain)
        )
        centre = least_condition_weights(gain_fibre(natural, near)).weights
        return natural, target, centre, T, G

    @cached_property
    def lmi(self) -> InverseLqr:
        """As in `PlantUnits`; so are the next ones."""
        natural, target, _, T, G = self._coordinates
        found = inverse_lqr_lmi(natural, target)
        return replace(found, weights=_back(found.weights, T, G))

    @cached_property
    def gradient(self) -> InverseLqr:
        """Weights with the nearest gain."""
        natural, target, centre, T, G = self._coordinates
        found = inverse_lqr_gradient(natural, target, centre)
        return replace(found, weights=_back(found.weights, T, G))

    @cached_property
    def auxiliary(self) -> Weights:
        """Weights of the auxiliary problem (3.7)."""
        natural, target, centre, T, G = self._coordinates
        return in_plant_units(auxiliary_weights(natural, target, centre).weights, T, G)

    def output(self, start: Weights | None = None) -> Found:
        """(3.16), from some weights, or those of inverse MPC."""
        noise, begin = noise_of(self.feedback), start or self.fitted.stage_weights
        found = inverse_mpc_natural(self.known.without_bounds(), begin, noise)
        return regulator(self, found.weights, found.evaluations)

    def inverse_mpc(self) -> Estimate:
        """(3.6)."""
        return self.fitted

    def reduced(self) -> Found:
        """Gain under the bounds, then weights with that gain."""
        behind = weights_behind(free_gain(self.known, self.fitted.stage_weights))
        weights = None if behind.equivalent is None else behind.equivalent.weights
        gain = behind.gain
        # What the gain leaves too is noise, and no fault of the weights.
        missed = weights is None or behind.misfit > (1 + _AS_GOOD) * gain.misfit
        reason = behind.reason if missed else ""
        return Found(np.array(gain.K), weights, gain.evaluations, np.array(gain.S), reason)


#: What methods on the same recordings share, each part made when it is first asked for.
Groundwork = PlantUnits | NaturalUnits


def regulator(ground: Groundwork, weights: Weights | None, evaluations: int = 0) -> Found:
    """The gain of some weights."""
    if weights is None:
        raise WeightsError("weights", "none have the feedback gain", "see the gradient method")
    return Found(np.array(solve_lqr(ground.known.plant, weights).K), weights, evaluations)


def _back(weights: Weights | None, T: Array, G: Array) -> Weights | None:
    return None if weights is None else in_plant_units(weights, T, G)
