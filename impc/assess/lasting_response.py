"""Steady opposing command for a lasting deflection of one state.

States that only the command drives (delay, muscle) settle under a constant u at x_a = D u,
D = (I - A_aa)^-1 B_a, and u = -K_i x_i - K_a x_a gives

    u = -(I + K_a D)^-1 K_i x_i.

The interval follows from the covariance of the gain to first order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import BoolArray
from impc.assess.covariance import FOREIGN, TWO_SIDED

if TYPE_CHECKING:
    from impc.assess.printed_gain import GainEstimate
    from impc.model.plant import Plant


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
    """For each output that is a state; empty if no state is driven by the command alone."""
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
