"""Gain reported with intervals: the weights' gain, updated along identified directions.

The gain of fitted weights is biased by the penalty on their condition number, and an unrestricted
gain drifts along hardly identified directions, often to the edge of stability, where standard
errors are too small. Therefore the weights' gain is updated by ordinary least squares, jointly with
S, initial states and parameters, along the identified directions only (`covariance.IDENTIFIED`):

    K = K_weights + sum over identified directions i of  w_i  direction_i    (whitened coordinates)

Directions are recomputed at the new gain until the misfit stays. Along them the estimate is that of
least squares without a prior, which its covariance describes. Parameters are positive and searched
in logarithms: their intervals are value * exp(+- z SE). See docs/why/intervals.md.
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


# Of 60 random plants 51 searches ended after two rounds, 9 after three.
_ROUNDS = 4
_EVALUATIONS = 40
# Nats at which a search, and the iteration of rounds, ends.
_TOLERANCE = 0.01


@dataclass(frozen=True)
class IdentifiedGain:
    """Gain that the recordings identify."""

    problem: Problem  # At the initial states and parameters fitted with this gain
    K: Array  # (m, n); that of the weights along unidentified directions
    S: Array  # (m, m); that of the weights where not identified
    misfit: float  # 2-norm of the residual

    @property
    def parameters(self) -> Array:
        """Physical parameters in their units (k,); empty if none are fitted."""
        family = self.problem.family
        if family is None:
            return np.zeros(0)
        return family.values(np.array(self.problem.logarithms))


@dataclass(frozen=True)
class GainEstimate(IdentifiedGain):
    """Identified gain with its covariance."""

    linear: GainCovariance  # To first order
    covariance: GainCovariance  # HAC covariance with curvature
    # The same with stated uncertainties set to zero; None if there are none
    exact: GainCovariance | None = None


def gain_estimate(fitted: Estimate) -> GainEstimate:
    """Estimate the identified gain of a fit, and its covariance."""
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
    """Estimate the identified gain, starting from a gain near it."""
    here = _search(problem, gain, metric)
    return IdentifiedGain(here.problem, frozen(here.K), frozen(here.S), here.misfit)


@dataclass(frozen=True)
class _Here(IdentifiedGain):
    """Gain of the search with its first-order covariance."""

    evaluation: Evaluation
    linear: GainCovariance


def _search(problem: Problem, gain: Array, metric: Array) -> _Here:
    here = _described(problem, gain, metric, evaluate(problem, gain, metric))
    explained = here.misfit <= EXPLAINED * recorded_size(problem)
    for _ in range(0 if explained else _ROUNDS):
        there = _round(here)
        if there is None:  # no covariance there: keep the last gain
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
    """Least squares over the identified directions and all unknowns other than the gain.

    The latter keep the prior of any search (`fit_gain`): some of them are not identified.
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


#: Default confidence level.
LEVEL = 0.95
#: Largest standard error of the log of an identified parameter.
PARAMETER = 0.5


@dataclass(frozen=True)
class Interval:
    """Confidence interval of one number."""

    name: str  # K.<control>.<state>, the name of a parameter, or u_max.<control>
    # sandwich: normal with HAC standard error; block: bootstrap; profile: profile likelihood
    method: str
    level: float  # Between 0 and 1, 0.95 for 95 %
    value: float | None  # Estimate; None if not identified
    low: float  # Infinite if the recordings set no end
    high: float
    # Whether the number is individually identified: gain entries by `GainCovariance`, parameters if
    # the standard error of the log is below 0.5. If not, a sandwich interval is that of ordinary
    # least squares, while the value stays near its start, so that coverage exceeds the level; a
    # bootstrap interval is infinite.
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
            if stated:  # a stated value is not a result
                continue
            low, high = _around(value, z * float(deviation))
            identified = bool(deviation < PARAMETER)
            found.append(Interval(name, method, LEVEL, float(value), low, high, identified))
    return tuple(found)


def _around(value: Array, half: float) -> tuple[float, float]:
    """value * exp(-+ half); 0 and infinity if unknown."""
    if half > 700:  # exp would overflow
        return 0.0, float("inf")
    return float(value * np.exp(-half)), float(value * np.exp(half))


def interval_table(fitted: Estimate) -> pd.DataFrame:
    """Gain entries and free parameters with 95 % intervals, one row each.

    Returns
    -------
    pandas.DataFrame
        Index: name, such as "K.u.x1" for the entry from state x1 to input u. Columns: `unit`,
        `value`, `low`, `high`, and `identified`, whether the recordings identify this number
        individually. Values are least-squares estimates along the identified directions and can
        differ from K, which belongs to weights (docs/why/intervals.md).
    """
    return _table(gain_estimate(fitted))


def continuous_interval_table(fitted: Estimate) -> pd.DataFrame:
    """Continuous-time gain of which that of `intervals()` is the sampled counterpart.

    For comparison with published gains; columns as in `intervals()`. Intervals are first-order
    (delta method) at fixed parameters. `Controller.from_continuous_gain` defines and inverts the
    conversion.
    """
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
