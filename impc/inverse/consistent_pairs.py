"""The pairs (K, S) of gain and metric that weights have: a linear space and a positive matrix.

With S = R + B'PB and F = B'P the gain is K = S^-1 F A, and F B = B'PB is symmetric. Nothing else is
asked of F: where the columns of B are independent, every F with F B symmetric is B'P of a symmetric
P. So

    consistent pairs  =  { (S^-1 F A, S) :  F B = B'F',  S > 0 },

n m - m(m-1)/2 numbers in F and m(m+1)/2 - 1 in S up to scale, n m + m - 1 together where A is
invertible (docs/theory.md, section 2). No inverse of A is needed: where A is singular, F A vanishes
on its null space, as the gain of any weights does. With one input S is a number, F is any row, and
every gain is taken to be consistent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from impc.arrays import Array
from impc.inverse.proximal_step import block_basis
from impc.inverse.solution_set import RANK, natural_coordinates

if TYPE_CHECKING:
    from impc.model.plant import Plant
    from impc.model.plant_family import PlantDifferential

__all__ = [
    "ConsistentGains",
    "consistent_gains",
    "consistent_pair",
    "gain_changes",
    "metric_changes",
    "scaled_changes",
]

# Of the largest singular value: changes of the metric that move it less far from consistency.
_ALONE = 1e-8


@dataclass(frozen=True)
class ConsistentGains:
    """The products S K = F A over all F with F B symmetric, by a basis.

    Attributes
    ----------
    metric : Array
        S (m, m) that it was made for.
    gains : Array
        K (q, m, n) of each with that metric; orthonormal as G^-1 K T.
    F : Array or None
        Basis (q, m, n) at the plant that it was made for; None with one input.
    """

    metric: Array
    gains: Array
    F: Array | None

    def products(self, plant: Plant) -> Array:
        """F A (q, m, n) of each, F made symmetric for a plant whose parameters have moved."""
        if self.F is None:
            return np.asarray(self.metric @ self.gains)
        return np.asarray(_symmetric(self.F, plant.B) @ plant.A)

    def drift(self, plant: Plant, z: Array, change: PlantDifferential) -> Array:
        """Derivative (k, m, n) of F A at z (q,) with respect to the plant's k parameters."""
        if self.F is None:
            return np.zeros((change.A.shape[-1], 1, plant.n))
        F, B = np.tensordot(z, self.F, 1), plant.B
        pseudo = np.linalg.pinv(B)
        outside = np.eye(plant.n) - B @ pseudo
        skew, found = F @ B - (F @ B).T, []
        for dA, dB in zip(np.moveaxis(change.A, -1, 0), np.moveaxis(change.B, -1, 0), strict=True):
            dpseudo = -pseudo @ dB @ pseudo + np.linalg.inv(B.T @ B) @ dB.T @ outside
            dskew = F @ dB - (F @ dB).T
            dF = -(dskew @ pseudo + skew @ dpseudo) / 2
            found.append(dF @ plant.A + _symmetric(F, B) @ dA)
        return np.array(found).reshape(-1, *F.shape)


def consistent_gains(plant: Plant, metric: Array, T: Array, G: Array) -> ConsistentGains:
    """Make the basis for the search about a metric.

    Parameters
    ----------
    plant : Plant
    metric : Array
        S (m, m).
    T, G : Array
        Natural coordinates (n, n) and (m, m).
    """
    n, m = plant.n, plant.m
    back, states = np.linalg.inv(G), np.linalg.inv(T)
    if m == 1:
        return ConsistentGains(metric, G * np.eye(n)[:, None] @ states, None)
    A, B, S = states @ plant.A @ T, states @ plant.B @ G, G.T @ metric @ G
    F = np.eye(m * n).reshape(-1, m, n)
    skew = (F @ B - np.swapaxes(F @ B, 1, 2)).reshape(m * n, -1)
    F = np.tensordot(scipy.linalg.null_space(skew.T).T, F, 1)
    gains = np.linalg.solve(S, F @ A)
    left, values, rows = np.linalg.svd(gains.reshape(len(F), -1), full_matrices=False)
    kept = values > RANK * values[0]
    F = np.tensordot(left[:, kept].T / values[kept, None], F, 1)
    gains = G @ rows[kept].reshape(-1, m, n) @ states
    return ConsistentGains(metric, gains, back.T @ F @ states)


def consistent_pair(plant: Plant, gain: Array, metric: Array) -> tuple[Array, Array]:
    """Return the gain that is consistent with a metric next to one that stabilises, and the metric.

    Parameters
    ----------
    gain, metric : Array
        K (m, n) and S (m, m).

    Returns
    -------
    gain, metric : Array
        (m, n) and (m, m).
    """
    if plant.m == 1:
        return gain, metric
    T, G = natural_coordinates(plant, gain)
    basis = np.linalg.solve(G, consistent_gains(plant, metric, T, G).gains @ T)
    along = np.tensordot(np.tensordot(basis, np.linalg.solve(G, gain @ T), 2), basis, 1)
    return np.asarray(G @ along @ np.linalg.inv(T)), metric


def metric_changes(
    plant: Plant, gain: Array, metric: Array, T: Array, G: Array
) -> tuple[Array, Array]:
    """How the metric of a consistent pair moves with its gain, and by itself.

    Parameters
    ----------
    plant : Plant
    gain, metric : Array
        K (m, n) and S (m, m).
    T, G : Array
        Natural coordinates (n, n) and (m, m).

    Returns
    -------
    with_gain, alone : Array
        The least change (m n, m, m) of S, in natural coordinates, for a step of one in each entry
        of G^-1 K T; and a basis (k, m, m) of its changes for the same gain, S itself among them.
    """
    if plant.m == 1:  # S is its own scale, and every gain goes with it
        return np.zeros((plant.n, 1, 1)), metric[None]
    units, back = block_basis(plant.m, 0), np.linalg.inv(G)
    steps = np.eye(gain.size).reshape(-1, *gain.shape)
    by_metric = _beside(plant, T, G, units @ back @ gain @ T)
    by_gain = _beside(plant, T, G, G.T @ metric @ G @ steps)
    left, values, _ = np.linalg.svd(by_metric)
    count = int(np.count_nonzero(values > _ALONE * values[0]))
    inverse = np.linalg.pinv(by_metric, rcond=_ALONE)
    changes = [np.tensordot(rows, units, 1) for rows in (-by_gain @ inverse, left[:, count:].T)]
    with_gain, alone = (np.asarray(back.T @ one @ back) for one in changes)
    return with_gain, alone


def gain_changes(
    plant: Plant, gain: Array, metric: Array, T: Array, G: Array, change: PlantDifferential
) -> Array:
    """How a gain follows the plant's k parameters while its metric stands and weights have both.

    Parameters
    ----------
    plant : Plant
    gain, metric : Array
        K (m, n) and S (m, m).
    T, G : Array
        Natural coordinates (n, n) and (m, m).
    change : PlantDifferential
        Of the k parameters.

    Returns
    -------
    Array
        (k, m, n): one such change; others differ by those of the gain at the same plant.
    """
    gains = consistent_gains(plant, metric, T, G)
    z = np.tensordot(np.linalg.solve(G, gains.gains @ T), np.linalg.solve(G, gain @ T), 2)
    return np.asarray(np.linalg.solve(metric, gains.drift(plant, z, change)))


def scaled_changes(metric: Array, changes: Array) -> Array:
    """Changes of a metric as those of the metric scaled to a mean diagonal of 1.

    That is how the controller scales it before it is differentiated (`Evaluation.dS`).

    Parameters
    ----------
    metric, changes : Array
        (m, m) and (k, m, m).

    Returns
    -------
    Array
        (k, m, m).
    """
    trace = np.trace(metric)
    shares = np.trace(changes, axis1=1, axis2=2)[:, None, None] / trace
    return np.asarray(len(metric) / trace * (changes - shares * metric))


def _beside(plant: Plant, T: Array, G: Array, products: Array) -> Array:
    """What natural products S K (k, m, n) have beside all F A, flat (k, m n)."""
    back = np.linalg.inv(G)
    basis = back @ consistent_gains(plant, back.T @ back, T, G).gains @ T
    rows, flat = basis.reshape(len(basis), -1), products.reshape(len(products), -1)
    return np.asarray(flat - flat @ rows.T @ rows)


def _symmetric(F: Array, B: Array) -> Array:
    """The F (..., m, n) next to those given whose F B is symmetric."""
    product = F @ B
    return np.asarray(F - (product - np.swapaxes(product, -1, -2)) / 2 @ np.linalg.pinv(B))
