"""The gains that weights of a structure have, with one input: the linear space that holds them.

A state without a cost weight is not steered for its own sake. Where the command passes a delay, its
states have no say in the gain: the controller predicts over them, and what it does about them
follows from what it does about the rest. On the seat the gains of all weights over angles and
rates make five dimensions of ten (docs/structures.md has the theorem).

The space is computed: regulators at three sizes of the weights, in natural coordinates, and all
their derivatives with respect to cost weights of products of features. With several inputs there is
no theorem, and with two the singular values fell without a gap: all gains are searched then.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.inverse.solution_set import RANK
from impc.model.riccati import regulator_changes, solve_lqr
from impc.model.weights import Weights

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.inverse.problem import Problem
    from impc.model.plant import Plant
    from impc.model.structure import Structure

# Sizes of the weights on natural states, of natural commands' one: gains from a third of a natural
# one to eight on the seat.
_SIZES = (1e-2, 1.0, 1e2)
# Of the largest singular value: a gain of a thousandth moves the command by a thousandth of the
# noise that would drive the loop. On the seat the fifth is .07 of the largest, the sixth .0002.
_BESIDE = 1e-3


def kept_to(problem: Problem) -> Structure | None:
    """The structure that the gain of a person keeps to, where the problem's own says anything."""
    structure = problem.structure
    if structure is None or len(problem.logarithms) or problem.plant.m > 1:
        return None
    return structure if np.linalg.matrix_rank(structure.features) < problem.plant.n else None


def regulators_alone(plant: Plant, structure: Structure, T: Array) -> Array:
    """Basis (k, 1, n) of the gains that weights over a structure's features have.

    Orthonormal in natural coordinates.

    `T` (n, n).
    """
    _, values, rows = np.linalg.svd(_regulators(plant, structure, T), full_matrices=False)
    kept = rows[values > _BESIDE * values[0]]
    return np.asarray((kept @ np.linalg.inv(T))[:, None, :])


def _regulators(plant: Plant, structure: Structure, T: Array) -> Array:
    """Gains of regulators and their changes with cost weights, in natural coordinates (k, n)."""
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
