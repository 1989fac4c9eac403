"""Expected interval widths of a planned experiment.

An assumed subject is simulated without noise. At the truth the residual is then zero, and the
derivatives of the outputs are those of the future recordings. With recording noise e_t of known
size and autocorrelation they give standard errors of gain and cost weights (`covariance`,
`structured_weights`), and the growth of the misfit away from the truth gives profile intervals:

    D(v) = (m^2(v) - m^2(v*)) / (s^2 f),      m(v*) = 0

which is the average profile of such recordings up to the number of fitted quantities
(docs/howto/plan.md). Stated uncertainties enter as priors; standard errors for a better-known body
or less noise follow from the same derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, finite_array, frozen, with_shape
from impc.assess.covariance import GainCovariance, gain_covariance
from impc.assess.long_run_covariance import ResidualNoise
from impc.assess.structured_weights import WeightCovariance, tangent, weight_covariance
from impc.assess.weight_profiles import WeightInterval, WeightProfiles
from impc.checking import checked, replace
from impc.errors import InputError
from impc.inverse.residuals import along_bounds
from impc.model.bounds import bound_rows

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from impc.assess.structured_weights import Tangent
    from impc.inverse.problem import Problem

# A larger coefficient is a drift, not noise.
_LARGEST_ROOT = 0.999
# Relative change of the outputs below which a limit counts as never reached.
_UNSEEN = 1e-12
# Noise relative to the plan, for ten times the trials and for practically infinitely many.
_TENFOLD, _NO_NOISE = 10**-0.5, 1e-2
#: Multiples of the planned trials for which standard errors are computed.
MULTIPLES = (0.25, 0.5, 1.0, 2.0, 4.0, 10.0)


@dataclass(frozen=True)
class BodyShare(Frozen):
    """Contribution of the stated uncertainty of the body to the standard errors (count,)."""

    exact: Array  # Standard errors if all stated parameters were known exactly
    tenfold: Array  # With ten times as many trials
    floor: Array  # With ten thousand times as many trials: the limit that trials cannot lower
    names: tuple[str, ...]  # Parameters with a stated uncertainty (k,)
    measured: Array  # With one of them known exactly, the others as stated (k, count)


@dataclass(frozen=True)
class Expectation(Frozen):
    """Expected precision of the fit of a problem."""

    cost_weights: WeightCovariance  # For the unknowns of the structure, to first order
    # For each unknown: profile, or normal if products of features have cost weights
    intervals: tuple[WeightInterval, ...]
    # For a gain fitted without a structure, to second order as reported by a fit
    gain: GainCovariance
    # Standard error of the log of each input limit (m,), with a free gain; infinite if never
    # reached or absent
    limits: Array
    body: BodyShare | None  # None without stated uncertainties
    # Standard errors with multiples of the trials (multiples, count)
    by_trials: Array

    @property
    def deviations(self) -> Array:
        """Standard error of each unknown of the structure (count,), to first order."""
        return np.asarray(self.cost_weights.each)

    def narrower(self, deviations: Array) -> Array:
        """Relative reduction by other standard errors (..., count); 0 if infinite now."""
        planned, other = np.broadcast_arrays(self.deviations, deviations)
        kept = np.ones(other.shape)
        return np.asarray(1 - np.divide(other, planned, out=kept, where=np.isfinite(planned)))

    @property
    def log_determinant(self) -> float:
        """Log determinant of the covariance of the unknowns (D-optimality), or infinity."""
        if not np.all(np.isfinite(self.cost_weights.deviations)):
            return np.inf
        return 2 * float(np.sum(np.log(self.cost_weights.deviations)))

    @property
    def mean_variance(self) -> float:
        """Mean variance of the unknowns (A-optimality)."""
        return float(np.mean(self.deviations**2))


@checked
def expected_intervals(
    problem: Problem,
    cost_weights: ArrayLike,
    deviation: ArrayLike,
    *,
    root: float = 0.0,
) -> Expectation:
    """Compute the intervals that a fit of planned recordings would have.

    Parameters
    ----------
    problem : Problem
        Problem with a structure; its recordings are noise-free simulations of the assumed subject.
    cost_weights : array_like of shape (count,)
        Unknowns of the structure for that subject: logarithms of the cost weights.
    deviation : float or array_like of shape (p,)
        Standard deviation of the recording noise, in output units.
    root : float, default 0
        Correlation of the noise from one sample to the next (first-order autoregression); 0 for
        white.

    Returns
    -------
    Expectation
        Standard errors and intervals of the cost weights, the gain and the input limits.

    Raises
    ------
    InputError
        If the problem has no structure, a deviation is not positive, or root is not in [0, 0.999].

    Examples
    --------
    >>> import control
    >>> import numpy as np
    >>> import impc
    >>> plant = impc.Plant(control.ss([[1.1]], [[1]], [[1]], 0, 1))
    >>> bounds = impc.Bounds(plant, u_min=-0.5, u_max=0.5)
    >>> structure = impc.Structure(plant, "diagonal")
    >>> law = impc.Controller(plant, structure.weights([0.0]), bounds, horizon=3)
    >>> trial = impc.Recording(plant, law.simulate([1.0], steps=30).x)
    >>> problem = impc.Problem(plant, bounds, 3, [trial], structure=structure)
    >>> found = impc.expected_intervals(problem, [0.0], 0.01)
    >>> round(float(found.deviations[0]), 2)
    0.07
    """
    structure, p = problem.structure, len(problem.plant.outputs)
    if structure is None:
        raise InputError(
            "structure", "the problem has no structure", "pass Problem(..., structure=...)"
        )
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
    coloured = ResidualNoise(frozen(np.full(p, root)), frozen((1 - root**2) * np.eye(p)[None]))
    plain = ResidualNoise(frozen(np.zeros(p)), frozen(np.eye(p)[None]))
    # In units of the noise: its variance is one.
    scaled = replace(problem, output_scale=size)
    unknowns = finite_array("cost_weights", cost_weights, (structure.count,))
    at = tangent(structure, scaled, unknowns, noise=1.0)
    found = weight_covariance(at, lambda _trials, _lost: coloured, lambda _trials, _lost: plain)
    K, S = np.array(at.solution.K), np.array(at.solution.S)
    return Expectation(
        found,
        WeightProfiles(at, found).unknowns(),
        gain_covariance(scaled, K, S, lambda _trials, _lost: coloured, curvature=True, scale=1.0),
        frozen(_limits(at, coloured)),
        _body_share(at, coloured),
        frozen([_deviations(at, coloured, noise=times**-0.5) for times in MULTIPLES]),
    )


def _deviations(at: Tangent, colour: ResidualNoise, *known: int, noise: float = 1.0) -> Array:
    """Standard errors of the unknowns with parameters `known`, or with less `noise`."""
    slopes = np.delete(np.array(at.on_parameters), known, axis=1)
    # Prior rows are in units of the noise.
    slopes[~at.problem.recorded_rows] *= noise
    less = replace(at, on_parameters=frozen(slopes))
    found = weight_covariance(less, lambda *_: colour, lambda *_: colour)
    return noise * np.asarray(found.each)


def _body_share(at: Tangent, colour: ResidualNoise) -> BodyShare | None:
    names = at.problem.parameter_names
    places = [int(place) for place in np.flatnonzero(at.problem.stated)]
    if not places:
        return None

    return BodyShare(
        frozen(_deviations(at, colour, *places)),
        frozen(_deviations(at, colour, noise=_TENFOLD)),
        frozen(_deviations(at, colour, noise=_NO_NOISE)),
        tuple(names[place] for place in places),
        frozen([_deviations(at, colour, place) for place in places]),
    )


def _limits(at: Tangent, colour: ResidualNoise) -> Array:
    """Standard errors of the log limits without their own prior, with a free gain."""
    problem, found = at.problem, np.full(at.problem.plant.m, np.inf)
    K, S = np.array(at.solution.K), np.array(at.solution.S)
    rows = bound_rows(problem.bounds, problem.plant)
    for control, limit in enumerate(np.array(problem.bounds.u_max)):
        if not np.isfinite(limit):
            continue
        column = np.zeros(len(at.residual))
        moves = rows.along_limit(control)[:, None]
        column[problem.recorded_rows] = along_bounds(problem, K, S, moves)[:, 0]
        family = problem.family
        own = [k for k, of in family.limits(problem.plant) if of == control] if family else []
        rest = frozen(np.delete(np.array(at.on_parameters), own, axis=1))
        seen = replace(at, on_parameters=rest).without_nuisance(
            column[:, None], np.array(at.on_law)
        )
        size = float(seen[:, 0] @ seen[:, 0])
        if size > _UNSEEN * len(column):
            spread = at.spread(colour, seen / size)
            found[control] = np.sqrt(spread[0, 0])
    return found
