"""The gain behind recordings, with or without bounds: from prediction error to simulation error.

    a regulator  ->  least prediction error  ->  least simulation error     (each over K, S, x0)

The misfit of a simulated trial has local minima, and gains that make it diverge; that of
predictions one sample ahead has few, and can be computed at every gain (`prediction`). So each
search minimises that first, and begins the search of the simulation at its end. Recordings of a
few hundred numbers are searched from other regulators too, until three searches have the least
misfit; longer ones where the simulation leaves much more than the prediction, until two have it.
Searches begin at balanced regulators, those of Bryson's rule (outputs of recorded size cost as much
as commands of full size), and at random ones about these. Every regulator stabilises.

Without bounds this is the first line of Table 3.1; with them it is the reduced form of inverse
MPC: the recordings determine K, and for several inputs the metric S while bounds are active, and
nothing else (docs/theory.md, section 2).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.checking import checked, replace
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


#: Numbers recorded up to which a search may be made many times.
FEW = 2000
# Few numbers are searched until three agree on the least misfit, to this share of it; longer
# recordings are searched again, until two agree, where the simulation leaves this much more than
# the prediction. Predictions this much worse than the best end there.
_AGREE, _SAME, _TWICE, _SUSPECT, _HOPELESS = 3, 1e-3, 2, 1.5, 30.0
# Of a handful of numbers more searches have to agree: three wrong ones did in 2 of 80 problems.
_HANDFUL, _SURE = 200, 5
# Errors of commands that the filter expects, in units of their size. At 10 all 67 sticks, and at 1
# too, were found; a fast filter keeps the gains of delays in bounds.
_RATIOS = (10.0, 1.0)
# One over the standard deviation of the prior, in natural coordinates, of a search from nothing.
_WEAK = 1e-3
# Evaluations of predictions and simulations, and nats per recorded number at which each ends: a
# squared misfit that falls by less than that share of itself; and nats at which it ends at last.
_PREDICTED, _SIMULATED, _ROUGH, _FINE, _NATS = 25, 80, 1e-3, 1e-6, 1e-3
# Where a stated uncertainty leaves gain and body to make up for each other: a fifth of a deviation.
_RIDGE = 0.05
# Misfit of rounding, of the recorded outputs.
_ROUNDING = 1e-13
# Factor by which each step back is shorter.
_BACK = 0.8
# Searches from random regulators, and rounds of more for few recorded numbers; in each, how many
# are drawn, their initial states fitted in so many evaluations, and how many are searched from.
_MORE, _ROUNDS, _DRAWN, _QUICK, _KEPT = 2, 2, 100, 4, 12


@dataclass(frozen=True)
class GainFit(Frozen):
    """A gain fitted to recordings."""

    K: Array  # (m, n)
    S: Array  # Metric (m, m); the one it started from where the recordings do not determine it
    # The problem at the initial states and the parameters found; the given one when these are known
    problem: Problem
    misfit: float  # 2-norm of the output residual
    # Whether the gain stabilises and the misfit is at most 1e-9 of the recorded outputs
    explained: bool
    # Whether A - BK is stable. Without a terminal set the search may end where it is not.
    stabilises: bool
    # Of the residual's derivative with respect to K and S in natural coordinates, after initial
    # states and parameters have taken what they can (g,); largest first
    singular_values: Array
    evaluations: int  # Simulations with derivatives
    unconfirmed: bool = (
        False  # Whether several searches were made, and one only ended at this misfit
    )


@checked
def fit_gain(problem: Problem) -> GainFit:
    """Fit K, and S for several inputs, with initial states and parameters that are not known."""
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
    """One search of the simulation's misfit from a gain and a metric."""
    _, reason = misfit_or_reason(problem, gain, metric)
    if reason:
        raise SolverError("gain", f"the start cannot be simulated: {reason}", "start elsewhere")
    space = Coordinates(problem, gain, metric)
    stop = _stop(problem, _FINE, max_evaluations)
    nats = _RIDGE if np.any(problem.stated) else min(stop.nats, _NATS)
    stop = replace(stop, nats=nats)
    z, spent, _ = descend(space, space.start, stop, shared=prior, own=prior)
    return _gain_fit(space, z, spent)


def _best(found: list[GainFit]) -> tuple[GainFit, int]:
    """The fit of least misfit, and how many have it."""
    best = min(found, key=lambda fit: fit.misfit)
    return best, sum(fit.misfit <= (1 + _SAME) * best.misfit for fit in found)


def _starts(problem: Problem, few: bool) -> Iterator[tuple[Problem, LqrSolution]]:
    """Regulators to search from, with initial states; the same at every call."""
    first = balanced_regulator(problem)
    yield problem, first
    rng = np.random.default_rng(0)
    sizes = state_sizes(problem, first)
    for _ in range(_MORE):
        yield drawn_start(problem, sizes, rng)
    for _ in range(_ROUNDS if few else 0):
        yield from _ranked([drawn_start(problem, sizes, rng) for _ in range(_DRAWN)])


def _ranked(drawn: list[tuple[Problem, LqrSolution]]) -> list[tuple[Problem, LqrSolution]]:
    """The least prediction error first, with initial states fitted to each."""
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
    """The least prediction error from a regulator: where, evaluations, and its 2-norm."""
    space = _predictions(problem, begin, ratio)
    stop = _stop(problem, _ROUGH, _PREDICTED)
    z, spent, _ = descend(space, space.start, stop, shared=_WEAK, own=_WEAK)
    return space.unpack(z), spent, float(np.linalg.norm(space.at(z).residual))


def _simulated(problem: Problem, begin: LqrSolution, predicted: Point) -> GainFit:
    """The least simulation error from the end of a search of predictions."""
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
    raise SolverError("gain", reason or "no gain stabilises the plant", "start elsewhere")


def _predictions(problem: Problem, begin: LqrSolution, ratio: float) -> Coordinates:
    """Coordinates of predictions about a regulator: of the linear plant, without terminal set."""
    known = replace(
        problem,
        plant=problem.plant.linear(),
        terminal_set=False,
        offsets=(),
        family=None,
        logarithms=frozen([]),
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


# Cost weights of states that no output sees, of the others'.
_UNSEEN = 1e-8
# Costs of the command, of that of the balanced regulator.
_EFFORTS = 10.0 ** np.arange(-4, 5)
# Random weights: share of the identity, and decades of the cost of the command on either side.
_DEFINITE, _DECADES = 0.05, 2.0


def balanced_regulator(problem: Problem, effort: float = 1.0) -> LqrSolution:
    """The regulator with R = effort diag(1/u^2), u the size of the commands, Q = C'diag(1/y^2)C."""
    plant, scale = problem.plant, np.asarray(problem.output_scale)
    Q = plant.C.T @ np.diag(1 / scale**2) @ plant.C
    Q += _UNSEEN * np.trace(Q) / plant.n * np.eye(plant.n)
    R = effort * np.diag(1 / command_sizes(problem) ** 2)
    return solve_lqr(plant, normalised(Weights(Q, R)))


def regulators(problem: Problem) -> list[LqrSolution]:
    """Those over eight decades of effort that double precision allows, the balanced one first."""
    found: list[LqrSolution] = []
    refused: list[WeightsError] = []
    for effort in sorted(_EFFORTS, key=lambda one: abs(np.log(one))):
        try:
            found.append(balanced_regulator(problem, effort))
        except WeightsError as error:  # so cheap a command that R is lost beside B'PB
            refused.append(error)
    if not found:
        raise refused[0]
    return found


def state_sizes(problem: Problem, regulator: LqrSolution) -> Array:
    """Unit of states (n, n) in which the outputs are of their recorded size."""
    plant = problem.plant
    T, _ = natural_coordinates(plant, np.array(regulator.K))
    natural = float(np.linalg.norm(plant.C @ T / problem.output_scale[:, None]))
    return T * (np.sqrt(len(plant.outputs)) / natural if natural > 0 else 1.0)


def drawn_start(
    problem: Problem, sizes: Array, rng: np.random.Generator
) -> tuple[Problem, LqrSolution]:
    """A random regulator, and initial states that are random where no output sees them."""
    plant, regulator = problem.plant, None
    while regulator is None:
        try:
            regulator = solve_lqr(plant, _random_weights(sizes, command_sizes(problem), rng))
        except WeightsError:  # too far apart for double precision
            continue
    if not problem.unknown_start:
        return problem, regulator
    unseen = np.eye(plant.n) - np.linalg.pinv(plant.C) @ plant.C
    unseen[problem.searched_states :] = 0.0
    drawn = rng.standard_normal((len(problem.recordings), plant.n)) @ sizes.T @ unseen.T
    return problem.at(problem.starts + drawn, np.array(problem.logarithms)), regulator


def _random_weights(sizes: Array, commands: Array, rng: np.random.Generator) -> Weights:
    """Random weights of states and commands, each over its size."""
    parts = []
    for size in (len(sizes), len(commands)):
        L = np.tril(rng.standard_normal((size, size)))
        parts.append(L @ L.T + _DEFINITE * np.eye(size))
    back, unit = np.linalg.inv(sizes), np.diag(1 / commands)
    R = 10 ** rng.uniform(-_DECADES, _DECADES) * unit @ parts[1] @ unit
    Q = back.T @ parts[0] @ back
    return normalised(Weights((Q + Q.T) / 2, (R + R.T) / 2))
