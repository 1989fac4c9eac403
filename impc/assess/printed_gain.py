"""The gain that recordings identify: what a fit prints with intervals, and how precise it is.

The weights of a fit are chosen with a penalty on their condition number, which moves their gain,
and they are confined to gains that some weights have. A gain without weights that is free in every
direction is no better: along those that are hardly identified it drifts, often to the edge
of stability, where every derivative is another one and deviations come out too small
(docs/fitting.md has the measurements). So the gain of the weights is moved along the directions
that the recordings identify (`gain_covariance.IDENTIFIED`), by plain least squares together with S,
initial states and parameters, and along no other:

    K = K_weights + sum over identified directions i of  w_i  direction_i      in natural
    coordinates

The directions are taken anew at the gain that was found, until the misfit stays. Along them the
estimate is that of least squares without prior, and the interval from its covariance is its own.
Parameters are searched in logarithms and are positive: their intervals are value * exp(+- z
deviation). docs/fitting.md says how often each interval covers the truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg
import scipy.special

from impc.arrays import Array, frozen
from impc.assess.covariance import GainCovariance, gain_covariance
from impc.checking import replace
from impc.inverse.coordinates import Coordinates, descend
from impc.inverse.least_squares import Stop
from impc.inverse.problem import EXPLAINED, recorded_size
from impc.inverse.residuals import evaluate
from impc.model.continuous_gain import continuous_gain
from impc.model.plant import UNKNOWN, gain_unit
from impc.model.riccati import stabilises

if TYPE_CHECKING:
    import pandas as pd

    from impc.arrays import Array
    from impc.assess.covariance import GainCovariance
    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem
    from impc.inverse.residuals import Evaluation
    from impc.model.plant import Plant


# On 60 random plants 51 searches ended after two rounds, 9 after three.
_ROUNDS = 4
_EVALUATIONS = 40
# Nats at which a search ends, and a round is the last.
_TOLERANCE = 0.01


@dataclass(frozen=True)
class IdentifiedGain:
    """The gain that the recordings identify."""

    problem: Problem  # At the initial states and parameters found with this gain
    K: Array  # (m, n); the weights' along what the recordings do not identify
    S: Array  # (m, m); the weights' where the recordings do not identify it
    misfit: float  # 2-norm of the residual

    @property
    def parameters(self) -> Array:
        """Physical parameters in their units (k,); k is 0 where none are fitted."""
        family = self.problem.family
        if family is None:
            return np.zeros(0)
        return family.values(np.array(self.problem.logarithms))


@dataclass(frozen=True)
class GainEstimate(IdentifiedGain):
    """The gain that the recordings identify, and how far it is determined."""

    linear: GainCovariance  # To first order
    covariance: GainCovariance  # For noise of the colour that the residuals show, with curvature
    # The same if what has a stated uncertainty were exactly as it was found; None without any
    exact: GainCovariance | None = None


def gain_estimate(fitted: Estimate) -> GainEstimate:
    """Estimate the gain behind a fit, and how far it is determined."""
    here = _search(fitted.problem, np.array(fitted.gain), np.array(fitted.metric))
    problem, at = here.problem, (frozen(here.K), frozen(here.S))
    fixed, found = problem.with_body_fixed(), here.evaluation
    alone = replace(found, dparameters=found.dparameters[:, ~problem.stated])
    return GainEstimate(
        problem,
        *at,
        here.misfit,
        here.linear,
        gain_covariance(problem, *at, curvature=True, evaluation=found),
        None if fixed is problem else gain_covariance(fixed, *at, curvature=True, evaluation=alone),
    )


def identified_gain(problem: Problem, gain: Array, metric: Array) -> IdentifiedGain:
    """Estimate the gain behind recordings from one near it: that of the weights of a fit."""
    here = _search(problem, gain, metric)
    return IdentifiedGain(here.problem, frozen(here.K), frozen(here.S), here.misfit)


@dataclass(frozen=True)
class _Here(IdentifiedGain):
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
        same = np.count_nonzero(here.linear.identified) == np.count_nonzero(
            before.linear.identified
        )
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
    identified = here.linear.directions[here.linear.identified]
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


#: Of an interval, where none is asked for.
LEVEL = 0.95
#: Standard error of the logarithm of a parameter from which on it is not identified.
PARAMETER = 0.5


@dataclass(frozen=True)
class Interval:
    """One interval."""

    name: str  # K.<control>.<state>, the name of a parameter, or u_max.<control>
    # sandwich: normal, for the colour that the residuals show; block: of a bootstrap; profile: see
    # `profiles`
    method: str
    level: float  # Between 0 and 1, 0.95 for 95 %
    value: float | None  # The estimate; None when nothing determines it
    low: float  # Infinite where the recordings set no end
    high: float
    # Whether this number is individually identified: an entry of the gain by `GainCovariance`, a
    # parameter when the standard error of its logarithm is below 0.5. Where it is not, a
    # covariance's interval is that of a plain least-squares estimate, while the value is kept near
    # where the search began: it covers the truth more often than its level. A bootstrap's has no
    # ends.
    identified: bool = True

    @property
    def excludes_zero(self) -> bool:
        """Whether both ends are on one side of zero."""
        return self.low > 0 or self.high < 0


def entry_names(plant: Plant) -> tuple[str, ...]:
    """Names of the entries of a gain, row by row."""
    return tuple(f"K.{control}.{state}" for control in plant.controls for state in plant.states)


def covariance_intervals(
    estimate: GainEstimate, covariance: GainCovariance, method: str
) -> tuple[Interval, ...]:
    """Normal intervals of the entries of K and of free parameters."""
    z = float(scipy.special.ndtri(0.5 + LEVEL / 2))
    names = entry_names(estimate.problem.plant)
    found = [
        Interval(
            name, method, LEVEL, float(value), float(value - half), float(value + half), identified
        )
        for name, value, half, identified in zip(
            names,
            np.ravel(estimate.K),
            z * np.ravel(covariance.entries),
            np.ravel(covariance.individually_identified).tolist(),
            strict=True,
        )
    ]
    family = estimate.problem.family
    if family is not None:
        for name, value, deviation, stated in zip(
            family.names, estimate.parameters, covariance.parameters, family.stated, strict=True
        ):
            if stated:  # what was stated is no result of the recordings
                continue
            low, high = _around(value, z * float(deviation))
            identified = bool(deviation < PARAMETER)
            found.append(Interval(name, method, LEVEL, float(value), low, high, identified))
    return tuple(found)


def _around(value: Array, half: float) -> tuple[float, float]:
    """value * exp(-+ half); 0 and infinity when nothing is known."""
    if half > 700:  # exp overflows: the logarithm is as good as free
        return 0.0, float("inf")
    return float(value * np.exp(-half)), float(value * np.exp(half))


def interval_table(fitted: Estimate) -> pd.DataFrame:
    """Intervals of the gain and of fitted parameters, for the noise that the residuals show."""
    return _table(gain_estimate(fitted))


def continuous_interval_table(fitted: Estimate) -> pd.DataFrame:
    """The same of the gain in continuous time, to first order (delta method)."""
    found = gain_estimate(fitted)
    K, slopes = continuous_gain(found.problem.plant, found.K)
    entries, foreign = found.covariance.combinations(slopes)
    shape = {"entries": entries.reshape(K.shape), "foreign": foreign.reshape(K.shape)}
    return _table(replace(found, K=K, covariance=replace(found.covariance, **shape)))


def _table(found: GainEstimate) -> pd.DataFrame:
    import pandas as pd  # noqa: PLC0415  # a third of a second

    plant = found.problem.plant
    units = [gain_unit(plant, u, x) for u in plant.controls for x in plant.states]
    items = covariance_intervals(found, found.covariance, "sandwich")
    units += [UNKNOWN] * (len(items) - len(units))  # of parameters
    rows = [
        (item.name, unit, item.value, item.low, item.high, item.identified)
        for item, unit in zip(items, units, strict=True)
    ]
    heads = ["name", "unit", "value", "low", "high", "identified"]
    return pd.DataFrame(rows, columns=heads).set_index("name")
