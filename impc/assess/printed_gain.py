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

from impc.arrays import Array, frozen
from impc.assess.covariance import GainCovariance, gain_covariance
from impc.assess.long_run_covariance import white_noise
from impc.inverse.coordinates import Coordinates, descend
from impc.inverse.least_squares import Stop
from impc.inverse.problem import EXPLAINED, recorded_size
from impc.inverse.residuals import evaluate
from impc.model.riccati import stabilises

if TYPE_CHECKING:
    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem
    from impc.inverse.residuals import Evaluation

# On 60 random plants 51 searches ended after two rounds, 9 after three.
_ROUNDS = 4
_EVALUATIONS = 40
# Nats at which a search ends, and a round is the last.
_TOLERANCE = 0.01


@dataclass(frozen=True)
class ToldGain:
    """The gain that the recordings tell."""

    problem: Problem  # At the initial states and parameters found with this gain
    K: Array  # (m, n); the weights' along what the recordings do not tell
    S: Array  # (m, m); the weights' where the recordings do not tell it
    misfit: float  # 2-norm of the residual

    @property
    def parameters(self) -> Array:
        """Physical parameters in their units (k,); k is 0 where none are fitted."""
        family = self.problem.family
        if family is None:
            return np.zeros(0)
        return np.asarray(family.nominal * np.exp(self.problem.logarithms))


@dataclass(frozen=True)
class GainEstimate(ToldGain):
    """The gain that the recordings tell, and how far it is determined."""

    linear: GainCovariance  # To first order
    covariance: GainCovariance  # For noise of the colour that the residuals show, with curvature
    white: GainCovariance  # As if the residuals were white


def gain_estimate(fitted: Estimate) -> GainEstimate:
    """Estimate the gain behind a fit, and how far it is determined."""
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

    `gain` (m, n); `metric` (m, m).
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
        there = _round(here)
        if there is None:  # it leaves what can be described: the last gain stands
            break
        before, here = here, there
        same = np.count_nonzero(here.linear.told) == np.count_nonzero(before.linear.told)
        gained = len(here.evaluation.residual) * np.log(before.misfit / here.misfit)
        if same and gained < _TOLERANCE:
            break
    return here


def _described(problem: Problem, gain: Array, metric: Array, evaluation: Evaluation) -> _Here:
    misfit = float(np.linalg.norm(evaluation.residual))
    linear = gain_covariance(problem, gain, metric, evaluation=evaluation)
    return _Here(problem, gain, metric, misfit, evaluation, linear)


def _round(here: _Here) -> _Here | None:
    """Least squares over the identified directions and everything beside the gain.

    What is beside the gain has the normal prior of any search (`fit_gain`): it is not printed with
    an interval, and some of it nothing determines.
    """
    space = Coordinates(here.problem, here.K, here.S)
    space.evaluated(space.start, here.evaluation)
    identified = here.linear.directions[here.linear.told]
    beside = int(space.ends[1] - space.ends[0] + space.ends[3] - space.ends[2])
    along = scipy.linalg.block_diag(identified.T, np.eye(beside))
    shared = np.concatenate([np.zeros(len(identified)), np.ones(beside)])
    stop = Stop(_TOLERANCE, 0.0, _EVALUATIONS)
    z, _, _ = descend(space, space.start, stop, shared=shared, own=1.0, along=along)
    there = space.unpack(z)
    plant = there.problem.plant
    if not stabilises(plant, there.K):
        return None
    return _described(there.problem, there.K, there.S, space.evaluated(z)[0])
