"""LASSO selection (C.5) of parameters that differ from their typical values.

    min over t in [-1, 1]^k   (1/N) sum e^2 + lambda ||t - t_typ||_1

It is solved by Gauss-Newton steps whose quadratic programs include the absolute values and the
bounds, so that parameters can equal their typical values exactly. A least-squares refit of the
selected parameters follows. The dissertation does not give the scale of the first term; here it is
the mean square in the outputs' unit squared.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.control.named_solver import require_solver, silent
from impc.studies.selection.estimation import Estimate, estimate, residuals
from impc.studies.selection.model import ParametricModel, Trial, physical, stacked

_ROUNDS, _HALVINGS, _SOLVES = 60, 30, 40
_ROUNDING = 1e-12  # Distance from a typical value that is rounding error


@dataclass(frozen=True)
class Lasso(Frozen):
    """Selection by LASSO."""

    t: Array  # Normalised parameters (k,)
    selected: tuple[int, ...]  # Parameters that differ from their typical values
    refit: Estimate | None  # Fit of the selected parameters; None if there are none


def lasso_of_size(model: ParametricModel, trials: Sequence[Trial], count: int) -> Lasso:
    """Largest selection of at most `count` parameters, by bisection of lambda."""
    typical = model.usual
    low, high = 1e-8, 1e3
    t, chosen = typical, tuple[int, ...]()
    for _ in range(_SOLVES):
        weight = float(np.sqrt(low * high))
        tried, _ = proximal_lasso(model, trials, weight)
        moved = tuple(np.flatnonzero(np.abs(tried - typical) > _ROUNDING).tolist())
        if len(moved) > count:
            low = weight
        else:
            high = weight
            if len(moved) >= len(chosen):
                t, chosen = tried, moved
        if len(chosen) == count or high / low < 1.01:
            break
    start = np.array(model.typical)
    start[list(chosen)] = physical(model, t)[list(chosen)]
    refit = estimate(model, trials, chosen, start) if chosen else None
    return Lasso(frozen(t), chosen, refit)


def proximal_lasso(
    model: ParametricModel, trials: Sequence[Trial], weight: float
) -> tuple[Array, float]:
    """Solve (C.5): normalised parameters (k,) and the objective."""
    typical = model.usual
    t, current, damping = typical, lasso_objective(model, trials, typical, weight), 1e-6
    for _ in range(_ROUNDS):
        # Local model g'd + d'Hd/2 of the mean square.
        errors, J = stacked(model, physical(model, t), trials)
        g = 2 * J.T @ np.concatenate([part.ravel() for part in errors]) / len(J)
        H = 2 * J.T @ J / len(J) + damping * np.eye(len(t))
        step = _box_lasso(H, g, t, typical, weight) - t
        for share in 0.5 ** np.arange(_HALVINGS):
            moved = lasso_objective(model, trials, t + share * step, weight)
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


def lasso_objective(
    model: ParametricModel, trials: Sequence[Trial], t: Array, weight: float
) -> float:
    """(C.5) at t (k,); infinite if the outputs are not finite."""
    errors = np.concatenate(residuals(model, physical(model, t), trials))
    away = np.sum(np.abs(t - model.usual))
    found = float(np.mean(errors**2) + weight * away)
    return found if np.isfinite(found) else np.inf


def _box_lasso(H: Array, g: Array, t: Array, typical: Array, weight: float) -> Array:
    """argmin over x in [-1, 1]^k of g'(x - t) + (x - t)'H(x - t)/2 + weight |x - typical|_1.

    With x = typical + p - q and p, q >= 0 it is a quadratic program. Its active-set solution has
    exact zeros. A program without a solution gives a step that `proximal_lasso` does not take.
    """
    both = np.hstack([np.eye(len(t)), -np.eye(len(t))])
    square = ca.DM(both.T @ H @ both)
    options: dict[str, Any] = {"printLevel": "none", "error_on_fail": False}
    solver_name = require_solver("qpoases")
    with silent():
        solver = ca.conic("lasso", solver_name, {"h": square.sparsity()}, options)
        found = solver(
            h=square, g=both.T @ (g + H @ (typical - t)) + weight,
            lbx=0, ubx=np.concatenate([1 - typical, 1 + typical]),
        )  # fmt: skip
    return np.asarray(np.clip(typical + both @ found["x"].full().ravel(), -1.0, 1.0))
