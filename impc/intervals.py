"""Intervals of what a fit estimates, each with the method that made it.

    sandwich      value +- z deviation, for the colour that the residuals show (`gain_covariance`)
    cramer-rao    the same as if the residuals were white: too narrow where they are not
    block, model  percentiles of a bootstrap (`impc.bootstrap`)
    profile       where the misfit has grown by chi-squared's quantile (`impc.profile_likelihood`)

Parameters are searched in logarithms and are positive: theirs are value * exp(+- z deviation).
docs/fitting.md says how often each covers the truth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.stats

from impc.arrays import Array, frozen
from impc.gain_covariance import gain_covariance
from impc.residual_noise import white_noise

if TYPE_CHECKING:
    from impc.fitted_controller import FittedController
    from impc.gain_covariance import GainCovariance
    from impc.plant import Plant

__all__ = ["LEVEL", "Interval", "covariance_intervals", "entry_names", "white_covariance"]

#: Of an interval, where none is asked for.
LEVEL = 0.95


@dataclass(frozen=True)
class Interval:
    """One interval.

    Attributes
    ----------
    name : str
        K.<control>.<state>, the name of a parameter, or u_max.<control>.
    method : str
        See the module's text.
    level : float
        Between 0 and 1, 0.95 for 95 %.
    value : float or None
        The estimate; None when nothing determines it.
    low, high : float
        Infinite where the recordings set no end.
    """

    name: str
    method: str
    level: float
    value: float | None
    low: float
    high: float


def entry_names(plant: Plant) -> tuple[str, ...]:
    """Names of the entries of a gain, row by row."""
    return tuple(f"K.{control}.{state}" for control in plant.controls for state in plant.states)


def white_covariance(fitted: FittedController) -> GainCovariance:
    """The Cramér-Rao counterpart of the sandwich covariance, at the gain of the weights."""
    solution = fitted.solution
    reported = replace(
        fitted.free, K=frozen(solution.K), S=frozen(solution.S), problem=fitted.problem
    )
    return gain_covariance(reported, white_noise)


def covariance_intervals(
    fitted: FittedController, covariance: GainCovariance, method: str, level: float = LEVEL
) -> tuple[Interval, ...]:
    """Normal intervals of the entries of K and of the parameters.

    Parameters
    ----------
    fitted : FittedController
    covariance : GainCovariance
        At its gain.
    method : str
        Name of the covariance, for the record.
    level : float
        Of the interval, between 0 and 1.
    """
    z = float(scipy.stats.norm.ppf(0.5 + level / 2))
    K = np.ravel(fitted.solution.K)
    names = entry_names(fitted.problem.plant)
    half = z * np.ravel(covariance.entries)
    found = [
        Interval(name, method, level, float(value), float(value - size), float(value + size))
        for name, value, size in zip(names, K, half, strict=True)
    ]
    family = fitted.problem.family
    if family is not None:
        values = np.asarray(family.nominal * np.exp(fitted.problem.logarithms))
        for name, value, deviation in zip(family.names, values, covariance.parameters, strict=True):
            low, high = _around(value, z * float(deviation))
            found.append(Interval(name, method, level, float(value), low, high))
    return tuple(found)


def _around(value: Array, half: float) -> tuple[float, float]:
    """value * exp(-+ half); 0 and infinity when nothing is known."""
    if half > 700:  # exp overflows: the logarithm is as good as free
        return 0.0, float("inf")
    return float(value * np.exp(-half)), float(value * np.exp(half))
