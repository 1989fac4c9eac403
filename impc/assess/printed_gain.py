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
from impc.checking import replace
from impc.inverse.arrow import Tolerances
from impc.inverse.coordinates import Coordinates
from impc.inverse.many_trials import has_many_trials, search_many

if TYPE_CHECKING:
    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem

__all__ = ["GainEstimate", "ToldGain", "gain_estimate", "told_gain"]

# On 60 random plants 51 searches ended after two rounds, 9 after three.
_ROUNDS = 4
_SETTLED = 1e-4
_EVALUATIONS = 40
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
    linear : GainCovariance
        To first order.
    """

    problem: Problem
    K: Array
    S: Array
    misfit: float
    linear: GainCovariance

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
    covariance : GainCovariance
        For noise of the colour that the residuals show, with curvature.
    white : GainCovariance
        As if the residuals were white.
    """

    covariance: GainCovariance
    white: GainCovariance


def gain_estimate(fitted: Estimate) -> GainEstimate:
    """Estimate the gain behind a fit, and how far it is determined.

    Parameters
    ----------
    fitted : Estimate
        As for `told_gain`.

    Raises
    ------
    SolverError
        As `told_gain`.
    """
    here = told_gain(fitted)
    at = here.problem, here.K, here.S
    return GainEstimate(
        *at,
        here.misfit,
        here.linear,
        gain_covariance(*at, curvature=True),
        gain_covariance(*at, white_noise, curvature=True),
    )


def told_gain(fitted: Estimate) -> ToldGain:
    """Estimate the gain behind a fit.

    Parameters
    ----------
    fitted : Estimate
        The search begins at the gain of its weights.

    Raises
    ------
    SolverError
        When the residual at that gain is not finite.
    """
    K, S = np.array(fitted.gain), np.array(fitted.metric)
    here = ToldGain(fitted.problem, K, S, fitted.misfit, gain_covariance(fitted.problem, K, S))
    for _ in range(0 if fitted.explained else _ROUNDS):
        before, here = here, _round(here)
        same = np.count_nonzero(here.linear.told) == np.count_nonzero(before.linear.told)
        if same and here.misfit > (1 - _SETTLED) * before.misfit:
            break
    return replace(here, K=frozen(here.K), S=frozen(here.S))


def _round(here: ToldGain) -> ToldGain:
    """Least squares over the told directions and everything beside the gain.

    What is beside the gain has the normal prior of any search (`fit_gain`): it is not printed with
    an interval, and some of it nothing determines.
    """
    space = Coordinates(here.problem, here.K, here.S)
    samples = sum(trial.outputs.size for trial in here.problem.recordings)
    noise = float(np.linalg.norm(space.at(space.start).residual)) / np.sqrt(samples)
    z = _least_squares(space, here.linear, noise)
    there = space.unpack(z)
    misfit = float(np.linalg.norm(space.at(z).residual))
    covariance = gain_covariance(there.problem, there.K, there.S)
    return ToldGain(there.problem, there.K, there.S, misfit, covariance)


def _least_squares(space: Coordinates, linear: GainCovariance, noise: float) -> Array:
    """Where the search ends that moves the gain along the told directions only.

    The search has the same natural coordinates as the directions: both are those of this gain.
    """
    if has_many_trials(space) and space.m == 1:  # one input: no other coordinate moves the gain
        told = linear.directions[linear.told]
        beside = int(space.ends[1] - space.ends[0] + space.ends[3] - space.ends[2])
        shared = scipy.linalg.block_diag(told.T, np.eye(beside))
        weights = np.concatenate([np.zeros(len(told)), np.full(beside, noise)]), noise
        ends = Tolerances(1e-8, 1e-12, 1e-15, _EVALUATIONS)
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
        ftol=1e-8,
        xtol=1e-12,
        gtol=1e-15,
        max_nfev=_EVALUATIONS,
    )
    return np.asarray(space.start + along @ found.x)
