"""Covariance of a fitted gain under autocorrelated noise (sandwich estimator).

To first order a least-squares estimate under stationary noise e_t has the covariance (White 1980,
Newey and West 1987: HAC or "sandwich"; docs/why/intervals.md)

    H^-1 cov( sum_t J_t' e_t ) H^-1,     H = sum_t J_t' J_t,

where J_t is the derivative of the outputs at sample t by all fitted quantities, and the middle is
estimated from the residuals by `residual_noise`. With white noise it is the Cramér-Rao bound.

Fitted with the gain are initial states, physical parameters and, with several inputs, the metric S.
The prior of the search (`fit_gain`) is left out, so that unidentified directions have wide
intervals. Parameters with a stated uncertainty keep their prior as further rows
J_0 = s / SD with white noise s.

To first order unidentified directions do not affect the identified ones; `curvature` adds their
second-order effect, with errors up to one whitened unit.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from impc.arrays import Array, BoolArray, Frozen, frozen
from impc.assess.long_run_covariance import ResidualNoise, residual_noise, spread_of_sum
from impc.inverse.columns import TrialSpan, trial_span
from impc.inverse.estimates import DETERMINED, determined
from impc.inverse.laws import GainLaw
from impc.inverse.problem import Problem, noise_of_residual
from impc.inverse.refit import IDENTIFIED
from impc.inverse.residuals import residual_only, residual_or_reason
from impc.inverse.unknowns import linear_at
from impc.model.signal_errors import SHIFT

#: Model of the residuals of each trial, given the span of the fitted columns.
NoiseModel = Callable[[list[Array], "TrialSpan"], ResidualNoise]
#: An entry is individually identified if an error of one whitened unit in all unidentified
#: directions shifts it by less than this share of its standard error. At shares of 0.2 to 0.25, 90
#: % of 275 intervals covered the true value (carts with three inputs, VAF 70 %).
FOREIGN = 0.2
#: Half width of a 95 % normal interval in standard errors.
TWO_SIDED = 1.959964
# Share of the norm of an entry in a direction, below which it is rounding.
_SHARE = 1e-6
_SEEN = 1e-10
_STEPS = (1.0, 0.5, 0.25, 0.125)
# Largest number of trials whose time shifts have standard errors: each adds a column.
_MOST_TRIALS = 12


@dataclass(frozen=True)
class GainCovariance(Frozen):
    """Covariance of the gain at a fit.

    Directions are those of the gain in whitened coordinates, G^-1 K T with x = T z and u = G v, row
    by row (`gain_fibre`): a unit step moves the command by one SD of the white input noise that
    defines T. Optimal gains are of order 1 on this scale.
    """

    T: Array  # Whitened coordinates of states (n, n) and inputs (m, m)
    G: Array
    # Of the derivative by G^-1 K T after projection on all other unknowns, largest first (m * n,)
    singular_values: Array
    directions: Array  # Right singular vectors, one a row (m * n, m * n)
    # Standard error along each direction (m * n,); infinite below 1e-6 of the largest singular
    # value
    deviations: Array
    # Standard error of each entry of K (m, n), in its unit; infinite if a direction without a value
    # contributes
    entries: Array
    # Shift of each entry by an error of one whitened unit in all unidentified directions, over its
    # standard error from the identified ones (m, n)
    foreign: Array
    parameters: Array  # Standard error of the log of each parameter (k,)
    # Share of the variance of each entry due to each parameter with a stated uncertainty (m, n, k)
    shares: Array
    noise: ResidualNoise  # Autocorrelation model of the residuals
    spread: Array  # Covariance of steps along directions with a finite value (k, k)
    # Standard error of each fitted time shift, in samples (shifts, trials); empty for many trials
    shifts: Array
    # Long-run over white variance of the residuals along identified directions (median)
    colour: float

    def along(self, step: Array) -> Array:
        """Coordinates of a gain step (m, n) along the directions (m * n,)."""
        return np.asarray(self.directions @ np.ravel(np.linalg.solve(self.G, step @ self.T)))

    def combinations(self, rows: Array) -> tuple[Array, Array]:
        """Standard errors (k,) of combinations `rows` (k, m * n) of entries, and `foreign`."""
        back = rows @ np.kron(self.G, np.linalg.inv(self.T).T) @ self.directions.T
        return _entries(back, self.deviations, self.spread)

    @property
    def identified(self) -> BoolArray:
        """Mask of the identified directions (m * n,)."""
        return np.asarray(self.deviations < IDENTIFIED)

    @property
    def individually_identified(self) -> BoolArray:
        """Mask of the individually identified entries of K (m, n)."""
        return np.asarray(self.foreign < FOREIGN)


@dataclass(frozen=True)
class Slopes(Frozen):
    """Residual of a fit and its derivatives, all trials, rows of stated parameters last."""

    problem: Problem  # At the fitted values
    noise: float  # Noise SD; from recordings, the RMS residual
    reason: str  # Why a simulation stopped; empty if all trials are complete
    residual: Array  # (r,)
    law: GainLaw  # At the fitted gain and metric
    on_law: Array  # By whitened gain and metric (r, c), by parameters, by initial states and errors
    on_parameters: Array
    own: Array

    def span(self, *shared: Array) -> TrialSpan:
        """Span of initial states, errors and columns `shared` (r, k)."""
        return trial_span(self.own, self.problem.row_sizes, np.hstack(shared))

    def colour(self, model: NoiseModel, fitted: TrialSpan) -> ResidualNoise:
        """Autocorrelation model of the residuals after a fit of the span."""
        residuals = by_trial(self.problem, np.array(self.residual))
        return model(residuals, fitted.recorded(self.problem))

    def spread(self, noise: ResidualNoise, columns: Array) -> Array:
        """Covariance (k, k) of columns' residual for this noise."""
        return spread_of_rows(self.problem, noise, columns, self.noise)

    def sandwich(self, seen: Array, rest: TrialSpan, model: NoiseModel) -> Sandwich:
        """Covariance of unknowns with derivatives `seen` (r, q) after projection on the `rest`."""
        _, values, directions = np.linalg.svd(seen, full_matrices=False)
        usable = determined(self.problem, values)
        unit = seen @ directions[usable].T / values[usable]
        noise = self.colour(model, rest.plus(unit))
        spread = self.spread(noise, unit / values[usable])
        return Sandwich(values, directions, usable, unit, noise, spread)


class Sandwich(NamedTuple):
    """Covariance of unknowns along directions."""

    values: Array  # Singular values of the derivative, largest first (a,), and directions (a, q)
    directions: Array
    usable: BoolArray  # Mask of the directions with a value (a,)
    unit: Array  # Orthonormal derivatives along these (r, k), and their covariance (k, k)
    noise: ResidualNoise
    spread: Array

    @property
    def deviations(self) -> Array:
        """Standard error along each direction (a,); infinite without a value."""
        found = np.full(len(self.values), np.inf)
        found[self.usable] = np.sqrt(np.maximum(np.diag(self.spread), 0.0))
        return found


def slopes_at(problem: Problem, gain: Array, metric: Array, noise: float | None = None) -> Slopes:
    """Residual and derivatives at a gain; `noise` is the noise SD, None that of the residual."""
    law = GainLaw(problem, gain, metric)
    found = linear_at(problem, law, law.start)
    noise = noise_of_residual(problem, found.residual) if noise is None else noise
    found = found.with_prior(problem, noise)
    parts = (frozen(part) for part in found.parts(problem))
    return Slopes(problem, noise, found.reason, frozen(found.residual), law, *parts)


def gain_covariance(
    problem: Problem,
    gain: Array,
    metric: Array,
    noise: NoiseModel = residual_noise,
    *,
    curvature: bool = False,
    scale: float | None = None,
) -> GainCovariance:
    """Covariance of a gain fitted by least squares, and of the parameters fitted with it.

    `scale` is the noise SD; None: that of the residual.
    """
    at, (m, n) = slopes_at(problem, gain, metric, scale), gain.shape
    on_gain, on_parameters = np.array(at.on_law[:, : m * n]), np.array(at.on_parameters)
    on_metric = identified_metric(at.on_law[:, m * n :])
    in_units = at.law.gains.reshape(m * n, m * n).T
    # Project the gain columns on the complement of the others: this gives the block of the inverse
    # of H.
    rest = at.span(on_metric, on_parameters)
    found = at.sandwich(rest.without(on_gain), rest, noise)
    ratios = np.diag(found.spread) * (found.values[found.usable] / at.noise) ** 2
    well = found.deviations[found.usable] < IDENTIFIED
    if curvature:
        found = _curved(at, gain, metric, in_units, found)
    directions, deviations = found.directions, found.deviations
    entries, foreign = _entries(in_units @ directions.T, deviations, found.spread)
    shares = np.zeros((m * n, 0))
    if np.any(problem.stated):
        known = directions[deviations < IDENTIFIED]
        along = at.span(on_metric).without(np.hstack([on_gain @ known.T, on_parameters]))
        shares = _shares(along, in_units @ known.T)[:, problem.stated]
    others = at.span(on_gain, on_metric)
    return GainCovariance(
        frozen(at.law.T),
        frozen(at.law.G),
        frozen(found.values),
        frozen(directions),
        frozen(deviations),
        frozen(entries.reshape(m, n)),
        frozen(foreign.reshape(m, n)),
        frozen(_standard_errors(at, on_parameters, others, found.noise)),
        frozen(shares.reshape(m, n, shares.shape[1])),
        found.noise,
        frozen(found.spread),
        frozen(_shift_deviations(at, [on_gain, on_metric, on_parameters], found.noise)),
        float(np.median(ratios[well])) if np.any(well) else 1.0,
    )


def _curved(at: Slopes, gain: Array, metric: Array, in_units: Array, found: Sandwich) -> Sandwich:
    """Add the second-order effect of unidentified directions on the identified ones."""
    deviations, spread = found.deviations, found.spread.copy()
    identified = np.flatnonzero(deviations < IDENTIFIED)
    reach = np.minimum(deviations, 1.0)[:, None] * found.directions
    steps = reach[deviations >= IDENTIFIED] @ in_units.T
    shifts = _shifts(at.problem, gain, metric, steps.reshape(-1, *gain.shape))
    along = found.unit[: shifts.shape[1], identified] / found.values[identified]
    spread[np.ix_(identified, identified)] += (shifts @ along).T @ (shifts @ along) / 2
    return found._replace(spread=spread)


def spread_of_rows(problem: Problem, noise: ResidualNoise, columns: Array, scale: float) -> Array:
    """Covariance of columns' e (k, k): coloured noise, white of SD `scale` in prior rows."""
    below = columns[~problem.recorded_rows]
    return spread_of_sum(noise, by_trial(problem, columns)) + scale**2 * below.T @ below


def _shares(along: Array, back: Array) -> Array:
    """Share of each parameter in the variance of each entry (entries, k), for white noise.

    By how much the variance would decrease if that parameter were known, the others unchanged.
    `along` (r, d + k): derivatives along d gain directions and by k parameters; `back` (entries,
    d).
    """
    size, d = np.linalg.norm(along, axis=0), back.shape[1]
    size[size == 0] = 1.0
    inverse = np.linalg.pinv(np.linalg.qr(along / size, mode="r")) / size[:, None]
    whole = inverse @ inverse.T
    together = (back @ whole[:d, d:]) ** 2
    scale = np.outer(np.diag(back @ whole[:d, :d] @ back.T), np.diag(whole)[d:])
    return np.asarray(np.divide(together, scale, out=np.zeros_like(scale), where=scale > 0))


def _shifts(problem: Problem, gain: Array, metric: Array, steps: Array) -> Array:
    """Change of the residual (2 k, r) by steps of the gain (k, m, n), both ways.

    A step that cannot be simulated is halved; its effect is scaled as second order.
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
    """Standard errors of the entries, and the relative shift by unidentified directions."""
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
    """Split `rows` (r, ...) into one (samples, q, ...) array per trial, prior rows dropped."""
    q, ends = len(problem.measured), np.cumsum(problem.trial_sizes)
    if len(rows) > ends[-1]:
        rows = rows[problem.recorded_rows]
    parts = np.split(rows, ends)[:-1]
    return [part.reshape(len(part) // q, q, *rows.shape[1:]) for part in parts]


def identified_metric(alone: Array) -> Array:
    """Orthonormal columns of the identified part of the metric `alone` (r, k)."""
    metric, sizes, _ = np.linalg.svd(alone, full_matrices=False)
    # Unidentified S (inputs that never saturate) leaves rounding of 1e-15.
    return np.asarray(metric[:, sizes > _SEEN * np.max(sizes, initial=0.0)])


def _shift_deviations(at: Slopes, shared: list[Array], noise: ResidualNoise) -> Array:
    """Standard errors of the time shifts (shifts, trials), all else fitted too."""
    problem, first = at.problem, at.problem.searched_states
    places = [k for k, (kind, _) in enumerate(problem.error_places, first) if kind == SHIFT]
    trials = len(problem.recordings)
    if not places or trials > _MOST_TRIALS:
        return np.zeros((len(places), 0))
    ends = np.cumsum(problem.row_sizes)[:trials]
    columns = np.zeros((len(at.own), len(places), trials))
    for trial, rows in enumerate(map(slice, [0, *ends[:-1]], ends)):
        columns[rows, :, trial] = at.own[rows, places]
    others = trial_span(np.delete(at.own, places, axis=1), problem.row_sizes, np.hstack(shared))
    found = _standard_errors(at, columns.reshape(len(columns), -1), others, noise)
    return found.reshape(len(places), trials)


def _standard_errors(at: Slopes, own: Array, others: TrialSpan, noise: ResidualNoise) -> Array:
    """Standard errors of the unknowns with derivatives `own` (r, k), all else fitted too."""
    count = own.shape[1]
    if count == 0:
        return np.zeros(0)
    seen = others.without(own)
    _, values, directions = np.linalg.svd(seen, full_matrices=False)
    if values[-1] <= DETERMINED * np.linalg.norm(own, 2):
        return np.full(count, np.inf)
    spread = at.spread(noise, seen @ directions.T / values**2 @ directions)
    return np.sqrt(np.maximum(np.diag(spread), 0.0))
