"""LASSO selection (C.5) of parameters that differ from their typical values.

    min over t in [-1, 1]^k   (1/N) sum e^2 + lambda ||t - t_typ||_1

`proximal_lasso` solves it by Gauss-Newton steps whose quadratic programs include the absolute
values and the bounds, so that parameters can equal their typical values exactly. `table_c1` is the
method of the dissertation: Nelder-Mead with bounds by t = sin(u), a threshold of 0.005, and lambda
adjusted until n parameters are beyond it. Both end with a least-squares refit of the selected
parameters. The dissertation does not give the scale of the first term; here it is the mean square
in the outputs' unit squared.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg
import scipy.optimize

from impc.arrays import Array, Frozen, frozen
from impc.studies.selection.estimation import Estimate, estimate, residuals
from impc.studies.selection.model import normalised, physical, stacked

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.studies.selection.model import ParametricModel, Trial

_THRESHOLD, _FIRST = 0.005, 0.13
_CHANGES, _ROUNDS, _HALVINGS = 500, 60, 30
_ROUNDING = 1e-12  # Tolerance of the optimality test, relative to the steepest slope


@dataclass(frozen=True)
class Lasso(Frozen):
    """Selection by LASSO."""

    weight: float  # lambda
    t: Array  # Normalised parameters (k,)
    selected: tuple[int, ...]  # Parameters that differ from their typical values
    refit: Estimate | None  # Fit of the selected parameters; None if there are none
    objective: float  # (C.5) at t


def proximal_lasso(
    model: ParametricModel, trials: Sequence[Trial], weight: float
) -> tuple[Array, float]:
    """Solve (C.5): normalised parameters (k,) and the objective."""
    typical = normalised(model, np.asarray(model.typical))
    t = typical.copy()

    def value(at: Array) -> float:
        return _mean_square(model, trials, at) + weight * float(np.sum(np.abs(at - typical)))

    current, damping = value(t), 1e-6
    for _ in range(_ROUNDS):
        H, g = _quadratic(model, trials, t)
        step = _box_lasso(H + damping * np.eye(len(t)), g, t, typical, weight) - t
        for share in 0.5 ** np.arange(_HALVINGS):
            moved = value(t + share * step)
            if moved < current:
                break
        else:
            break
        gained = current - moved
        t, current = t + share * step, moved
        if share < 1:
            # Shorter steps next time: only full steps reach typical values exactly.
            damping *= 10
        if gained < 1e-10 * max(current, 1e-300):
            break
    return np.asarray(t), current


def lasso_of_size(model: ParametricModel, trials: Sequence[Trial], count: int) -> Lasso:
    """Largest selection of at most `count` parameters, by bisection of lambda."""
    low, high, solves = 1e-8, 1e3, 0
    best: tuple[float, Array, float] | None = None
    while solves < 40 and high / low >= 1.01:
        middle = float(np.sqrt(low * high))
        t, objective = proximal_lasso(model, trials, middle)
        solves += 1
        chosen = _selected(model, t)
        if len(chosen) > count:
            low = middle
            continue
        high = middle
        if best is None or len(chosen) >= len(_selected(model, best[1])):
            best = (middle, t, objective)
        if len(chosen) == count:
            break
    if best is None:
        best = (high, *proximal_lasso(model, trials, high))
    return _finished(model, trials, *best)


def table_c1(
    model: ParametricModel, trials: Sequence[Trial], count: int, *, solves: int = 12
) -> Lasso:
    """Table C.1: Nelder-Mead, lambda adjusted until `count` parameters exceed the threshold.

    The dissertation does not give the rule for lambda: it is multiplied by 2 if too many parameters
    moved, divided by 2 if too few; the factor's logarithm is halved if the direction changes. At
    most `solves` problems are solved.
    """
    typical = normalised(model, np.asarray(model.typical))
    weight, factor, before = _FIRST, 2.0, 0
    for number in range(1, solves + 1):

        def value(u: Array, weight: float = weight) -> float:
            t = np.sin(u)
            return _mean_square(model, trials, t) + weight * float(np.sum(np.abs(t - typical)))

        found = scipy.optimize.minimize(
            value, np.arcsin(np.clip(typical, -1, 1)), method="Nelder-Mead",
            options={"maxfev": 200 * len(typical)},
        )  # fmt: skip
        t = np.sin(found.x)
        moved = int(np.count_nonzero(np.abs(t - typical) > _THRESHOLD))
        if moved == count or number == solves:
            break
        direction = 1 if moved > count else -1
        if before and direction != before:
            factor = float(np.sqrt(factor))
        weight, before = weight * factor**direction, direction
    return _finished(model, trials, weight, np.asarray(t), float(found.fun), _THRESHOLD)


def _finished(
    model: ParametricModel,
    trials: Sequence[Trial],
    weight: float,
    t: Array,
    objective: float,
    threshold: float = 0.0,
) -> Lasso:
    chosen = _selected(model, t, threshold)
    start = np.array(model.typical)
    start[list(chosen)] = physical(model, t)[list(chosen)]
    refit = estimate(model, trials, chosen, start) if chosen else None
    return Lasso(weight, frozen(t), chosen, refit, objective)


def _selected(model: ParametricModel, t: Array, threshold: float = 0.0) -> tuple[int, ...]:
    typical = normalised(model, np.asarray(model.typical))
    return tuple(int(item) for item in np.flatnonzero(np.abs(t - typical) > max(threshold, 1e-12)))


def _mean_square(model: ParametricModel, trials: Sequence[Trial], t: Array) -> float:
    errors = np.concatenate(residuals(model, physical(model, t), trials))
    mean = float(np.mean(errors**2))
    return mean if np.isfinite(mean) else np.inf


def _quadratic(model: ParametricModel, trials: Sequence[Trial], t: Array) -> tuple[Array, Array]:
    """H and g of the local model g'd + d'Hd/2 of the mean square at t."""
    errors, J = stacked(model, physical(model, t), trials)
    error = np.concatenate([part.ravel() for part in errors])
    return 2 * J.T @ J / len(J), 2 * J.T @ error / len(J)


def _box_lasso(H: Array, g: Array, t: Array, typical: Array, weight: float) -> Array:
    """argmin over x in [-1, 1]^k of g'(x - t) + (x - t)'H(x - t)/2 + weight |x - typical|_1.

    Primal active-set method from x = t, for positive definite H. Coordinates at a kink (typical
    value) or bound are fixed; the others step to the minimum of the quadratic on their side of the
    kink, at most to the first kink or bound, where that coordinate is fixed. At the minimum, the
    fixed coordinate with the largest decrease is released; if there is none, x is the solution.
    """
    x, side = t.copy(), np.sign(t - typical)
    held = (side == 0) | (np.abs(x) == 1)
    steepest = weight + float(np.max(np.abs(g)))
    for _ in range(_CHANGES):
        free = np.flatnonzero(~held)
        step = np.zeros_like(x)
        slope = g + H @ (x - t) + weight * side
        step[free] = -scipy.linalg.solve(H[np.ix_(free, free)], slope[free], assume_a="pos")
        barrier = np.where((typical - x) * step > 0, typical, np.sign(step))
        share = np.full(len(x), np.inf)
        np.divide(barrier - x, step, out=share, where=step != 0)
        first = int(np.argmin(share))
        x += min(share[first], 1.0) * step
        if share[first] < 1:
            x[first], held[first] = barrier[first], True
            side[first] = np.sign(x[first] - typical[first])
            continue
        gain, towards = _release(g + H @ (x - t), x, side, typical, weight)
        best = int(np.argmax(np.where(held, gain, 0.0)))
        if not held[best] or gain[best] <= steepest * _ROUNDING:
            break
        held[best] = False
        side[best] = side[best] or towards[best]
    return np.asarray(x)


def _release(
    gradient: Array, x: Array, side: Array, typical: Array, weight: float
) -> tuple[Array, Array]:
    """Slope of the objective if a coordinate leaves its kink or bound, and the direction."""
    at_kink = side == 0
    towards = np.where(at_kink, -np.sign(gradient), -np.sign(x))
    steep = np.where(at_kink, np.abs(gradient) - weight, np.sign(x) * (gradient + weight * side))
    blocked = at_kink & (typical * towards >= 1)  # typical value at a bound
    return np.where(blocked, 0.0, steep), towards
