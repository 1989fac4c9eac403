"""Fit the gain to recordings, with or without bounds.

    a regulator  ->  least prediction error  ->  least simulation error     (each over K, S, x0)

The simulation misfit has local minima, and some gains diverge; the one-step prediction misfit has
few and exists at every gain (`prediction`). Each search minimises it first. Short recordings are
searched from further starts until several searches agree on the least misfit; long ones only if the
simulation leaves much more than the prediction. Starts are balanced regulators (Bryson's rule:
outputs of recorded size cost as much as commands of full size) and random ones near these.

Without bounds this is line 1 of Table 3.1; with bounds the reduced form of inverse MPC: the
recordings determine K and, with several inputs and active bounds, S (docs/why/theory.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.checking import checked, replace
from impc.control.named_solver import COMPILED
from impc.errors import ImpcError, SolverError, WeightsError
from impc.inverse.coordinates import Coordinates, Point, descend
from impc.inverse.inactive_samples import pair_of_inactive_samples
from impc.inverse.least_squares import Stop
from impc.inverse.prediction import command_sizes, correction
from impc.inverse.problem import EXPLAINED, recorded_size, require_riccati
from impc.inverse.residuals import misfit_or_reason
from impc.inverse.solution_set import natural_coordinates
from impc.model.riccati import solve_lqr, stabilises
from impc.model.weights import Weights, normalised

if TYPE_CHECKING:
    from collections.abc import Iterator

    from impc.inverse.problem import Problem
    from impc.model.riccati import LqrSolution


#: Largest number of recorded values for which the search is repeated many times.
FEW = 2000
# Searches that must agree on the least misfit of short recordings, and the tolerance; searches that
# must agree on long ones whose simulation misfit exceeds the prediction misfit by the fourth
# factor; factor above the best prediction at which a start is dropped.
_AGREE, _SAME, _TWICE, _SUSPECT, _HOPELESS = 3, 1e-3, 2, 1.5, 30.0
# Very short recordings need more agreement: three wrong searches agreed in 2 of 80 problems.
_HANDFUL, _SURE = 200, 5
# Command errors assumed by the filter, in units of the command size: 10 and 1 both find all 67
# sticks; a fast filter keeps the gains of delays bounded.
_RATIOS = (10.0, 1.0)
# 1 / SD of the prior in whitened coordinates for a search without a start.
_WEAK = 1e-3
# Largest numbers of evaluations (prediction, simulation); relative decreases of the squared misfit
# that end each; decrease in nats that ends the last search.
_PREDICTED, _SIMULATED, _ROUGH, _FINE, _NATS = 25, 80, 1e-3, 1e-6, 1e-3
# Likewise if a stated uncertainty lets gain and plant compensate for each other.
_RIDGE = 0.05
# Misfit of rounding relative to the recorded outputs.
_ROUNDING = 1e-13
# Factor of each step back towards a stabilising gain.
_BACK = 0.8
# Random regulators; for short recordings also rounds of screened ones: rounds, draws per round,
# evaluations to fit their initial states, and how many are searched from.
_MORE, _ROUNDS, _DRAWN, _QUICK, _KEPT = 2, 2, 100, 4, 12


@dataclass(frozen=True)
class GainFit(Frozen):
    """A gain fitted to recordings."""

    K: Array  # (m, n)
    S: Array  # Metric (m, m); that of the start if not identified
    # Problem at the fitted initial states and parameters
    problem: Problem
    misfit: float  # 2-norm of the output residual
    # Whether the gain stabilises and the misfit is at most 1e-9 of the recorded outputs
    explained: bool
    # Whether A - BK is stable; without bounds and terminal set the search may end at an unstable
    # gain
    stabilises: bool
    # Of the residual derivative by K and S in whitened coordinates, nuisance eliminated (g,),
    # largest first
    singular_values: Array
    evaluations: int  # Simulations with derivatives
    unconfirmed: bool = False  # Only one of several searches reached this misfit


@checked
def fit_gain(problem: Problem) -> GainFit:
    """Fit K, S (several inputs), and unknown initial states and parameters."""
    require_riccati(problem)
    count = problem.recorded_numbers
    few, wanted = count <= FEW, _SURE if count <= _HANDFUL else _AGREE
    found: list[GainFit] = []
    exact = pair_of_inactive_samples(problem)
    if exact is not None and not misfit_or_reason(problem, *exact)[1]:
        found.append(refine_gain(problem, *exact))
        if found[0].explained:
            return found[0]
    predicted, evaluations, reason = np.inf, 0, ""
    for attempt, (there, regulator) in enumerate(_starts(problem, few)):
        try:
            end, spent, error = _predicted(there, regulator, _RATIOS[attempt % 2])
            evaluations += spent
            if error > _HOPELESS * predicted:
                continue
            predicted = min(predicted, error)
            found.append(_simulated(there, regulator, end))
        except ImpcError as refused:
            reason = reason or str(refused)
            continue
        evaluations += found[-1].evaluations
        best, agreed = _best(found)
        good = not few and best.misfit < _SUSPECT * predicted
        if best.explained or good or agreed >= (wanted if few else _TWICE):
            break
    if not found:
        raise SolverError(
            "gain", f"no start can be simulated: {reason}", "check the plant and the bounds"
        )
    best, agreed = _best(found)
    return replace(best, evaluations=evaluations, unconfirmed=len(found) > agreed == 1)


@checked(max_evaluations=1, prior=0)
def refine_gain(
    problem: Problem,
    gain: Array,
    metric: Array,
    *,
    max_evaluations: int = _SIMULATED,
    prior: float = 0.0,
) -> GainFit:
    """Minimise the simulation misfit from one gain and metric."""
    _, reason = misfit_or_reason(problem, gain, metric)
    if reason:
        raise SolverError(
            "gain",
            f"the closed loop cannot be simulated at the start ({reason})",
            "pass a stabilising gain, e.g. that of solve_lqr",
        )
    space = Coordinates(problem, gain, metric)
    stop = _stop(problem, _FINE, max_evaluations)
    nats = _RIDGE if np.any(problem.stated) else min(stop.nats, _NATS)
    stop = replace(stop, nats=nats)
    z, spent, _ = descend(space, space.start, stop, shared=prior, own=prior)
    return _gain_fit(space, z, spent)


def _best(found: list[GainFit]) -> tuple[GainFit, int]:
    """Fit of least misfit, and the number of fits that reach it."""
    best = min(found, key=lambda fit: fit.misfit)
    return best, sum(fit.misfit <= (1 + _SAME) * best.misfit for fit in found)


def _starts(problem: Problem, few: bool) -> Iterator[tuple[Problem, LqrSolution]]:
    """Starting regulators with initial states; deterministic."""
    first = balanced_regulator(problem)
    yield problem, first
    rng = np.random.default_rng(0)
    sizes = state_sizes(problem, first)
    for _ in range(_MORE):
        yield drawn_start(problem, sizes, rng)
    for _ in range(_ROUNDS if few else 0):
        yield from _ranked([drawn_start(problem, sizes, rng) for _ in range(_DRAWN)])


def _ranked(drawn: list[tuple[Problem, LqrSolution]]) -> list[tuple[Problem, LqrSolution]]:
    """Starts sorted by prediction misfit, initial states fitted to each."""
    ranked = []
    for place, (problem, regulator) in enumerate(drawn):
        space = _predictions(problem, regulator, _RATIOS[place % 2])
        none = np.zeros((len(space.start) - int(space.ends[2] - space.ends[1]), 0))
        stop = _stop(problem, _ROUGH, _QUICK)
        z, _, _ = descend(space, space.start, stop, own=_WEAK, along=none)
        found = space.residual(z)
        if found is None:
            continue
        there = problem.at(np.array(space.unpack(z).problem.starts), np.array(problem.logarithms))
        ranked.append((float(found @ found), place, (there, regulator)))
    return [pair for _, _, pair in sorted(ranked, key=lambda item: item[:2])[:_KEPT]]


def _predicted(problem: Problem, begin: LqrSolution, ratio: float) -> tuple[Point, int, float]:
    """Minimise the prediction misfit: end point, evaluations, 2-norm."""
    space = _predictions(problem, begin, ratio)
    stop = _stop(problem, _ROUGH, _PREDICTED)
    z, spent, _ = descend(space, space.start, stop, shared=_WEAK, own=_WEAK)
    return space.unpack(z), spent, float(np.linalg.norm(space.at(z).residual))


def _simulated(problem: Problem, begin: LqrSolution, predicted: Point) -> GainFit:
    """Minimise the simulation misfit from the end of a prediction search."""
    K = np.array(begin.K)
    starts = np.array(predicted.problem.starts)
    there = problem.at(starts, np.array(problem.logarithms))
    share, reason = 1.0, ""
    for _ in range(_PREDICTED):
        gain = K + share * (predicted.K - K)
        if stabilises(problem.plant, gain):
            _, reason = misfit_or_reason(there, gain, predicted.S)
            if not reason:
                return refine_gain(there, gain, predicted.S, prior=_WEAK)
        share *= _BACK
    raise SolverError(
        "gain", reason or "no gain stabilises the plant", "check the plant and the bounds"
    )


def _predictions(problem: Problem, begin: LqrSolution, ratio: float) -> Coordinates:
    """Coordinates of predictions about a regulator: linear plant, no terminal set."""
    known = replace(
        problem,
        plant=problem.plant.linear(),
        terminal_set=False,
        offsets=(),
        family=None,
        logarithms=frozen([]),
        solver=COMPILED,  # only a start: a solver by name would take minutes
    )
    moved = correction(known, ratio)
    return Coordinates(known, np.array(begin.K), np.array(begin.S), correction=moved)


def _stop(problem: Problem, share: float, evaluations: int) -> Stop:
    count = problem.recorded_numbers
    return Stop(share * count, (_ROUNDING * recorded_size(problem)) ** 2, evaluations)


def _gain_fit(space: Coordinates, z: Array, evaluations: int) -> GainFit:
    found = space.unpack(z)
    problem = found.problem
    stable = stabilises(problem.plant, found.K)
    misfit = float(np.linalg.norm(space.at(z).residual))
    return GainFit(
        frozen(found.K),
        frozen(found.S),
        problem,
        misfit,
        bool(stable and misfit <= EXPLAINED * recorded_size(problem)),
        stable,
        frozen(np.linalg.svd(space.without_nuisance(z), compute_uv=False)),
        evaluations,
    )


# Cost weight of unobserved states relative to the others.
_UNSEEN = 1e-8
# Command weights relative to that of the balanced regulator.
_EFFORTS = 10.0 ** np.arange(-4, 5)
# Random weights: share of the identity, and decades of the command weight either way.
_DEFINITE, _DECADES = 0.05, 2.0


def balanced_regulator(problem: Problem, effort: float = 1.0) -> LqrSolution:
    """Regulator with R = effort diag(1/u^2), u the command sizes, and Q = C'diag(1/y^2)C."""
    plant, scale = problem.plant, np.asarray(problem.output_scale)
    Q = plant.C.T @ np.diag(1 / scale**2) @ plant.C
    Q += _UNSEEN * np.trace(Q) / plant.n * np.eye(plant.n)
    R = effort * np.diag(1 / command_sizes(problem) ** 2)
    return solve_lqr(plant, normalised(Weights(Q, R)))


def regulators(problem: Problem) -> list[LqrSolution]:
    """Balanced regulators over eight decades of effort, the plain one first."""
    found: list[LqrSolution] = []
    refused: list[WeightsError] = []
    for effort in sorted(_EFFORTS, key=lambda one: abs(np.log(one))):
        try:
            found.append(balanced_regulator(problem, effort))
        except WeightsError as error:  # R is lost in rounding next to B'PB
            refused.append(error)
    if not found:
        raise refused[0]
    return found


def state_sizes(problem: Problem, regulator: LqrSolution) -> Array:
    """Unit of states (n, n) in which the outputs have their recorded size."""
    plant = problem.plant
    T, _ = natural_coordinates(plant, np.array(regulator.K))
    natural = float(np.linalg.norm(problem.scaled_outputs @ T))
    return T * (np.sqrt(len(plant.outputs)) / natural if natural > 0 else 1.0)


def drawn_start(
    problem: Problem, sizes: Array, rng: np.random.Generator
) -> tuple[Problem, LqrSolution]:
    """Random regulator, with random initial states where the outputs do not observe them."""
    plant, regulator = problem.plant, None
    while regulator is None:
        try:
            regulator = solve_lqr(plant, _random_weights(sizes, command_sizes(problem), rng))
        except WeightsError:  # ill-conditioned draw
            continue
    if not problem.unknown_start:
        return problem, regulator
    unseen = np.eye(plant.n) - np.linalg.pinv(plant.C) @ plant.C
    unseen[problem.searched_states :] = 0.0
    drawn = rng.standard_normal((len(problem.recordings), plant.n)) @ sizes.T @ unseen.T
    return problem.at(problem.starts + drawn, np.array(problem.logarithms)), regulator


def _random_weights(sizes: Array, commands: Array, rng: np.random.Generator) -> Weights:
    """Random weights of states and commands relative to their sizes."""
    parts = []
    for size in (len(sizes), len(commands)):
        L = np.tril(rng.standard_normal((size, size)))
        parts.append(L @ L.T + _DEFINITE * np.eye(size))
    back, unit = np.linalg.inv(sizes), np.diag(1 / commands)
    R = 10 ** rng.uniform(-_DECADES, _DECADES) * unit @ parts[1] @ unit
    Q = back.T @ parts[0] @ back
    return normalised(Weights((Q + Q.T) / 2, (R + R.T) / 2))
