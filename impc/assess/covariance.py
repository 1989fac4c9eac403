"""How far a fitted gain is determined: standard deviations under noise of any colour.

To first order a least-squares estimate under stationary noise e_t has the covariance (White 1980,
Newey and West 1987: the "sandwich", here with a Jacobian that is known; docs/fitting.md)

    H^-1 cov( sum_t J_t' e_t ) H^-1,     H = sum_t J_t' J_t,

J_t being the derivative of the outputs at sample t with respect to everything that was fitted, and
the middle as `residual_noise` estimates it from the residuals. With white noise it is the
Cramér-Rao bound.

Beside the gain everything else that was fitted is unknown: initial states, physical parameters
and, for several inputs, the metric S, which is independent of the gain. The prior of a search
(`fit_gain`) is left out: the result says what the recordings determine, and in a direction that
they hardly do it is wide. What has a stated uncertainty keeps its prior, as rows below those that
were recorded, J_0 = s / deviation with white noise s of their own (docs/fitting.md).

To first order a direction that is not identified has no part in those that are; to second order it
has, and it may be wrong by as much as a gain can be. `curvature` adds that (docs/fitting.md).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, BoolArray, Frozen, frozen
from impc.assess.long_run_covariance import ResidualNoise, residual_noise, spread_of_sum
from impc.inverse.coordinates import metric_directions
from impc.inverse.estimates import DETERMINED, determined
from impc.inverse.least_squares import trial_span
from impc.inverse.problem import noise_of_residual
from impc.inverse.residuals import evaluate, residual_only, residual_or_reason, with_prior_rows
from impc.inverse.solution_set import natural_coordinates

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.inverse.least_squares import TrialSpan
    from impc.inverse.problem import Problem
    from impc.inverse.residuals import Evaluation

#: A direction with a larger deviation, of the natural size of a gain, is not identified: there the
#: prior
#: of a search and the curvature of the problem count beside the recordings.
IDENTIFIED = 0.2
#: An entry is individually identified when what is not identified could move it by less than this
#: share of its
#: deviation, were it wrong by the natural size of a gain. Of 275 intervals of carts with three
#: inputs (VAF 70 %) for which that share was .2 to .25, and not in the deviation, 90 % held.
FOREIGN = 0.2
#: An interval of 95 % of a normal number is so many deviations on either side.
TWO_SIDED = 1.959964
# Of an entry's natural size: a smaller share in a direction is rounding's.
_SHARE = 1e-6
_SEEN = 1e-10
_STEPS = (1.0, 0.5, 0.25, 0.125)


@dataclass(frozen=True)
class GainCovariance(Frozen):
    """What the recordings say of the gain at a fit.

    Directions are of the gain in natural coordinates, G^-1 K T with x = T z and u = G v, row by row
    (`gain_fibre`): a step of 1 moves the command by one unit of the white input noise that T stands
    for. No optimal gain is far beyond 1 on this scale.
    """

    T: Array  # Natural coordinates of states (n, n) and inputs (m, m)
    G: Array
    # Of the scaled residual's derivative with respect to G^-1 K T, once everything else has taken
    # what it can; largest first (m * n,)
    singular_values: Array
    directions: Array  # Right singular vectors, one a row (m * n, m * n)
    # Standard deviation along each direction (m * n,); infinite below 1e-6 of the largest singular
    # value
    deviations: Array
    # Standard deviation of each entry of K (m, n), in its unit; infinite when a direction without a
    # value takes part in it
    entries: Array
    # What the directions that are not identified could move each entry by, were they wrong by the
    # natural size of a gain, over its deviation by those that are (m, n)
    foreign: Array
    parameters: Array  # Standard deviation of the logarithm of each physical parameter (k,)
    # Of the variance of each entry, what each parameter with a stated uncertainty causes (m, n, k)
    shares: Array
    noise: ResidualNoise  # The colour of the residuals
    spread: Array  # Covariance of steps along the directions with a finite deviation (k, k)

    def along(self, step: Array) -> Array:
        """A step of the gain (m, n) as steps along the directions (m * n,)."""
        return np.asarray(self.directions @ np.ravel(np.linalg.solve(self.G, step @ self.T)))

    def combinations(self, rows: Array) -> tuple[Array, Array]:
        """Standard deviations of linear combinations of the entries, and what is foreign (k,).

        `rows` (k, m * n): factors of the entries of K, row by row. As `entries` and `foreign`.
        """
        back = rows @ np.kron(self.G, np.linalg.inv(self.T).T) @ self.directions.T
        return _entries(back, self.deviations, self.spread)

    @property
    def identified(self) -> BoolArray:
        """Which directions the recordings identify (m * n,)."""
        return np.asarray(self.deviations < IDENTIFIED)

    @property
    def individually_identified(self) -> BoolArray:
        """Which entries of K they identify individually, not only with others (m, n)."""
        return np.asarray(self.foreign < FOREIGN)


def gain_covariance(
    problem: Problem,
    gain: Array,
    metric: Array,
    noise: Callable[[list[Array], TrialSpan], ResidualNoise] = residual_noise,
    *,
    curvature: bool = False,
    evaluation: Evaluation | None = None,
    scale: float | None = None,
) -> GainCovariance:
    """Covariance of a gain fitted by least squares, and of the parameters fitted with it.

    The `scale` is the deviation of the noise, that of the residual if omitted.
    """
    m, n = problem.plant.m, problem.plant.n
    T, G = natural_coordinates(problem.plant, gain)
    found = evaluation or evaluate(problem, gain, metric)
    rows = len(found.residual)
    scale = noise_of_residual(problem, found.residual) if scale is None else scale
    found = with_prior_rows(problem, found, scale)
    in_units = np.kron(G, np.linalg.inv(T).T)
    on_gain = found.dK.reshape(-1, m * n) @ in_units
    metric_columns = _identified_metric(found.along_metric(metric, metric_directions(metric)))
    # What the rest can explain is taken out of the gain's columns; the gain's
    # block of the inverse of H is that of what is left.
    rest = _span(problem, found, metric_columns, found.dparameters)
    others = _span(problem, found, on_gain, metric_columns)
    seen = rest.without(on_gain)
    _, values, directions = np.linalg.svd(seen, full_matrices=False)
    usable = determined(problem, values)
    unit = seen @ directions[usable].T / values[usable]
    fitted = rest.plus(unit).upper(len(problem.recordings), rows)
    colour = noise(by_trial(problem, found.residual), fitted)
    spread = spread_of_rows(problem, colour, unit / values[usable], scale)
    deviations = np.full(m * n, np.inf)
    deviations[usable] = np.sqrt(np.maximum(np.diag(spread), 0.0))
    if curvature:
        identified = np.flatnonzero(deviations < IDENTIFIED)
        reach = np.minimum(deviations, 1.0)[:, None] * directions
        unidentified = reach[deviations >= IDENTIFIED]
        shifts = _shifts(problem, gain, metric, (unidentified @ in_units.T).reshape(-1, m, n))
        shifts = shifts @ unit[:rows, identified] / values[identified]
        spread[np.ix_(identified, identified)] += shifts.T @ shifts / 2
        deviations[usable] = np.sqrt(np.maximum(np.diag(spread), 0.0))
    entries, foreign = _entries(in_units @ directions.T, deviations, spread)
    shares = np.zeros((m * n, 0))
    if np.any(problem.stated):
        known = directions[deviations < IDENTIFIED]
        seen = np.hstack([on_gain @ known.T, found.dparameters])
        along = _span(problem, found, metric_columns).without(seen)
        shares = _shares(along, in_units @ known.T)[:, problem.stated]
    return GainCovariance(
        frozen(T),
        frozen(G),
        frozen(values),
        frozen(directions),
        frozen(deviations),
        frozen(entries.reshape(m, n)),
        frozen(foreign.reshape(m, n)),
        frozen(_parameter_deviations(problem, found.dparameters, others, colour, scale)),
        frozen(shares.reshape(m, n, shares.shape[1])),
        colour,
        frozen(spread),
    )


def spread_of_rows(problem: Problem, noise: ResidualNoise, columns: Array, scale: float) -> Array:
    """Covariance of columns' e (k, k): noise of its colour, and white of `scale` in prior rows."""
    below = columns[sum(problem.trial_sizes) :]
    return spread_of_sum(noise, by_trial(problem, columns)) + scale**2 * below.T @ below


def _shares(along: Array, back: Array) -> Array:
    """Share of each parameter in the variance of each entry (entries, k), for white noise.

    `along` (r, d + k) are derivatives along d directions of the gain and by k parameters; `back`
    (entries, d). By how much the variance would fall, were that parameter known, all others as they
    are.
    """
    size, d = np.linalg.norm(along, axis=0), back.shape[1]
    size[size == 0] = 1.0
    inverse = np.linalg.pinv(np.linalg.qr(along / size, mode="r")) / size[:, None]
    whole = inverse @ inverse.T
    together = (back @ whole[:d, d:]) ** 2
    scale = np.outer(np.diag(back @ whole[:d, :d] @ back.T), np.diag(whole)[d:])
    return np.asarray(np.divide(together, scale, out=np.zeros_like(scale), where=scale > 0))


def _shifts(problem: Problem, gain: Array, metric: Array, steps: Array) -> Array:
    """What steps of the gain (k, m, n), forth and back, do to the residual (2 k, r).

    A step that cannot be simulated is halved, and what it does scaled by the square: the first
    order of a step that is not identified has no part in those that are.
    """
    here, shifts = residual_only(problem, gain, metric), []
    for index, sign in itertools.product(range(len(steps)), (1.0, -1.0)):
        for share in _STEPS:
            moved, reason = residual_or_reason(problem, gain + sign * share * steps[index], metric)
            if not reason:
                shifts.append((moved - here) / share**2)
                break
    return np.array(shifts).reshape(-1, len(here))


def _entries(back: Array, deviations: Array, spread: Array) -> tuple[Array, Array]:
    """Deviations of the entries, and the share in each of what is not identified."""
    usable, identified = np.isfinite(deviations), deviations < IDENTIFIED
    own = spread[np.ix_(identified[usable], identified[usable])]
    by_itself = np.sqrt(np.maximum(np.diag(back[:, identified] @ own @ back[:, identified].T), 0.0))
    size = np.linalg.norm(back, axis=1)
    unidentified = np.linalg.norm(back[:, ~identified], axis=1)
    unidentified[unidentified <= _SHARE * size] = 0.0
    foreign = np.divide(
        unidentified, by_itself, out=np.full(len(back), np.inf), where=by_itself > 0
    )
    whole = np.sqrt(np.maximum(np.diag(back[:, usable] @ spread @ back[:, usable].T), 0.0))
    whole[np.linalg.norm(back[:, ~usable], axis=1) > _SHARE * size] = np.inf
    return np.where(foreign < FOREIGN, np.hypot(by_itself, unidentified), whole), foreign


def by_trial(problem: Problem, rows: Array) -> list[Array]:
    """The `rows` (r, ...) of all trials as one (samples, q, ...) array a trial; none below."""
    q, ends = len(problem.measured), np.cumsum(problem.trial_sizes)
    parts = np.split(rows, ends)[:-1]
    return [part.reshape(len(part) // q, q, *rows.shape[1:]) for part in parts]


def _identified_metric(alone: Array) -> Array:
    """Columns of what is identified of S `alone` (r, k)."""
    metric, sizes, _ = np.linalg.svd(alone, full_matrices=False)
    # Rounding leaves 1e-15 where S is not identified: inputs that are never at a bound.
    return np.asarray(metric[:, sizes > _SEEN * np.max(sizes, initial=0.0)])


def _span(problem: Problem, found: Evaluation, *shared: Array) -> TrialSpan:
    """What initial states and the columns `shared` can explain."""
    return trial_span(found.own, problem.row_sizes, np.hstack(shared))


def _parameter_deviations(
    problem: Problem, own: Array, others: TrialSpan, colour: ResidualNoise, scale: float
) -> Array:
    """Standard deviations of the logarithms (derivatives `own`), all else being fitted too."""
    count = own.shape[1]
    if count == 0:
        return np.zeros(0)
    seen = others.without(own)
    _, values, directions = np.linalg.svd(seen, full_matrices=False)
    if values[-1] <= DETERMINED * np.linalg.norm(own, 2):
        return np.full(count, np.inf)
    along = seen @ directions.T / values**2 @ directions
    spread = spread_of_rows(problem, colour, along, scale)
    return np.sqrt(np.maximum(np.diag(spread), 0.0))
