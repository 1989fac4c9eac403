"""Linear space that contains the gains of all weights of a structure (one input).

With a delayed command, states without a cost weight do not enter the gain independently: on the
seat the gains of all weights over angles and rates span five of ten dimensions
(docs/howto/weights.md).

The space is computed from regulators at three weight sizes, in whitened coordinates, and their
derivatives with respect to the cost weights of products of features. With several inputs there is
no such result, so that all gains are searched.
"""

from __future__ import annotations

import numpy as np

from impc.arrays import Array
from impc.inverse.problem import Problem
from impc.inverse.solution_set import RANK
from impc.model.plant import Plant
from impc.model.riccati import regulator_changes, solve_lqr
from impc.model.structure import Structure
from impc.model.weights import Weights

# Weights of whitened states relative to that of the command: seat gains from 1/3 to 8 units.
_SIZES = (1e-2, 1.0, 1e2)
# Singular values below this share are dropped: such a gain moves the command by a thousandth of one
# whitened unit. On the seat the fifth is 0.07 of the largest, the sixth 0.0002.
_BESIDE = 1e-3


def kept_to(problem: Problem) -> Structure | None:
    """Structure that restricts the gain of output-feedback MPC; None if unrestricted."""
    structure = problem.structure
    if structure is None or len(problem.logarithms) or problem.plant.m > 1:
        return None
    return structure if np.linalg.matrix_rank(structure.features) < problem.plant.n else None


def regulators_alone(plant: Plant, structure: Structure, T: Array) -> Array:
    """Basis (k, 1, n) of the gains of a structure, orthonormal in coordinates `T` (n, n)."""
    _, values, rows = np.linalg.svd(_regulators(plant, structure, T), full_matrices=False)
    kept = rows[values > _BESIDE * values[0]]
    return np.asarray((kept @ np.linalg.inv(T))[:, None, :])


def _regulators(plant: Plant, structure: Structure, T: Array) -> Array:
    """Gains and their derivatives by cost weights, in whitened coordinates (k, n)."""
    _, values, rows = np.linalg.svd(structure.features @ T, full_matrices=False)
    features = rows[values > RANK * values[0]] @ np.linalg.inv(T)
    first, second = np.tril_indices(len(features))
    products = features[first, :, None] * features[second, None, :]
    dQ = products + products.transpose(0, 2, 1)
    still, found = np.zeros_like(dQ), []
    for size in _SIZES:
        one = solve_lqr(plant, Weights(size * features.T @ features, 1.0))
        dK, _ = regulator_changes(one, size * dQ, still[:, :1, :1], still, still[:, :, :1])
        natural = np.concatenate([one.K, dK[:, 0]]) @ T
        found.append(natural / np.linalg.norm(natural))
    return np.concatenate(found)
