"""The gain that recordings tell: what a fit prints with intervals, and how far it is determined.

The weights of a fit are chosen with a price on their condition number, which moves their gain, and
they are confined to gains that some weights have. A gain without weights that is free in every
direction is no better: along those that the recordings hardly tell it wanders off, often to the
edge of stability, where every derivative is another one and deviations come out too small
(docs/fitting.md has the measurements). So the gain of the weights is moved along the directions
that the recordings tell (`gain_covariance.TOLD`), by plain least squares together with S, initial
states and parameters, and along no other:

    K = K_weights + sum over told directions i of  w_i  direction_i      in natural coordinates

The directions are taken anew at the gain that was found, until the misfit stays. Along them the
estimate is that of least squares without prior, and the interval from its covariance is its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg
import scipy.optimize

from impc.arrays import Array, frozen
from impc.assess.covariance import GainCovariance, gain_covariance
from impc.assess.long_run_covariance import white_noise
from impc.inverse.arrow import Tolerances
from impc.inverse.coordinates import Coordinates
from impc.inverse.gain_search import EXPLAINED
from impc.inverse.many_trials import has_many_trials, search_many
from impc.inverse.problem import recorded_size
from impc.inverse.residuals import evaluate

if TYPE_CHECKING:
    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem
    from impc.inverse.residuals import Evaluation

__all__ = ["GainEstimate", "ToldGain", "gain_estimate", "told_gain"]

# On 60 random plants 51 searches ended after two rounds, 9 after three.
_ROUNDS = 4
_SETTLED = 1e-4
_EVALUATIONS = 40
# Of the misfit's square. Where the limit of an input is met the sensitivities have kinks, about
# which a search goes to and fro: eight replicates on the seat took half the evaluations of 1e-8 and
# ended within .06 of a deviation of its gain (1e-5: .04, but 4 of chi-square short in one).
_TOLERANCE = 1e-6
# Steps that move the gain by less than this along what is not told leave it there.
_SAME = 1e-10


@dataclass(frozen=True)
class ToldGain:
    """The gain that the recordings tell.

    Attributes
    ----------
    problem : Problem
        At the initial states and parameters found with this gain.
    K : Array
        (m, n); the weights' along what the recordings do not tell.
    S : Array
        (m, m); the weights' where the recordings do not tell it.
    misfit : float
        2-norm of the residual.
    """

    problem: Problem
    K: Array
    S: Array
    misfit: float

    @property
    def parameters(self) -> Array:
        """Physical parameters in their units (k,); k is 0 where none are fitted."""
        family = self.problem.family
        if family is None:
            return np.zeros(0)
        return np.asarray(family.nominal * np.exp(self.problem.logarithms))


@dataclass(frozen=True)
class GainEstimate(ToldGain):
    """The gain that the recordings tell, and how far it is determined.

    Attributes
    ----------
    linear : GainCovariance
        To first order.
    covariance : GainCovariance
        For noise of the colour that the residuals show, with curvature.
    white : GainCovariance
        As if the residuals were white.
    """

    linear: GainCovariance
    covariance: GainCovariance
    white: GainCovariance


def gain_estimate(fitted: Estimate) -> GainEstimate:
    """Estimate the gain behind a fit, and how far it is determined.

    Parameters
    ----------
    fitted : Estimate
        The search begins at the gain of its weights.

    Raises
    ------
    SolverError
        As `told_gain`.
    """
    here = _search(fitted.problem, np.array(fitted.gain), np.array(fitted.metric))
    at = here.problem, frozen(here.K), frozen(here.S)
    return GainEstimate(
        *at,
        here.misfit,
        here.linear,
        gain_covariance(*at, curvature=True, evaluation=here.evaluation),
        gain_covariance(*at, white_noise, curvature=True, evaluation=here.evaluation),
    )


def told_gain(problem: Problem, gain: Array, metric: Array) -> ToldGain:
    """Estimate the gain behind recordings from one near it: that of the weights of a fit.

    Parameters
    ----------
    problem : Problem
        At the initial states and the parameters that belong to the gain.
    gain, metric : Array
        K (m, n) and S (m, m) where the search begins. The gain that explains its recordings to
        rounding stays.

    Raises
    ------
    SolverError
        When the residual at that gain is not finite.
    """
    here = _search(problem, gain, metric)
    return ToldGain(here.problem, frozen(here.K), frozen(here.S), here.misfit)


@dataclass(frozen=True)
class _Here(ToldGain):
    """A gain of the search, with what the recordings say of it to first order."""

    evaluation: Evaluation
    linear: GainCovariance


def _search(problem: Problem, gain: Array, metric: Array) -> _Here:
    here = _described(problem, gain, metric, evaluate(problem, gain, metric))
    explained = here.misfit <= EXPLAINED * recorded_size(problem)
    for _ in range(0 if explained else _ROUNDS):
        before, here = here, _round(here)
        same = np.count_nonzero(here.linear.told) == np.count_nonzero(before.linear.told)
        if same and here.misfit > (1 - _SETTLED) * before.misfit:
            break
    return here


def _described(problem: Problem, gain: Array, metric: Array, evaluation: Evaluation) -> _Here:
    misfit = float(np.linalg.norm(evaluation.residual))
    linear = gain_covariance(problem, gain, metric, evaluation=evaluation)
    return _Here(problem, gain, metric, misfit, evaluation, linear)


def _round(here: _Here) -> _Here:
    """Least squares over the told directions and everything beside the gain.

    What is beside the gain has the normal prior of any search (`fit_gain`): it is not printed with
    an interval, and some of it nothing determines.
    """
    space = Coordinates(here.problem, here.K, here.S)
    space.evaluated(space.start, here.evaluation)
    samples = sum(trial.outputs.size for trial in here.problem.recordings)
    z = _least_squares(space, here.linear, here.misfit / np.sqrt(samples))
    there = space.unpack(z)
    return _described(there.problem, there.K, there.S, space.evaluated(z)[0])


def _least_squares(space: Coordinates, linear: GainCovariance, noise: float) -> Array:
    """Where the search ends that moves the gain along the told directions only.

    The search has the same natural coordinates as the directions: both are those of this gain.
    """
    if has_many_trials(space) and space.m == 1:  # one input: no other coordinate moves the gain
        told = linear.directions[linear.told]
        beside = int(space.ends[1] - space.ends[0] + space.ends[3] - space.ends[2])
        shared = scipy.linalg.block_diag(told.T, np.eye(beside))
        weights = np.concatenate([np.zeros(len(told)), np.full(beside, noise)]), noise
        ends = Tolerances(_TOLERANCE, 1e-12, 1e-15, _EVALUATIONS)
        return search_many(space, space.start, shared, weights, ends)[0]
    changes, _ = space.changes(space.unpack(space.start), space.start)
    moves = space.natural(changes).reshape(len(changes), -1).T
    along = scipy.linalg.null_space(linear.directions[~linear.told] @ moves, _SAME)
    prior = noise * along[space.ends[0] :]

    def residual(step: Array) -> Array:
        return np.concatenate([space.at(space.start + along @ step).residual, prior @ step])

    def derivative(step: Array) -> Array:
        return np.vstack([space.at(space.start + along @ step).jacobian @ along, prior])

    found = scipy.optimize.least_squares(
        residual,
        np.zeros(along.shape[1]),
        jac=derivative,
        ftol=_TOLERANCE,
        xtol=1e-12,
        gtol=1e-15,
        max_nfev=_EVALUATIONS,
    )
    return np.asarray(space.start + along @ found.x)
