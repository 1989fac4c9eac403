"""A quadratic cost with a cross term that has a given gain: the start of the gradient search.

    minimise ||S||_F  over the costs  x'Qx + 2 x'Su + u'Ru  with that gain and R >= I

Every stabilising gain has such a cost: |u + Kx|^2 is one. Without R >= I the least would be zero.
It starts the gradient branch of Table 3.1 (Priess et al. 2015, see `inverse_lqr`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, finite_array, frozen
from impc.checking import checked
from impc.errors import WeightsError
from impc.inverse.proximal_step import block_basis
from impc.inverse.semidefinite import matrix_inequality, norm_bound, solve_semidefinite
from impc.inverse.solution_set import natural_coordinates, split_blocks
from impc.model.riccati import is_stable

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from impc.model.plant import Plant


@dataclass(frozen=True)
class CrossTerm(Frozen):
    """Weights of  x'Qx + 2 x'Su + u'Ru  that have the gain exactly, with the least cross term."""

    Q: Array  # Shapes (n, n), (m, m), (n, m); R >= I sets the scale
    R: Array
    S: Array
    norm: float  # ||S||_F
    status: str  # The solver's word


@checked(gain="m n")
def inverse_lqr_cross_term(plant: Plant, gain: ArrayLike) -> CrossTerm:
    """Least cross term with which a quadratic cost has exactly the `gain` (m, n).

    minimise ||S||_F subject to R >= I, [Q S; S' R] >= 0, where P and R are free and, with
    F = A - BK,

        discrete:    S' = RK - B'PF,    Q = P - F'PF + SK + K'S' - K'RK
        continuous:  S' = RK - B'P,     Q = -F'P - PF + SK + K'S' - K'RK

    P >= 0 follows, for F is stable. Dropping S gives a start for `inverse_lqr_gradient`.
    """
    n, m = plant.n, plant.m
    K = finite_array("gain", gain, (m, n))
    F = plant.A - plant.B @ K
    if not is_stable(F, discrete=plant.discrete):
        raise WeightsError("gain", "A - BK is not stable", "no quadratic cost has such a gain")
    P, R = block_basis(n, m)[:, :n, :n], block_basis(n, m)[:, n:, n:]
    cost_to_go = plant.B.T @ P @ F if plant.discrete else plant.B.T @ P
    decay = P - F.T @ P @ F if plant.discrete else -(F.T @ P + P @ F)
    S = (R @ K - cost_to_go).transpose(0, 2, 1)
    Q = decay + S @ K + (S @ K).transpose(0, 2, 1) - K.T @ R @ K
    joint = np.block([[Q, S], [S.transpose(0, 2, 1), R]])
    # The joint inequality is written in units of the natural spread of states and inputs, and the
    # unknowns are rotated to be orthonormal in it: ||S|| to 3e-8 on the published example; in full
    # natural coordinates, correlations too, only to 7e-4.
    spread = np.concatenate(
        [np.linalg.norm(part, axis=1) for part in natural_coordinates(plant, K)]
    )
    scaled = joint * np.outer(spread, spread)
    seen, triangle = np.linalg.qr(scaled.reshape(len(joint), -1).T)
    joint = np.tensordot(np.linalg.inv(triangle).T, joint, 1)
    S, R = joint[:, :n, n:].reshape(len(joint), -1), joint[:, n:, n:]
    bound = np.eye(len(joint) + 1)[-1]
    cones = [
        norm_bound(_padded(S / np.linalg.norm(S)), bound),
        matrix_inequality(-np.eye(m), _padded(R)),
        matrix_inequality(np.zeros((n + m, n + m)), _padded(seen.T.reshape(joint.shape))),
    ]
    found = solve_semidefinite(bound, cones)
    total = np.tensordot(found.y[:-1], joint, 1)
    cross = frozen((total[:n, n:] + total[n:, :n].T) / 2)
    # The solver keeps Q >= 0 and R >= I to 1e-11 of the largest number in the program, which left a
    # negative eigenvalue in 11 of 406 random exact recordings.
    total[:n, :n] = lifted(total[:n, :n], 0.0)
    total[n:, n:] = lifted(total[n:, n:], 1.0)
    weights = split_blocks(total, n)
    return CrossTerm(weights.Q, weights.R, cross, float(np.linalg.norm(cross)), found.status)


def lifted(matrix: Array, least: float) -> Array:
    """A symmetric matrix with its eigenvalues raised to a least one.

    `matrix` (k, k); returns (k, k).
    """
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    raised: Array = (vectors * np.maximum(values, least)) @ vectors.T
    return (raised + raised.T) / 2


def _padded(stack: Array) -> Array:
    """One more member, of zeros: the bound does not enter here."""
    return np.concatenate([stack, np.zeros_like(stack[:1])])
