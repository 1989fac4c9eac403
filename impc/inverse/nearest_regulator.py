"""Well-conditioned weights whose regulator is near a gain: (3.7), and as recordings see it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array
from impc.checking import checked
from impc.inverse.proximal_search import ConditionedFit, Objective, Residual, conditioned_fit
from impc.model.weights import Weights, condition_number, normalised

if TYPE_CHECKING:
    from impc.model.plant import Plant
    from impc.model.riccati import LqrSolution

#: Weight of the condition number in (3.7), against 1 for a distance as large as the gain in
#: `infer_weights`.
AUXILIARY_CONDITION_WEIGHT = 1e-3
# Starting weights are kept this definite: the search takes the Cholesky factor of them.
_LARGEST_START_CONDITION = 1e6
# Steps of a search for weights near a gain, and the decrease of the objective that is worth one.
_STEPS, _NEAR = 60, 1e-4


@checked(gain="m n", condition_weight=0)
def auxiliary_weights(
    plant: Plant,
    gain: Array,
    start: Weights | None,
    *,
    metric: Array | None = None,
    condition_weight: float = AUXILIARY_CONDITION_WEIGHT,
) -> ConditionedFit:
    """Auxiliary problem (3.7): weights whose regulator is near the gain, and well conditioned.

    minimise  ||K(Q, R) - gain||_2 + condition_weight kappa(blkdiag(Q, R))

    `gain` (m, n); `metric` (m, m).
    """
    m, size = plant.m, gain.size
    target = None if metric is None else m * metric / np.trace(metric)
    rows = size if target is None else size + m * m
    dK, dS = np.zeros((rows, *gain.shape)), np.zeros((rows, m, m))
    dK[:size] = np.eye(size).reshape(size, *gain.shape)
    dS[size:] = np.eye(m * m)[: rows - size].reshape(-1, m, m)

    def distance(solution: LqrSolution) -> Residual:
        beyond = (solution.K - gain).ravel()
        if target is not None:
            S = m * solution.S / np.trace(solution.S)
            beyond = np.concatenate([beyond, (S - target).ravel()])
        return Residual(beyond, dK, dS, usable=True)

    begin = Weights(np.eye(plant.n), np.eye(plant.m)) if start is None else start
    return conditioned_fit(
        plant, Objective(distance, 1.0, condition_weight, squared=False), definite(begin)
    )


def weights_near(
    plant: Plant, form: Array, gain: Array, start: Weights, condition_share: float
) -> ConditionedFit:
    """Weights whose gain is nearest in a quadratic form, such as that of recordings about a fit.

    minimise  1 + |form vec(K(Q, R) - gain)|^2 + condition_share kappa(blkdiag(Q, R))

    `form` (r, columns); `gain` (m, n).
    """
    dK = np.concatenate([form, np.zeros((1, gain.size))]).reshape(-1, *gain.shape)
    dS = np.zeros((len(dK), plant.m, plant.m))

    def distance(solution: LqrSolution) -> Residual:
        beyond = np.append(form @ (solution.K - gain).ravel(), 1.0)
        return Residual(beyond, dK, dS, usable=True)

    objective = Objective(distance, 1.0, condition_share, squared=True)
    return conditioned_fit(plant, objective, start, max_iterations=_STEPS, tolerance=_NEAR)


def definite(weights: Weights) -> Weights:
    """Lift the least eigenvalues of Q and R so that the condition number is at most 1e6."""
    if condition_number(weights) <= _LARGEST_START_CONDITION:
        return normalised(weights)
    floor = float(np.linalg.eigvalsh(weights.block)[-1]) / _LARGEST_START_CONDITION
    lifted = []
    for matrix in (weights.Q, weights.R):
        values, vectors = np.linalg.eigh(matrix)
        lifted.append((vectors * np.maximum(values, floor)) @ vectors.T)
    return normalised(Weights(*lifted))
