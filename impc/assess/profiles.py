"""Profile likelihood of one entry of the gain or one physical parameter.

The number is held at v and everything else (rest of the gain, initial states, other parameters) is
refitted. With F(v) the least -2 log posterior and the factor f >= 1 by which autocorrelation widens
the variance of the number,

    D(v) = (F(v) - F(v*)) / f

is chi-squared with one degree of freedom at the true value, and {v : D(v) <= q} is an interval that
need not be symmetric. Without an end the recordings do not identify the number. For the input limit
see `input_limits`.

An entry of K and a log-parameter are linear in the unknowns z (`GainLaw`), so that the search runs
in the null space of their row.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg
import scipy.special

from impc.arrays import Array, Frozen, frozen
from impc.assess.covariance import gain_covariance
from impc.assess.fit_curve import FitCurve
from impc.assess.long_run_covariance import white_noise
from impc.assess.printed_gain import LEVEL, Interval, entry_names
from impc.errors import InputError
from impc.inverse.laws import GainLaw
from impc.inverse.minimiser import PROMISE, Stop
from impc.inverse.unknowns import Unknowns

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.assess.printed_gain import GainEstimate
    from impc.inverse.unknowns import Fitted

# 1 / SD of a prior, far beyond any possible gain, that keeps free directions from drifting.
_WEAK = 1e-2
# Values tried on each side, in standard errors; if D stays low there is no end.
_STEPS = np.array([1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0, np.inf])
# Accuracy of the minimum in standard errors, and evaluations of a point.
_MINIMUM, _EVALUATIONS = 0.02, 40


@dataclass(frozen=True)
class Profile(Frozen):
    """Profile of one number."""

    interval: Interval  # Interval with method "profile"
    # Values tried (t,), ascending, and D at each (t,), for figures
    values: Array
    distances: Array


def profile_likelihood(estimate: GainEstimate, name: str) -> Profile:
    """Profile an entry of K (K.<control>.<state>) or a fitted parameter."""
    require_numbers(estimate, [name])
    problem, entries = estimate.problem, entry_names(estimate.problem.plant)
    is_entry = name in entries
    index = entries.index(name) if is_entry else problem.parameter_names.index(name)
    curve, (error, factor) = _curve(estimate, is_entry, index), _spread(estimate, is_entry, index)
    curve.loss(0.0)

    def number(offset: float) -> float:
        if is_entry:
            return float(estimate.K.ravel()[index]) + offset
        return float(estimate.parameters[index] * np.exp(offset)) if offset < 700 else np.inf

    rise, steps = float(scipy.special.chdtri(1, 1 - LEVEL)) * factor, error * _STEPS
    low, high = curve.ends(
        rise, lambda at: ((at - steps).tolist(), (at + steps).tolist()), _MINIMUM * error, error
    )
    return Profile(
        Interval(name, "profile", LEVEL, number(curve.best), number(low), number(high)),
        frozen([number(offset) for offset in curve.finite]),
        frozen([curve.rise(offset) / factor for offset in curve.finite]),
    )


def require_numbers(estimate: GainEstimate, names: Sequence[str]) -> None:
    """Raise InputError unless each name is an entry of K or a fitted parameter."""
    known = [*entry_names(estimate.problem.plant), *estimate.problem.parameter_names]
    for name in names:
        if name not in known:
            said = f"choose from: {', '.join(known)}"
            raise InputError(f"profile of {name}", "no such entry or parameter", said)


def _curve(estimate: GainEstimate, is_entry: bool, index: int) -> FitCurve:
    """Fits with an entry or a log-parameter at an offset from the estimate."""
    law = GainLaw(estimate.problem, np.array(estimate.K), np.array(estimate.S))
    space = Unknowns(estimate.problem, law)
    row = np.zeros(len(space.start))
    if is_entry:
        row[: len(law.gains)] = law.gains.reshape(len(law.gains), -1)[:, index]
    else:
        row[space.parameters.start + index] = space.units[index]
    shared, step = np.delete(row, space.trial), row / float(row @ row)
    # Parameters stay columns of their own: the stated ones have a prior.
    first, last = np.flatnonzero(shared)[[0, -1]] + [0, 1]
    null = scipy.linalg.null_space(shared[None, first:last])
    along = scipy.linalg.block_diag(np.eye(first), null, np.eye(len(shared) - last))

    def fit(offset: float, near: float, start: Fitted) -> Fitted:
        z, stop = np.array(start.z) + (offset - near) * step, Stop(PROMISE, 0.0, _EVALUATIONS)
        return space.search(z, stop, shared=_WEAK, own=_WEAK, along=along)

    return FitCurve(fit, (0.0, space.ended(space.start)), lambda end: end.objective)


def _spread(estimate: GainEstimate, is_entry: bool, index: int) -> tuple[float, float]:
    """Standard error in units of the offset, and the autocorrelation factor f."""
    at = estimate.problem, np.array(estimate.K), np.array(estimate.S)
    both = estimate.covariance, gain_covariance(*at, white_noise, curvature=True)
    coloured, white = (
        float((np.ravel(one.entries) if is_entry else one.parameters)[index]) for one in both
    )
    if not (np.isfinite(coloured) and white > 0):
        return np.inf, 1.0
    return coloured, max((coloured / white) ** 2, 1.0)
