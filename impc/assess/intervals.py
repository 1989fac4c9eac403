"""Intervals of what a fit estimates, each with the method that made it.

    sandwich      value +- z deviation, for the colour that the residuals show (`gain_covariance`)
    cramer-rao    the same as if the residuals were white: too narrow where they are not
    block, model  percentiles of a bootstrap (`impc.assess.resampling`)
    profile       where the misfit has grown by chi-squared's quantile (`impc.assess.profiles`)

Parameters are searched in logarithms and are positive: theirs are value * exp(+- z deviation).
docs/fitting.md says how often each covers the truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.special

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.assess.covariance import GainCovariance
    from impc.assess.printed_gain import GainEstimate
    from impc.model.plant import Plant

#: Of an interval, where none is asked for.
LEVEL = 0.95
#: Standard error of the logarithm of a parameter from which on it is not identified.
PARAMETER = 0.5


@dataclass(frozen=True)
class Interval:
    """One interval."""

    name: str  # K.<control>.<state>, the name of a parameter, or u_max.<control>
    method: str  # See the module's text
    level: float  # Between 0 and 1, 0.95 for 95 %
    value: float | None  # The estimate; None when nothing determines it
    low: float  # Infinite where the recordings set no end
    high: float
    # Whether this number is individually identified: an entry of the gain by `GainCovariance`, a
    # parameter when the standard error of its logarithm is below 0.5. Where it is not, a
    # covariance's interval is that of a plain least-squares estimate, while the value is kept near
    # where the search began: it covers the truth more often than its level. A bootstrap's has no
    # ends.
    told: bool = True

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
    """Normal intervals of the entries of K and of the parameters."""
    z = float(scipy.special.ndtri(0.5 + LEVEL / 2))
    names = entry_names(estimate.problem.plant)
    found = [
        Interval(name, method, LEVEL, float(value), float(value - half), float(value + half), told)
        for name, value, half, told in zip(
            names,
            np.ravel(estimate.K),
            z * np.ravel(covariance.entries),
            np.ravel(covariance.told_entries).tolist(),
            strict=True,
        )
    ]
    family = estimate.problem.family
    if family is not None:
        for name, value, deviation in zip(
            family.names, estimate.parameters, covariance.parameters, strict=True
        ):
            low, high = _around(value, z * float(deviation))
            told = bool(deviation < PARAMETER)
            found.append(Interval(name, method, LEVEL, float(value), low, high, told))
    return tuple(found)


def _around(value: Array, half: float) -> tuple[float, float]:
    """value * exp(-+ half); 0 and infinity when nothing is known."""
    if half > 700:  # exp overflows: the logarithm is as good as free
        return 0.0, float("inf")
    return float(value * np.exp(-half)), float(value * np.exp(half))
