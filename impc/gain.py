"""State-feedback gain behind recorded outputs, with or without bounds.

Without bounds this is the first line of Table 3.1; with them it is the reduced form of inverse
MPC: the recordings determine K, and for several inputs the metric S while bounds are active, and
nothing else (docs/theory.md, section 2).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.optimize

from impc.arrays import Array, Frozen, frozen
from impc.diagonal_weights import bryson_weights
from impc.door import checked
from impc.errors import SolverError
from impc.evaluation import misfit_or_reason
from impc.gain_coordinates import Coordinates
from impc.inverse_problem import moved
from impc.lqr import is_stable, solve_lqr

if TYPE_CHECKING:
    from impc.inverse_problem import InverseProblem

__all__ = ["GainFit", "bryson_starts", "fit_gain", "refine_gain"]

_EXPLAINED = 1e-9
_ROUNDS = 8
# A round of a noisy search ends when the misfit falls by less than 1e-6 of itself; the rounds end
# when one lowers it by less than 1e-3: the noise is then known to that.
_NOISY_TOLERANCE, _SETTLED = 1e-6, 1e-3


@dataclass(frozen=True)
class GainFit(Frozen):
    """A gain fitted to recordings.

    Attributes
    ----------
    K : Array
        (m, n).
    S : Array
        Metric (m, m); the one it started from where the recordings do not determine it.
    problem : InverseProblem
        The problem at the initial states and the parameters found; the given one when these are
        known.
    misfit : float
        2-norm of the output residual.
    explained : bool
        Whether the gain stabilises and the misfit is at most 1e-9 of the recorded outputs.
    stabilises : bool
        Whether A - BK is stable. Without a terminal set the search may end where it is not.
    singular_values : Array
        Of the residual's derivative with respect to K and S in natural coordinates, after initial
        states and parameters have taken what they can (g,); largest first.
    metric_determined : bool
        Whether the recordings determine S: every singular value of its part, after K has taken
        what it can, is above 1e-8 of the largest.
    evaluations : int
        Simulations with derivatives.
    refused : tuple of str
        Reasons of the trial gains that were stepped back from.
    """

    K: Array
    S: Array
    problem: InverseProblem
    misfit: float
    explained: bool
    stabilises: bool
    singular_values: Array
    metric_determined: bool
    evaluations: int
    refused: tuple[str, ...]


@checked(attempts=1, max_evaluations=1, spread=0)
def fit_gain(
    problem: InverseProblem,
    *starts: tuple[Array, Array],
    attempts: int = 3,
    max_evaluations: int = 80,
    spread: float = np.inf,
) -> GainFit:
    """Fit K, and S for several inputs, by trust-region least squares with exact derivatives.

    Initial states and physical parameters that the problem does not know are fitted with them.

    The misfit has local minima, and beyond some of them the gain no longer stabilises the plant
    although the recording ends before that shows. So the search is made from the few most
    promising of the given starts and of a family of regulators, until one explains the recordings.

    Parameters
    ----------
    problem : InverseProblem
    starts : pairs of Array
        Gains (m, n) and metrics (m, m) to start from, besides the regulators of `bryson_starts`.
    attempts : int
        Number of searches at most. They end at a misfit of 1e-9 of the recorded outputs.
    max_evaluations : int
        Budget of simulations with derivatives of each search.
    spread : float
        Noisy recordings leave some directions of the gain all but free. A finite spread ends
        the search where it started along those: each natural coordinate (`Coordinates`) is given
        a normal prior of that standard deviation about the start of the search, weighed against
        the noise that the fit itself leaves. Directions that the recordings determine to much less
        than the spread do not feel it, and without noise nothing does.

    Raises
    ------
    SolverError
        When the recordings cannot be simulated from any start.
    """
    ranked, evaluations, refused = _rank(problem, [*starts, *bryson_starts(problem)])
    if not ranked:
        raise SolverError(
            "gain", f"no start can be simulated: {refused[0]}", "give a start of your own"
        )
    best: GainFit | None = None
    for K, S in ranked[:attempts]:
        found = _search(problem, K, S, max_evaluations, spread)
        evaluations += found.evaluations
        refused += found.refused
        if best is None or _preference(found) < _preference(best):
            best = found
        if found.explained:
            break
    assert best is not None  # attempts >= 1 and something was ranked
    return replace(best, evaluations=evaluations, refused=tuple(refused))


def refine_gain(
    problem: InverseProblem,
    gain: Array,
    metric: Array,
    *,
    max_evaluations: int = 80,
    spread: float = np.inf,
) -> GainFit:
    """One search of `fit_gain` from a gain and a metric, without looking for better starts.

    Parameters
    ----------
    gain, metric : Array
        K (m, n) and S (m, m).
    max_evaluations : int
        Simulations with derivatives, at most.
    spread : float
        Standard deviation of a normal prior about the start, in natural coordinates; none by
        default.

    Raises
    ------
    SolverError
        When the recordings cannot be simulated from there.
    """
    _, reason = misfit_or_reason(problem, gain, metric)
    if reason:
        raise SolverError("gain", f"the start cannot be simulated: {reason}", "start elsewhere")
    return _search(problem, gain, metric, max_evaluations, spread)


def bryson_starts(problem: InverseProblem) -> list[tuple[Array, Array]]:
    """Gains (m, n) and metrics (m, m) of the regulators of `bryson_weights`."""
    solutions = [solve_lqr(problem.plant, weights) for weights in bryson_weights(problem)]
    return [(np.array(item.K), np.array(item.S)) for item in solutions]


def _rank(
    problem: InverseProblem, starts: list[tuple[Array, Array]]
) -> tuple[list[tuple[Array, Array]], int, list[str]]:
    """The usable starts by their misfit, the evaluations spent, and why the others are not."""
    usable, refused = [], []
    for K, S in starts:
        size, reason = misfit_or_reason(problem, K, S)
        if reason:
            refused.append(reason)
        else:
            usable.append((size, K, S))
    usable.sort(key=lambda item: item[0])
    return [(K, S) for _, K, S in usable], len(starts), refused


def _search(
    problem: InverseProblem, gain: Array, metric: Array, budget: int, spread: float
) -> GainFit:
    """One search; with a finite spread in rounds, each with the noise that the last one left.

    While the misfit still falls by more than its square root, the fit is limited by the prior and
    not by the recordings: the prior is too strong.
    """
    space = Coordinates(problem, gain, metric)
    z, spent = space.start, 0
    samples = sum(trial.outputs.size for trial in problem.recordings)
    misfit = float(np.linalg.norm(space.at(z).residual))
    for _ in range(_ROUNDS):
        noise = 0.0 if np.isinf(spread) else misfit / np.sqrt(samples)
        target = space.with_prior(noise / spread)
        found = scipy.optimize.least_squares(
            target.residual,
            z,
            jac=target.derivative,
            ftol=1e-12 if noise == 0 else _NOISY_TOLERANCE,
            xtol=1e-12,
            gtol=1e-15,
            max_nfev=max(budget - spent, 1),
        )
        z, spent = found.x, spent + int(found.nfev)
        before, misfit = misfit, float(np.linalg.norm(space.at(z).residual))
        if noise == 0 or misfit > (1 - _SETTLED) * before or spent >= budget:
            break
    return _gain_fit(space, z, spent)


def _gain_fit(space: Coordinates, z: Array, evaluations: int) -> GainFit:
    found = space.unpack(z)
    problem = moved(space.problem, found.starts, found.logarithms)
    plant = problem.plant
    stabilises = is_stable(plant.A - plant.B @ found.K, discrete=True)
    size = np.linalg.norm(
        [np.linalg.norm(trial.outputs / problem.output_scale) for trial in problem.recordings]
    )
    misfit = float(np.linalg.norm(space.at(z).residual))
    jacobian = space.without_nuisance(z)
    return GainFit(
        frozen(found.K),
        frozen(found.S),
        problem,
        misfit,
        bool(stabilises and misfit <= _EXPLAINED * size),
        stabilises,
        frozen(np.linalg.svd(jacobian, compute_uv=False)),
        _metric_determined(jacobian, plant.m * plant.n),
        evaluations,
        tuple(space.refused),
    )


def _metric_determined(jacobian: Array, size: int) -> bool:
    if jacobian.shape[1] == size:
        return False
    basis, _ = np.linalg.qr(jacobian[:, :size])
    rest = jacobian[:, size:] - basis @ (basis.T @ jacobian[:, size:])
    values = np.linalg.svd(rest, compute_uv=False)
    return bool(values[-1] > 1e-8 * np.linalg.norm(jacobian, 2))


def _preference(found: GainFit) -> tuple[bool, float]:
    """Smaller is better. A gain that does not stabilise cannot be that of any weights."""
    return not found.stabilises, found.misfit
