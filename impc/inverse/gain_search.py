"""State-feedback gain behind recorded outputs, with or without bounds.

Without bounds this is the first line of Table 3.1; with them it is the reduced form of inverse
MPC: the recordings determine K, and for several inputs the metric S while bounds are active, and
nothing else (docs/theory.md, section 2).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg
import scipy.optimize

from impc.arrays import Array, Frozen, frozen
from impc.checking import checked, replace
from impc.errors import SolverError
from impc.inverse.arrow import Tolerances
from impc.inverse.consistent_pairs import consistent_pair
from impc.inverse.coordinates import Coordinates
from impc.inverse.diagonal_start import bryson_regulators
from impc.inverse.many_trials import has_many_trials, search_many
from impc.inverse.one_step import one_step
from impc.inverse.problem import recorded_size
from impc.inverse.quiet_samples import follows_plant, has_bounds, quiet_pairs
from impc.inverse.residuals import misfit_or_reason
from impc.model.riccati import is_stable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.inverse.problem import Problem

__all__ = ["EXPLAINED", "GainFit", "bryson_starts", "describe_gain", "fit_gain", "refine_gain"]

#: Misfit, of the recorded outputs, up to which they are explained.
EXPLAINED = 1e-9
# A direction of the metric whose singular value is below this, of the largest, is not told.
_TOLD = 1e-8
# Changes of the metric that move the gain by less than this, in natural coordinates, leave it.
_ALONE = 1e-8
_ROUNDS = 8
# Searches step by step: of 20 random problems that needed them the fourth helped one.
_STEP_ATTEMPTS = 4
# Searches from gains of unbounded samples, whose metrics are guesses. Other starts are searched
# too where these do not explain: ranked with them, wrong pairs of small misfit took all attempts.
_QUIET_ATTEMPTS = 4
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
    problem : Problem
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
    metrics : Array
        Basis of the metrics with which K is consistent and which the recordings do not tell from S,
        S first (k, m, m): along the others the singular value is above 1e-8 of the largest.
        All that follows from the gain asks for weights with a metric in their span (`gain_fibre`).
    evaluations : int
        Simulations with derivatives.
    refused : tuple of str
        Reasons of the trial gains that were stepped back from.
    """

    K: Array
    S: Array
    problem: Problem
    misfit: float
    explained: bool
    stabilises: bool
    singular_values: Array
    metrics: Array
    evaluations: int
    refused: tuple[str, ...]

    @property
    def metric_determined(self) -> bool:
        """Whether the recordings determine S up to scale; with one input there is nothing to."""
        return len(self.S) > 1 and len(self.metrics) == 1


@checked(attempts=1, max_evaluations=1, spread=0)
def fit_gain(
    problem: Problem,
    *starts: tuple[Array, Array],
    attempts: int = 3,
    regulators: bool = True,
    max_evaluations: int = 80,
    spread: float = np.inf,
) -> GainFit:
    """Fit K, and S for several inputs, by trust-region least squares with exact derivatives.

    Initial states and physical parameters that the problem does not know are fitted with them.

    The misfit has local minima, and beyond some of them the gain no longer stabilises the plant
    although the recording ends before that shows. So the search is made from the few most
    promising of the given starts and of a family of regulators, until one explains the recordings.
    Where none does although they are exact, or none can be simulated, it is made once more from
    the gain that fits each step by itself (`one_step`).

    Parameters
    ----------
    problem : Problem
    starts : pairs of Array
        Gains (m, n) and metrics (m, m) to start from.
    attempts : int
        Number of searches at most. They end at a misfit of 1e-9 of the recorded outputs.
    regulators : bool
        Whether the regulators of `bryson_starts` are starts too.
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
    given = [*starts, *(bryson_starts(problem) if regulators else [])]
    groups = [(given, attempts)]
    if problem.plant.m > 1:
        metrics = [S for _, S in [*starts, *bryson_starts(problem)[::3]]]
        groups = [(quiet_pairs(problem, metrics), _QUIET_ATTEMPTS), *groups]
    found, reason = None, ""
    for pairs, most in groups:
        other, reason = _best_search(problem, pairs, most, max_evaluations, spread)
        found = _better(found, other)
        if found is not None and found.explained:
            return found
    if found is None or _is_local_minimum(problem):
        found = _better(found, _by_single_steps(problem, starts, max_evaluations, spread))
    if found is None:
        raise SolverError(
            "gain", f"no start can be simulated: {reason}", "give a start of your own"
        )
    return found


def _is_local_minimum(problem: Problem) -> bool:
    """Whether a misfit of several inputs is one of the search, and none of noise or bounds."""
    return problem.plant.m > 1 and has_bounds(problem) and follows_plant(problem)


def _by_single_steps(
    problem: Problem, starts: Sequence[tuple[Array, Array]], budget: int, spread: float
) -> GainFit | None:
    """A search from the gain that fits each step of the recordings by itself (`one_step`)."""
    steps = one_step(problem)
    near, _ = _best_search(
        steps, [*starts, *bryson_starts(problem)[::3]], _STEP_ATTEMPTS, 2 * budget, np.inf
    )
    if near is None:
        return None
    end = np.array(near.K), np.array(near.S)
    fit, _ = _best_search(problem, [end], 1, 2 * budget, spread)
    return fit and replace(fit, evaluations=fit.evaluations + near.evaluations)


def _best_search(
    problem: Problem,
    starts: list[tuple[Array, Array]],
    attempts: int,
    budget: int,
    spread: float,
) -> tuple[GainFit | None, str]:
    """The best of a few searches from the most promising starts, or None and why there is none."""
    ranked, evaluations, refused = _rank(problem, starts)
    best: GainFit | None = None
    for K, S in ranked[:attempts]:
        found = _search(problem, K, S, budget, spread)
        evaluations += found.evaluations
        refused += found.refused
        if best is None or _preference(found) < _preference(best):
            best = found
        if found.explained:
            break
    if best is None:
        return None, refused[0] if refused else "there is none"
    return replace(best, evaluations=evaluations, refused=tuple(refused)), ""


def refine_gain(
    problem: Problem,
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
    gain, metric = _consistent(problem, gain, metric)
    _, reason = misfit_or_reason(problem, gain, metric)
    if reason:
        raise SolverError("gain", f"the start cannot be simulated: {reason}", "start elsewhere")
    return _search(problem, gain, metric, max_evaluations, spread)


def describe_gain(fit: GainFit, gain: Array, metric: Array) -> GainFit:
    """What the problem of a fit says of another gain (m, n) and metric (m, m), without a search."""
    space = Coordinates(fit.problem, gain, metric)
    found = _gain_fit(space, space.start, 1)
    return replace(found, evaluations=fit.evaluations + 1, refused=fit.refused)


def bryson_starts(problem: Problem) -> list[tuple[Array, Array]]:
    """Gains (m, n) and metrics (m, m) of the regulators of `bryson_weights`."""
    return [(np.array(item.K), np.array(item.S)) for _, item in bryson_regulators(problem)]


def _rank(
    problem: Problem, starts: list[tuple[Array, Array]]
) -> tuple[list[tuple[Array, Array]], int, list[str]]:
    """The usable starts by their misfit, the evaluations spent, and why the others are not."""
    usable, refused = [], []
    for K, S in (_consistent(problem, *pair) for pair in starts):
        size, reason = misfit_or_reason(problem, K, S)
        if reason:
            refused.append(reason)
        else:
            usable.append((size, K, S))
    usable.sort(key=lambda item: item[0])
    return [(K, S) for _, K, S in usable], len(starts), refused


def _consistent(problem: Problem, gain: Array, metric: Array) -> tuple[Array, Array]:
    if not is_stable(problem.plant.A - problem.plant.B @ gain, discrete=True):
        return gain, metric
    return consistent_pair(problem.plant, gain, metric)


def _search(problem: Problem, gain: Array, metric: Array, budget: int, spread: float) -> GainFit:
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
        ftol = 1e-12 if noise == 0 else _NOISY_TOLERANCE
        z, more = _step_down(space, z, noise / spread, ftol, max(budget - spent, 1))
        spent += more
        before, misfit = misfit, float(np.linalg.norm(space.at(z).residual))
        if noise == 0 or misfit > (1 - _SETTLED) * before or spent >= budget:
            break
    return _gain_fit(space, z, spent)


def _step_down(
    space: Coordinates, z: Array, weight: float, ftol: float, budget: int
) -> tuple[Array, int]:
    """Least squares from z with a prior of that weight about the start; evaluations."""
    if has_many_trials(space):
        size = len(z) - space.trials * space.n
        weights = np.full(size, weight), weight
        return search_many(space, z, np.eye(size), weights, Tolerances(ftol, 1e-12, 1e-15, budget))
    target = space.with_prior(weight)
    found = scipy.optimize.least_squares(
        target.residual, z, jac=target.derivative, ftol=ftol, xtol=1e-12, gtol=1e-15,
        max_nfev=budget,
    )  # fmt: skip
    return found.x, int(found.nfev)


def _gain_fit(space: Coordinates, z: Array, evaluations: int) -> GainFit:
    found = space.unpack(z)
    problem = found.problem
    plant = problem.plant
    stabilises = is_stable(plant.A - plant.B @ found.K, discrete=True)
    misfit = float(np.linalg.norm(space.at(z).residual))
    jacobian = space.without_nuisance(z)
    return GainFit(
        frozen(found.K),
        frozen(found.S),
        problem,
        misfit,
        bool(stabilises and misfit <= EXPLAINED * recorded_size(problem)),
        stabilises,
        frozen(np.linalg.svd(jacobian, compute_uv=False)),
        _metrics(space, z, jacobian),
        evaluations,
        tuple(space.refused),
    )


def _metrics(space: Coordinates, z: Array, jacobian: Array) -> Array:
    """S, and the directions along which it moves alone, unseen, within the consistent pairs."""
    here = space.unpack(z)
    dK, dS = (change[: jacobian.shape[1]] for change in space.changes(here, z))
    natural = space.natural(dK).reshape(len(dK), -1).T
    alone = scipy.linalg.null_space(natural, rcond=_ALONE)
    # Of the triangle: the left vectors of all samples would take memory in their square.
    _, values, rows = np.linalg.svd(np.linalg.qr(jacobian @ alone, mode="r"))
    told = np.count_nonzero(values > _TOLD * float(np.linalg.norm(jacobian, 2)))
    untold = np.tensordot(rows[told:] @ alone.T, dS, 1)
    return frozen(np.concatenate([here.S[None], untold]))


def _better(first: GainFit | None, second: GainFit | None) -> GainFit | None:
    """The better of two searches, with the evaluations of both."""
    if first is None or second is None:
        return first or second
    evaluations = first.evaluations + second.evaluations
    return replace(min(first, second, key=_preference), evaluations=evaluations)


def _preference(found: GainFit) -> tuple[bool, float]:
    """Smaller is better. A gain that does not stabilise cannot be that of any weights."""
    return not found.stabilises, found.misfit
