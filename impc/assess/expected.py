"""Expected interval widths of a planned experiment.

An assumed subject is simulated without noise. At the truth the residual is then zero, and the
derivatives of the outputs are those of the future recordings. With recording noise of known size
and autocorrelation they give the standard errors that a fit would report (`covariance`). Stated
uncertainties enter as priors. More trials are less noise: the same derivatives, other priors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from impc.arrays import Array, Frozen, frozen, with_shape
from impc.assess.covariance import (
    GainCovariance,
    gain_covariance,
    identified_metric,
    slopes_at,
)
from impc.assess.long_run_covariance import ResidualNoise
from impc.checking import checked, replace
from impc.control.controller import Controller
from impc.errors import InputError
from impc.inverse.problem import Problem
from impc.inverse.residuals import along_bounds
from impc.model.bounds import bound_rows

# A larger coefficient is a drift, not noise.
_LARGEST_ROOT = 0.999
# Relative change of the outputs below which a limit counts as never reached.
_UNSEEN = 1e-12
#: Multiples of the planned trials for which standard errors are computed.
MULTIPLES = (0.25, 0.5, 1.0, 2.0, 4.0, 10.0)


@dataclass(frozen=True)
class Expectation(Frozen):
    """Expected precision of the fit of a problem.

    Standard errors are infinite for entries that are not individually identified.
    """

    gain: GainCovariance  # To second order, as reported by a fit
    by_trials: Array  # Standard error of each entry of K at multiples of the trials (k, m, n)
    exact: Array | None  # If all stated parameters were known exactly (m, n); None without any
    # Standard error of the log of each input limit (m,); infinite if never reached or absent
    limits: Array

    @property
    def deviations(self) -> Array:
        """Standard error of each entry of K (m, n)."""
        return _individual(self.gain)

    @property
    def narrower(self) -> Array:
        """Reduction of each standard error if one stated parameter were known (m, n, k)."""
        return 1 - np.sqrt(np.maximum(1 - np.array(self.gain.shares), 0.0))


@checked
def expected_intervals(
    problem: Problem,
    gain: ArrayLike,
    deviation: ArrayLike,
    *,
    metric: ArrayLike | None = None,
    root: float = 0.0,
) -> Expectation:
    """Compute the standard errors that a fit of planned recordings would have.

    Parameters
    ----------
    problem : Problem
        Problem whose recordings are noise-free simulations of the assumed subject.
    gain : array_like of shape (m, n)
        Gain K of that subject.
    deviation : float or array_like of shape (p,)
        Standard deviation of the recording noise, in output units.
    metric : array_like of shape (m, m), optional
        Metric S; by default the identity. Irrelevant with one input.
    root : float, default 0
        Correlation of the noise from one sample to the next (first-order autoregression); 0 for
        white.

    Returns
    -------
    Expectation
        Standard errors of the gain and of the input limits.

    Raises
    ------
    InputError
        If a deviation is not positive, root is not in [0, 0.999], or the metric is not positive
        definite.

    Examples
    --------
    >>> import control
    >>> import impc
    >>> plant = impc.Plant(control.ss([[1.1]], [[1]], [[1]], 0, 1))
    >>> bounds = impc.Bounds(plant, u_min=-0.5, u_max=0.5)
    >>> law = impc.Controller(plant, impc.Weights(1, 1), bounds, horizon=3)
    >>> trial = impc.Recording(plant, law.simulate([1.0], steps=30).x)
    >>> problem = impc.Problem(plant, bounds, 3, [trial])
    >>> found = impc.expected_intervals(problem, law.K, 0.01)
    >>> round(float(found.deviations[0, 0]), 3)
    0.012
    """
    plant, p = problem.plant, len(problem.plant.outputs)
    given = np.asarray(deviation, dtype=np.float64)
    size = np.full(p, given) if given.ndim == 0 else with_shape("deviation", given, (p,))
    if not np.all((size > 1e-50) & (size < 1e50)):
        raise InputError(
            "deviation", f"expected positive noise SDs, got {size}", "pass one per output"
        )
    if not 0 <= root <= _LARGEST_ROOT:
        raise InputError(
            "root", f"expected 0 <= root <= {_LARGEST_ROOT}, got {root:g}", "pass 0 for white noise"
        )
    colour = ResidualNoise(frozen(np.full(p, root)), frozen((1 - root**2) * np.eye(p)[None]))
    bounds, horizon = problem.bounds, problem.horizon
    law = Controller.from_gain(plant, gain, bounds, horizon, metric=metric, terminal_set=False)
    K, S = np.array(law.K), np.array(law.S)

    def found(problem: Problem, trials: float = 1.0) -> GainCovariance:
        # In units of the noise: its variance is one.
        scaled = replace(problem, output_scale=size / np.sqrt(trials))
        return gain_covariance(scaled, K, S, lambda *_: colour, curvature=True, scale=1.0)

    fixed, by_trials = problem.with_body_fixed(), {one: found(problem, one) for one in MULTIPLES}
    return Expectation(
        by_trials[1.0],
        frozen(list(map(_individual, by_trials.values()))),
        None if fixed is problem else frozen(_individual(found(fixed))),
        frozen(_limits(replace(problem, output_scale=size), K, S, colour)),
    )


def _individual(found: GainCovariance) -> Array:
    """Standard error of each entry; infinite if not individually identified."""
    return np.where(found.individually_identified, found.entries, np.inf)


def _limits(problem: Problem, K: Array, S: Array, colour: ResidualNoise) -> Array:
    """Standard errors of the log limits without their own prior."""
    at, count, found = slopes_at(problem, K, S, 1.0), K.size, np.full(len(S), np.inf)
    on_law = [np.array(at.on_law[:, :count]), identified_metric(np.array(at.on_law[:, count:]))]
    rows = bound_rows(problem.bounds, problem.plant)
    for control, limit in enumerate(np.array(problem.bounds.u_max)):
        if not np.isfinite(limit):
            continue
        column = np.zeros((len(at.residual), 1))
        moves = rows.along_limit(control)[:, None]
        column[problem.recorded_rows] = along_bounds(problem, K, S, moves)
        family = problem.family
        own = [k for k, of in family.limits(problem.plant) if of == control] if family else []
        rest = np.delete(np.array(at.on_parameters), own, axis=1)
        seen = at.span(*on_law, rest).without(column)
        size = float(seen[:, 0] @ seen[:, 0])
        if size > _UNSEEN * len(column):
            found[control] = np.sqrt(at.spread(colour, seen / size)[0, 0])
    return found
