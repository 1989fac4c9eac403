"""Every method for the weights behind recordings, by the name that it has everywhere.

The names are those in result.json, the labels those of tables and figures; commands and tests
choose from `METHODS`. What methods on the same recordings share is a `Groundwork`. There are two:

    PlantUnits    Table 3.1 as printed, for recordings without noise: condition numbers are taken in
                  the units of the plant, misfits as they are
    NaturalUnits  for recordings with noise (docs/fitting.md): natural coordinates, squared misfits
                  weighed against the noise that the best gain leaves; initial states and physical
                  parameters are those of inverse MPC, every search begins at its weights, so
                  that none loses by where it began, and each method's own gain has its initial
                  states fitted again
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.checking import checked, replace
from impc.errors import ImpcError, InputError, WeightsError
from impc.inverse.delayed_feedback import preliminary_gain
from impc.inverse.direct_and_reduced import (
    CONDITION_WEIGHT,
    auxiliary_weights,
    inverse_mpc,
    inverse_mpc_reduced,
    output_penalty_weights,
)
from impc.inverse.equivalent_weights import least_condition_weights
from impc.inverse.estimate import Estimate, Status
from impc.inverse.explaining_weights import weights_behind
from impc.inverse.gain_search import EXPLAINED, GainFit, fit_gain
from impc.inverse.initial_states import with_fitted_starts
from impc.inverse.inverse_lqr import InverseLqr, inverse_lqr_gradient, inverse_lqr_lmi
from impc.inverse.natural_search import in_plant_units, inverse_mpc_natural
from impc.inverse.noisy_fit import fit_controller, free_gain, noise_of
from impc.inverse.problem import recorded_size
from impc.inverse.residuals import residual_only
from impc.inverse.solution_set import gain_fibre, natural_coordinates
from impc.inverse.stationarity import inverse_kkt
from impc.model.bounds import Bounds
from impc.model.plant import change_coordinates
from impc.model.riccati import is_stable, solve_lqr
from impc.model.weights import Weights, normalised

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.inverse.problem import Problem
    from impc.model.plant import Plant

__all__ = [
    "METHODS",
    "Found",
    "Groundwork",
    "Method",
    "NaturalUnits",
    "PlantUnits",
    "Remember",
    "compute",
    "estimate",
    "estimate_all",
]


#: (name, compute) -> the estimate: from memory, or computed now.
Remember = Callable[[str, Callable[[], Estimate]], Estimate]


def compute(_name: str, make: Callable[[], Estimate]) -> Estimate:
    """Compute an estimate whatever its name: the `Remember` of whoever remembers nothing."""
    return make()


@dataclass(frozen=True)
class Found(Frozen):
    """What a method hands back, before it is simulated.

    Attributes
    ----------
    K : Array
        (m, n).
    weights : Weights or None
    evaluations : int
        Simulations with derivatives.
    S : Array or None
        Metric (m, m) where it is not that of inverse MPC: without bounds it has no effect.
    reason : str
        Why there are no weights; empty otherwise.
    settled : bool
        Whether the search ended by itself.
    problem : Problem or None
        At the initial states and parameters found, where they are the method's own.
    """

    K: Array
    weights: Weights | None = None
    evaluations: int = 0
    S: Array | None = None
    reason: str = ""
    settled: bool = True
    problem: Problem | None = None


@dataclass(frozen=True)
class Method:
    """A way from recordings to a controller.

    Attributes
    ----------
    name : str
        In result.json, in TOML and at the command line.
    label : str
        In tables and figures.
    sentence : str
        For readers who do not know it.
    sees : callable
        The problem as posed -> as the method sees it: inverse LQR knows no bounds.
    find : callable
        What it finds on a `Groundwork`.
    """

    name: str
    label: str
    sentence: str
    sees: Callable[[Problem], Problem]
    find: Callable[[Groundwork], Found | Estimate]

    def estimate(self, ground: Groundwork) -> Estimate:
        """Run the method; one that ends without a gain says why in its estimate.

        Parameters
        ----------
        ground : Groundwork
            What it starts from; its making is not in the method's time.
        """
        seen = self.sees(ground.known)
        started = time.perf_counter()
        try:
            found = self.find(ground)
        except ImpcError as error:
            return _nothing(self.name, seen, str(error), time.perf_counter() - started)
        if isinstance(found, Estimate):
            return found
        S = ground.metric if found.S is None else found.S
        settled = ground.settle(found.problem or seen, found.K, S)
        seconds = time.perf_counter() - started
        misfit = float(np.linalg.norm(residual_only(settled, found.K, S)))
        return Estimate(
            self.name,
            settled,
            frozen(found.K),
            frozen(S),
            None if found.weights is None else normalised(found.weights),
            frozen(S[None]),
            misfit,
            ground.noise,
            _status(found, settled, misfit),
            found.reason,
            found.evaluations,
            seconds,
        )


class PlantUnits:
    """Table 3.1 for recordings without noise, in the units of the plant.

    Parameters
    ----------
    problem : Problem
        Its initial states are taken as known.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = self.known = problem
        self.metric: Array = np.eye(problem.plant.m)
        self.noise = EXPLAINED * recorded_size(problem)

    def settle(self, seen: Problem, _K: Array, _S: Array) -> Problem:
        """The problem at the initial states of a gain (m, n) and metric (m, m): as it stands."""
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
        return _regulator(self, found.weights, found.evaluations)

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
    """For recordings with noise, in natural coordinates.

    Parameters
    ----------
    problem : Problem
    remember : callable
        (name, compute) -> the estimate: from memory, or computed now.
    feedback_states : sequence of str
        Those that the preliminary gains (3.20) are on.
    """

    def __init__(
        self,
        problem: Problem,
        remember: Remember = compute,
        feedback_states: Sequence[str] = (),
    ) -> None:
        self.problem, self.remember = problem, remember
        self.feedback_states = feedback_states

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
        """The problem at the initial states that belong to a gain (m, n) and metric (m, m)."""
        return with_fitted_starts(seen, K, S) if self.problem.unknown_start else seen

    @cached_property
    def feedback(self) -> GainFit:
        """The best gain without bounds (3.12)."""
        return free_gain(self.known.without_bounds(), self.fitted.stage_weights)

    @property
    def starting_gain(self) -> Array:
        """That of inverse MPC (m, n)."""
        return np.array(self.fitted.gain)

    @cached_property
    def _coordinates(self) -> tuple[Plant, Array, Weights, Array, Array]:
        """Plant and feedback gain in natural coordinates, weights to start from, T and G."""
        plant, K = self.known.plant, np.array(self.feedback.K)
        stable = is_stable(plant.A - plant.B @ K, discrete=True)
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

    def output(self) -> Found:
        """(3.16)."""
        noise = noise_of(self.feedback)
        found = inverse_mpc_natural(self.known.without_bounds(), self.fitted.stage_weights, noise)
        return _regulator(self, found.weights, found.evaluations)

    def inverse_mpc(self) -> Estimate:
        """(3.6)."""
        return self.fitted

    def reduced(self) -> Found:
        """Gain under the bounds, then weights with that gain."""
        behind = weights_behind(free_gain(self.known, self.fitted.stage_weights))
        weights = None if behind.equivalent is None else behind.equivalent.weights
        gain = behind.gain
        return Found(np.array(gain.K), weights, gain.evaluations, np.array(gain.S), behind.reason)


#: What methods on the same recordings share, each part made when it is first asked for.
Groundwork = PlantUnits | NaturalUnits


def _regulator(ground: Groundwork, weights: Weights | None, evaluations: int = 0) -> Found:
    if weights is None:
        raise WeightsError("weights", "none have the feedback gain", "see the gradient method")
    return Found(np.array(solve_lqr(ground.known.plant, weights).K), weights, evaluations)


def _back(weights: Weights | None, T: Array, G: Array) -> Weights | None:
    return None if weights is None else in_plant_units(weights, T, G)


def _status(found: Found, settled: Problem, misfit: float) -> Status:
    if found.weights is None:
        return Status.GAIN_ONLY
    if misfit <= EXPLAINED * recorded_size(settled):
        return Status.EXPLAINED
    return Status.SETTLED if found.settled else Status.STOPPED


def _nothing(name: str, seen: Problem, reason: str, seconds: float) -> Estimate:
    m, none = seen.plant.m, float("nan")
    metrics = frozen(np.zeros((0, m, m)))
    return Estimate(
        name, seen, None, None, None, metrics, none, none, Status.NONE, reason, 0, seconds
    )


def _as_posed(problem: Problem) -> Problem:
    return problem


def _without_bounds(problem: Problem) -> Problem:
    return problem.without_bounds()


def _cut_off(problem: Problem) -> Problem:
    """A horizon of one sample without state bounds or terminal set: cut off, no foresight."""
    limits = Bounds(problem.plant, u_min=problem.bounds.u_min, u_max=problem.bounds.u_max)
    return replace(problem, bounds=limits, horizon=1, terminal_set=False)


def _clipped(ground: Groundwork) -> Found:
    assert isinstance(ground, NaturalUnits)  # no row of Table 3.1
    return Found(np.array(ground.fitted.gain), ground.fitted.weights)


def _preliminary(ground: Groundwork) -> Found | Estimate:
    assert isinstance(ground, NaturalUnits)  # no row of Table 3.1
    found = preliminary_gain(ground.problem, ground.feedback_states)
    return Found(np.array(found.K), problem=found.problem.known())


_TABLE = (
    Method(
        "preliminary",
        "preliminary gains and parameters (3.19)",
        "Gains on a few states alone (3.20), fitted together with the physical parameters.",
        _without_bounds,
        _preliminary,
    ),
    Method(
        "feedback_gain",
        "feedback gain, no bounds (3.12)",
        "The fixed gain K of u = -Kx whose loop fits the outputs best (3.12). It knows no bounds "
        "and has no weights.",
        _without_bounds,
        lambda ground: Found(np.array(ground.feedback.K), None, ground.feedback.evaluations),
    ),
    Method(
        "inverse_lqr_lmi",
        "inverse LQR, LMI",
        "Weights whose optimal gain is exactly that K, of least condition number. There may be "
        "none, and for a gain fitted to noise there are none as a rule: then the program is "
        "infeasible.",
        _without_bounds,
        lambda ground: _regulator(ground, ground.lmi.weights),
    ),
    Method(
        "inverse_lqr_gradient",
        "inverse LQR, gradient",
        "Weights whose optimal gain comes nearest to that K.",
        _without_bounds,
        lambda ground: _regulator(ground, ground.gradient.weights),
    ),
    Method(
        "inverse_lqr_auxiliary",
        "inverse LQR, gain penalty (3.7)",
        "The same, with a price on the condition number that keeps the weights away from singular.",
        _without_bounds,
        lambda ground: _regulator(ground, ground.auxiliary),
    ),
    Method(
        "inverse_lqr",
        "inverse LQR, lines 2 to 7 of Table 3.1",
        "Weights with exactly that K where there are any, otherwise those of the gain penalty "
        "(3.7): where Table 3.1 starts inverse MPC.",
        _without_bounds,
        lambda ground: _regulator(ground, ground.lmi.weights or ground.auxiliary),
    ),
    Method(
        "inverse_lqr_output",
        "inverse LQR, output penalty (3.16)",
        "Weights whose optimal gain, without bounds, fits the outputs themselves best.",
        _without_bounds,
        lambda ground: ground.output(),
    ),
    Method(
        "inverse_kkt",
        "inverse KKT",
        "Weights that make the smoothed states and commands look like optimal plans. No "
        "simulation; what disturbs the subject is taken for planned.",
        _as_posed,
        lambda ground: _regulator(ground, inverse_kkt(ground.known, ground.starting_gain)),
    ),
    Method(
        "clipped_lqr",
        "LQR of inverse MPC, clipped",
        "The regulator of inverse MPC, its command cut off at the bounds.",
        _cut_off,
        _clipped,
    ),
    Method(
        "inverse_mpc_reduced",
        "inverse MPC, reduced",
        "First the gain of the bounded controller that fits the outputs best, then the weights of "
        "least condition number that have this gain, if any.",
        _as_posed,
        lambda ground: ground.reduced(),
    ),
    Method(
        "inverse_mpc",
        "inverse MPC, direct (3.6)",
        "Weights whose controller, with its bounds, fits the outputs best.",
        _as_posed,
        lambda ground: ground.inverse_mpc(),
    ),
)

#: Every method by its name. A new one is one more entry.
METHODS: dict[str, Method] = {method.name: method for method in _TABLE}


def method_named(name: str) -> Method:
    """Return a method of the registry.

    Raises
    ------
    InputError
        When there is none of that name.
    """
    if name not in METHODS:
        raise InputError("method", f"got {name!r}", f"choose one of {', '.join(METHODS)}")
    return METHODS[name]


@checked
def estimate(problem: Problem, method: str = "inverse_mpc") -> Estimate:
    """Find the controller behind recordings by one method.

    Parameters
    ----------
    problem : Problem
    method : str
        A key of `METHODS`.

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
    >>> found = impc.estimate(impc.Problem(plant, bounds, 3, [trial]), "inverse_mpc")
    >>> found.weights.Q.round(6) + 0.0
    array([[1., 0.],
           [0., 1.]])
    """
    return estimate_all(NaturalUnits(problem), [method_named(method).name])[method]


def estimate_all(
    ground: Groundwork,
    names: Sequence[str],
) -> dict[str, Estimate]:
    """Run methods on the same recordings.

    Parameters
    ----------
    ground : Groundwork
    names : sequence of str
        Keys of `METHODS`.

    Raises
    ------
    WeightsError, SolverError
        When no regulator can be simulated on the recordings.
    """
    found = {}
    for name in names:
        make = functools.partial(METHODS[name].estimate, ground)
        if isinstance(ground, PlantUnits) or name == "inverse_mpc":
            found[name] = make()
        else:
            found[name] = ground.remember(name, make)
    return found
