"""Gain reported with intervals: that of the weights, refitted along identified directions.

Along them the estimate is that of least squares without a prior (`refit`), which its covariance
describes. Parameters are positive and searched in logarithms: their intervals are
value * exp(+- z SE). See docs/why/intervals.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import scipy.linalg
import scipy.special

from impc.arrays import Array, BoolArray
from impc.assess.covariance import FOREIGN, TWO_SIDED, GainCovariance, gain_covariance
from impc.assess.long_run_covariance import residual_noise, spread_of_sum
from impc.checking import checked, replace
from impc.inverse.command_regression import regress_commands
from impc.inverse.estimates import Estimate, SearchEnd
from impc.inverse.minimiser import Ended
from impc.inverse.problem import Problem
from impc.inverse.refit import refit
from impc.inverse.residuals import misfit_or_reason
from impc.model.continuous_gain import continuous_gain
from impc.model.plant import UNKNOWN, Plant, gain_unit

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class GainEstimate:
    """Identified gain with its covariance."""

    problem: Problem  # At the initial states and parameters fitted with this gain
    K: Array  # (m, n); that of the weights along unidentified directions
    S: Array  # (m, m); that of the weights where not identified
    misfit: float  # 2-norm of the residual
    covariance: GainCovariance  # HAC covariance with curvature
    # The same with stated uncertainties set to zero; None if there are none
    exact: GainCovariance | None = None
    ended: Ended = Ended.CONVERGED  # How the search ended
    # Other ends of the search that are within noise of this one
    rivals: tuple[GainEstimate, ...] = ()

    @property
    def parameters(self) -> Array:
        """Physical parameters in their units (k,); empty if none are fitted."""
        return self.problem.parameters


def gain_estimate(fitted: Estimate) -> GainEstimate:
    """Estimate the identified gain of a fit, and its covariance.

    Other ends of the search whose -2 log posterior is within a 95 % quantile of the lowest, times
    the ratio of long-run to white variance, are as good: intervals are the union of theirs.
    """
    pair = np.array(fitted.gain), np.array(fitted.metric)
    end = fitted.refitted or SearchEnd.of(refit(fitted.problem, *pair))
    found = _with_covariance(end, fitted.problem)
    fixed, exact = found.problem.with_body_fixed(), None
    if fixed is not found.problem:
        exact = gain_covariance(fixed, np.array(end.K), np.array(end.S), curvature=True)
    lowest = min(one.objective for one in (end, *fitted.rivals))
    near = lowest + max(found.covariance.colour, 1.0) * TWO_SIDED**2
    rivals = (one for one in fitted.rivals if one.objective <= near)
    others = tuple(_with_covariance(one, fitted.problem) for one in rivals)
    return replace(found, exact=exact, rivals=others)


def _with_covariance(end: SearchEnd, posed: Problem) -> GainEstimate:
    """An end of a search of a problem, with its covariance."""
    problem, K, S = end.problem(posed), np.array(end.K), np.array(end.S)
    misfit = misfit_or_reason(problem, K, S)[0]
    covariance = gain_covariance(problem, K, S, curvature=True)
    return GainEstimate(problem, end.K, end.S, misfit, covariance, ended=end.ended)


Item = TypeVar("Item", "Interval", "LastingResponse")
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

    @property
    def determined(self) -> bool:
        """Whether it is identified, and half of the interval is at most half of the value."""
        return self.identified and self.high - self.low <= abs(self.value or 0.0)


def entry_names(plant: Plant) -> tuple[str, ...]:
    """Names of the entries of a gain, row by row."""
    return tuple(f"K.{control}.{state}" for control in plant.controls for state in plant.states)


def covariance_intervals(
    estimate: GainEstimate, covariance: GainCovariance, method: str
) -> tuple[Interval, ...]:
    """Intervals of the entries of K and of free parameters: normal.

    Those of the estimate's own covariance are the union over its `rivals`.
    """
    own = _normal_intervals(estimate, covariance, method)
    if covariance is not estimate.covariance:
        return own
    return _union(own, *(_normal_intervals(one, one.covariance, method) for one in estimate.rivals))


def _union(own: tuple[Item, ...], *others: tuple[Item, ...]) -> tuple[Item, ...]:
    """The `own` intervals, widened to the ends of those of the same numbers in `others`.

    A singular value at rounding level makes an interval infinite: if it is not so at the own end,
    the value of the other one counts with the own width.
    """
    found = []
    for one, *same in zip(own, *others, strict=True):
        ends = [(one.low, one.high)]
        for item in same:
            moved = item.value - one.value if item.low == -np.inf else 0.0
            ends.append((one.low + moved, one.high + moved) if moved else (item.low, item.high))
        low, high = min(low for low, _ in ends), max(high for _, high in ends)
        found.append(replace(one, low=low, high=high))
    return tuple(found)


def _normal_intervals(
    estimate: GainEstimate, covariance: GainCovariance, method: str
) -> tuple[Interval, ...]:
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
        `value`, `low`, `high`; and `determined`, whether the recordings identify this number
        individually, and half of the interval is at most half of the value. Values are
        least-squares estimates along the identified directions and can differ from K, which
        belongs to weights (docs/why/intervals.md).
    """
    return _table(gain_estimate(fitted))


def continuous_interval_table(fitted: Estimate) -> pd.DataFrame:
    """Continuous-time gain of which that of `intervals()` is the sampled counterpart.

    For comparison with published gains; columns as in `intervals()`. Intervals are first-order
    (delta method) at fixed parameters. `Controller.from_continuous_gain` defines and inverts the
    conversion.
    """
    found = gain_estimate(fitted)
    return _table(replace(_continuous(found), rivals=tuple(map(_continuous, found.rivals))))


def _continuous(found: GainEstimate) -> GainEstimate:
    """The same with the continuous-time gain and its standard errors."""
    K, slopes = continuous_gain(found.problem.plant, found.K)
    entries, foreign = found.covariance.combinations(slopes)
    shape = {"entries": entries.reshape(K.shape), "foreign": foreign.reshape(K.shape)}
    return replace(found, K=K, covariance=replace(found.covariance, **shape))


def _table(found: GainEstimate) -> pd.DataFrame:
    import pandas as pd  # noqa: PLC0415  # a third of a second

    plant = found.problem.plant
    units = [gain_unit(plant, u, x) for u in plant.controls for x in plant.states]
    items = covariance_intervals(found, found.covariance, "sandwich")
    units += [UNKNOWN] * (len(items) - len(units))  # of parameters
    rows = [
        (item.name, unit, item.value, item.low, item.high, item.determined)
        for item, unit in zip(items, units, strict=True)
    ]
    heads = ["name", "unit", "value", "low", "high", "determined"]
    return pd.DataFrame(rows, columns=heads).set_index("name")


@checked
def command_regression(estimate: Estimate) -> pd.DataFrame:
    """Compare a fitted gain with the gain by regression on recorded commands.

    Only samples count at which the fitted controller has no active bound over its horizon. The 95 %
    intervals assume recording noise in the commands (any autocorrelation) and white noise of the
    subject; coloured noise is correlated with the states and biases them. Noise in recorded states
    shrinks the regression gain. If both gains differ by much, an assumption of one of them fails.

    Parameters
    ----------
    estimate : Estimate
        Fit of recordings with commands.

    Returns
    -------
    pandas.DataFrame
        One row per entry of the gain, by name: `unit`, `fitted`, `regression`, `low`, `high`.

    Raises
    ------
    DataError
        If no commands were recorded.
    SolverError
        If the samples with inactive bounds do not determine a gain, or the plant driven by the
        commands does not follow the recordings.

    Examples
    --------
    >>> import control
    >>> import impc
    >>> plant = impc.Plant(control.ss([[0.9]], [[1]], [[1]], 0, 1))
    >>> bounds = impc.Bounds(plant, u_min=-0.3, u_max=0.3)
    >>> truth = impc.Controller(plant, impc.Weights(1, 1), bounds, horizon=3)
    >>> run = truth.simulate([1.0], steps=20)
    >>> trial = impc.Recording(plant, run.x, commands=run.u)
    >>> found = impc.fit(impc.Problem(plant, bounds, 3, [trial]))
    >>> impc.command_regression(found).round(3).loc["K.u[0].x[0]", "regression"]
    np.float64(0.538)
    """
    import pandas as pd  # noqa: PLC0415  # a third of a second

    plant = estimate.problem.plant
    found = regress_commands(estimate.problem, estimate.gain, estimate.metric)
    table = np.concatenate(found.deviations)
    inverse = np.linalg.inv(table.T @ table)
    # Row t of the sum is (1 (x) x_t (X'X)^-1): an entry of K by an entry of the residual.
    along = [np.einsum("tn,ij->tijn", part @ inverse, np.eye(plant.m)) for part in found.deviations]
    columns = [part.reshape(len(part), plant.m, -1) for part in along]
    spread = spread_of_sum(residual_noise(found.residuals), columns)
    half = scipy.special.ndtri(0.5 + LEVEL / 2) * np.sqrt(np.diag(spread))
    values = np.ravel(found.K)
    return pd.DataFrame(
        {
            "unit": [gain_unit(plant, u, x) for u in plant.controls for x in plant.states],
            "fitted": np.ravel(estimate.gain),
            "regression": values,
            "low": values - half,
            "high": values + half,
        },
        index=pd.Index(entry_names(plant), name="name"),
    )


@dataclass(frozen=True)
class LastingResponse:
    """Steady opposing command of one control for a state held at 1, all others at rest."""

    state: str
    control: str
    value: float
    low: float  # 95 % interval
    high: float
    identified: bool


def follows_command(plant: Plant) -> BoolArray:
    """Mask of the states (n,) driven by the command alone, such as nerves and muscles."""
    inside = ~np.any(plant.E != 0, axis=1) & ~np.any(plant.C != 0, axis=0)
    while True:
        left = inside & ~np.any(plant.A[:, ~inside] != 0, axis=1)
        if np.array_equal(left, inside):
            return np.asarray(inside)
        inside = left


def lasting_responses(estimate: GainEstimate) -> tuple[LastingResponse, ...]:
    """For each output that is a state: of the estimate, with the union of intervals."""
    return _union(*(_lasting(one) for one in (estimate, *estimate.rivals)))


def _lasting(estimate: GainEstimate) -> tuple[LastingResponse, ...]:
    """For each output that is a state; empty if no state is driven by the command alone.

    States that only the command drives (delay, muscle) settle under a constant u at x_a = D u,
    D = (I - A_aa)^-1 B_a, and u = -K_i x_i - K_a x_a gives u = -(I + K_a D)^-1 K_i x_i. The
    interval follows from the covariance of the gain to first order.
    """
    plant, K = estimate.problem.plant, np.array(estimate.K)
    inner = follows_command(plant)
    outer = [int(np.argmax(row != 0)) for row in plant.C if np.count_nonzero(row) == 1]
    if not np.any(inner) or not outer:
        return ()
    settled = np.eye(int(np.count_nonzero(inner))) - plant.A[np.ix_(inner, inner)]
    if np.linalg.cond(settled) > 1 / np.finfo(float).eps:  # integrates the command
        return ()
    D = np.linalg.solve(settled, plant.B[inner])
    W = np.linalg.inv(np.eye(plant.m) + K[:, inner] @ D)
    found = []
    for state in outer:
        values = W @ K[:, state]
        slopes = np.zeros((plant.m, plant.n))
        slopes[:, state], slopes[:, inner] = 1.0, -(D @ values)
        rows = (W[:, :, None] * slopes[None]).reshape(plant.m, -1)
        errors, foreign = estimate.covariance.combinations(rows)
        for k, control in enumerate(plant.controls):
            value, half = float(values[k]), TWO_SIDED * float(errors[k])
            identified = bool(foreign[k] < FOREIGN)
            name = plant.states[state]
            ends = value - half, value + half
            found.append(LastingResponse(name, control, value, *ends, identified))
    return tuple(found)
