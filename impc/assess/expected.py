"""What recordings would identify that nobody has made yet: intervals before anyone is measured.

A presumed subject is simulated, and the recordings are taken as they come out without noise. At the
truth the residual is then zero, and the derivatives of the outputs are those of the recordings to
come. With noise of known size and colour, e_t in the recorder, they give the deviations of gain
and cost weights as `covariance` and `structured_weights` have them, and the misfit that grows away
from the truth gives the ends of profiles:

    D(v) = (m^2(v) - m^2(v*)) / (s^2 f),      m(v*) = 0

which is the profile of the recordings on average, up to the count of what is fitted
(docs/planning.md). What has a stated uncertainty keeps it, as a prior in both; deviations for a
body that is known better, or for less noise, follow from the same derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.special

from impc.arrays import Array, Frozen, finite_array, frozen, with_shape
from impc.assess.covariance import GainCovariance, gain_covariance
from impc.assess.input_limits import on_limit
from impc.assess.long_run_covariance import ResidualNoise
from impc.assess.printed_gain import LEVEL
from impc.assess.structured_weights import WeightCovariance, tangent, weight_covariance
from impc.assess.weight_profiles import WeightInterval, WeightProfiles
from impc.checking import checked, replace
from impc.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from impc.assess.structured_weights import Tangent
    from impc.inverse.problem import Problem

# A root nearer to one is a drift, not noise.
_LARGEST_ROOT = 0.999
# Of all outputs: a limit that moves them by less is never met.
_UNSEEN = 1e-12
# Of the noise, what is left of it by ten times as many trials, and by more than will ever be made.
_TENFOLD, _NO_NOISE = 10**-0.5, 1e-2
#: Multiples of the planned trials for which standard errors are computed.
MULTIPLES = (0.25, 0.5, 1.0, 2.0, 4.0, 10.0)


@dataclass(frozen=True)
class BodyShare(Frozen):
    """What the stated uncertainty of the body adds to the deviations of unknowns (count,)."""

    exact: Array  # The deviations, were all that is stated known exactly
    tenfold: Array  # With ten times as many trials
    floor: Array  # With ten thousand times as many: what no number of trials removes
    names: tuple[str, ...]  # Parameters with a stated uncertainty (k,)
    measured: Array  # Were one of them known exactly, all others as stated (k, count)


@dataclass(frozen=True)
class Expectation(Frozen):
    """What the recordings of a problem would identify."""

    cost_weights: WeightCovariance  # Of the unknowns of the structure, to first order
    # Of each unknown, by its profile; by its deviation where products of features have cost weights
    intervals: tuple[WeightInterval, ...]
    # Of a gain that is fitted without a structure, to second order as a fit prints it
    gain: GainCovariance
    # Standard deviation of the logarithm of the limit of each input (m,), with a free gain;
    # infinite where it is never met, or the input has none
    limits: Array
    body: BodyShare | None  # None where no uncertainty is stated
    # Standard deviations with so many times the trials (multiples, count)
    by_trials: Array

    @property
    def deviations(self) -> Array:
        """Standard deviation of each unknown of the structure (count,), to first order."""
        return np.asarray(self.cost_weights.each)

    def narrower(self, deviations: Array) -> Array:
        """Share by which other deviations (..., count) are less; 0 where there is none to begin."""
        planned, other = np.broadcast_arrays(self.deviations, deviations)
        kept = np.ones(other.shape)
        return np.asarray(1 - np.divide(other, planned, out=kept, where=np.isfinite(planned)))

    @property
    def log_determinant(self) -> float:
        """Of the unknowns' covariance, infinite if one is not identified: least where D-optimal."""
        if not np.all(np.isfinite(self.cost_weights.deviations)):
            return np.inf
        return 2 * float(np.sum(np.log(self.cost_weights.deviations)))

    @property
    def mean_variance(self) -> float:
        """Of the unknowns: the least is A-optimal."""
        return float(np.mean(self.deviations**2))


@checked
def expected_intervals(
    problem: Problem,
    cost_weights: ArrayLike,
    deviation: ArrayLike,
    *,
    root: float = 0.0,
) -> Expectation:
    """Intervals that a fit of such recordings would have.

    Parameters
    ----------
    problem : Problem
        Its recordings are those of the presumed subject, without noise; with a structure.
    cost_weights : array_like
        The subject's unknowns of that structure (count,), logarithms of cost weights.
    deviation : array_like
        Standard deviation of the noise in the recorder, in the outputs' units, one or (p,).
    root : float
        Of first-order noise: its correlation from one sample to the next, 0 for white.

    Raises
    ------
    InputError
        When the problem has no structure, a deviation is not positive, or a root is not in [0, 1).

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
        raise InputError("structure", "the problem has none", "give Problem(..., structure=...)")
    given = np.asarray(deviation, dtype=np.float64)
    size = np.full(p, given) if given.ndim == 0 else with_shape("deviation", given, (p,))
    if not np.all((size > 1e-50) & (size < 1e50)):
        raise InputError("deviation", f"got {size}", "give a positive noise for each output")
    if not 0 <= root <= _LARGEST_ROOT:
        raise InputError("root", f"got {root:g}", f"give 0 or more, at most {_LARGEST_ROOT}")
    coloured = ResidualNoise(frozen(np.full(p, root)), frozen((1 - root**2) * np.eye(p)[None]))
    plain = ResidualNoise(frozen(np.zeros(p)), frozen(np.eye(p)[None]))
    # In units of the noise, so that its variance is one.
    scaled = replace(problem, output_scale=size)
    unknowns = finite_array("cost_weights", cost_weights, (structure.count,))
    at = tangent(structure, scaled, unknowns, noise=1.0)
    found = weight_covariance(at, lambda _trials, _lost: coloured, lambda _trials, _lost: plain)
    K, S = np.array(at.solution.K), np.array(at.solution.S)
    return Expectation(
        found,
        _intervals(at, found),
        gain_covariance(scaled, K, S, lambda _trials, _lost: coloured, curvature=True, scale=1.0),
        frozen(_limits(at, coloured)),
        _body_share(at, coloured),
        frozen([_deviations(at, coloured, noise=times**-0.5) for times in MULTIPLES]),
    )


def _deviations(at: Tangent, colour: ResidualNoise, *known: int, noise: float = 1.0) -> Array:
    """Standard deviations of the unknowns with parameters that are `known`, or less `noise`."""
    slopes = np.delete(np.array(at.on_parameters), known, axis=1)
    # The rows of a prior are in units of the noise.
    slopes[sum(at.problem.trial_sizes) :] *= noise
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


def _intervals(at: Tangent, found: WeightCovariance) -> tuple[WeightInterval, ...]:
    rows = np.eye(at.structure.count)
    if not at.structure.coupled:
        profiles = WeightProfiles(at, found)
        return tuple(profiles.interval(row) for row in rows)
    ends = -scipy.special.ndtri((1 - LEVEL) / 2) * np.asarray(found.each)
    values = np.asarray(found.values)
    return tuple(
        WeightInterval(float(value), float(value - end), float(value + end), LEVEL)
        for value, end in zip(values, ends, strict=True)
    )


def _limits(at: Tangent, colour: ResidualNoise) -> Array:
    """Deviations of the logarithms without their own prior, all else and a free gain fitted."""
    problem, found = at.problem, np.full(at.problem.plant.m, np.inf)
    K, S = np.array(at.solution.K), np.array(at.solution.S)
    for control, limit in enumerate(np.array(problem.bounds.u_max)):
        if not np.isfinite(limit):
            continue
        column = np.zeros(len(at.residual))
        column[: sum(problem.trial_sizes)] = limit * on_limit(problem, K, S, limit, control)
        family = problem.family
        own = [k for k, of in family.limits(problem.plant) if of == control] if family else []
        rest = frozen(np.delete(np.array(at.on_parameters), own, axis=1))
        seen = replace(at, on_parameters=rest).without_nuisance(column[:, None], *at.gain_columns())
        size = float(seen[:, 0] @ seen[:, 0])
        if size > _UNSEEN * len(column):
            spread = at.spread(colour, seen / size)
            found[control] = np.sqrt(spread[0, 0])
    return found
