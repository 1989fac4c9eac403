"""Set of equivalent weights: all (Q, R) with a given optimal gain K, a linear space.

With F = A - BK, P follows from (Q, R) by a Lyapunov equation, and optimality of K is linear in
(Q, R):

    discrete:    P = F'PF + Q + K'RK,        B'PF = RK
    continuous:  0 = F'P + PF + Q + K'RK,    B'P  = RK

so the weights with gain K are the positive definite members of a linear space (P > 0 follows from
Q, R > 0; docs/why/equivalent_weights.md).

The space is computed in whitened coordinates, which depend only on plant and gain: white noise at
the inputs gives the states covariance I, and inputs are measured in the metric N that the closed
loop reproduces, N ~ B'YB with Y = F'YF + K'NK (continuous: 0 = F'Y + YF + K'NK). Results are then
independent of units and the computation is well conditioned.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from impc.arrays import Array, Frozen, finite_array, frozen, symmetric_matrix
from impc.checking import checked
from impc.errors import InputError, WeightsError
from impc.inverse.proximal_step import block_basis
from impc.model.plant import Plant
from impc.model.riccati import lyapunov_series, stabilises
from impc.model.weights import Weights

#: Singular values of the optimality condition below this share of the largest count as zero. Exact
#: gains leave 1e-15 (singular A, or a metric given with its own gain); the seat's least is 4e-3.
RANK = 1e-10
# Floors of the relative variance of states and inputs that the loop hardly excites.
_STATE_FLOOR, _INPUT_FLOOR = 1e-8, 1e-3


@dataclass(frozen=True, eq=False)  # identity comparison, so that results can be cached by space
class GainFibre(Frozen):
    """Linear space of the pairs (Q, R) that satisfy the optimality condition of the gain."""

    plant: Plant
    gain: Array  # K, (m, n), of u = -Kx
    # Basis of k pairs, (k, n, n) and (k, m, m), in the units of the plant; orthonormal in whitened
    # coordinates, where a pair is blkdiag(T'QT, G'RG)
    Q: Array
    R: Array
    T: Array  # Whitened coordinates: x = T z, T (n, n), and u = G v, G (m, m)
    G: Array
    # Singular values of the optimality condition in whitened coordinates (s,), largest first; those
    # below 1e-10 of the first count as zero
    singular_values: Array

    @property
    def dimension(self) -> int:
        """Dimension k of the space; the common scale of Q and R counts as one."""
        return len(self.Q)

    def natural_basis(self) -> Array:
        """The basis as blkdiag(T'QT, G'RG), (k, n + m, n + m)."""
        return pair_blocks(self.T.T @ self.Q @ self.T, self.G.T @ self.R @ self.G)

    def to_natural(self, weights: Weights) -> Array:
        """blkdiag(T'QT, G'RG) of any weights, (n + m, n + m)."""
        both = scipy.linalg.block_diag(self.T, self.G)
        return np.asarray(both.T @ weights.block @ both)

    def from_natural(self, X: Array) -> Weights:
        """Convert X (n + m, n + m) in whitened coordinates to weights; inverse of `to_natural`."""
        back = np.linalg.inv(scipy.linalg.block_diag(self.T, self.G))
        return split_blocks(back.T @ X @ back, self.plant.n)


@checked(gain="m n")
def gain_fibre(plant: Plant, gain: ArrayLike, metric: ArrayLike | None = None) -> GainFibre:
    """Compute the linear space of all weights (Q, R) that have a given gain.

    Parameters
    ----------
    plant : Plant
        Discrete or continuous.
    gain : array_like of shape (m, n)
        Gain K of the control law u = -Kx.
    metric : array_like of shape (m, m) or (k, m, m), optional
        Input metric S = R + B'PB (continuous: S = R), known up to scale: keep only pairs whose
        metric is a multiple of it. A stack keeps pairs whose metric lies in the span of its k
        members (`Estimate.metrics`). It has no effect with a single input.

    Returns
    -------
    GainFibre
        Basis of the space; `dimension` counts the independent pairs, common scale included.

    Raises
    ------
    DataError, InputError
        If the gain is not a finite (m, n) matrix, or a metric is not a symmetric (m, m) matrix.
    WeightsError
        If A - BK is not stable: no weights have such a gain.

    Examples
    --------
    With two states and one input (Q, R) has four entries; the gain fixes two of them.

    >>> import impc
    >>> from plants import yalmip_example
    >>> plant = impc.Plant(yalmip_example())
    >>> gain = impc.solve_lqr(plant, impc.Weights([[1, 0], [0, 1]], 1)).K
    >>> impc.gain_fibre(plant, gain).dimension
    2
    """
    K = finite_array("gain", gain, (plant.m, plant.n))
    if not stabilises(plant, K):
        raise WeightsError(
            "gain", "A - BK is not stable, so no weights have this gain", "pass a stabilising gain"
        )
    T, G = natural_coordinates(plant, K)
    z, v = np.linalg.inv(T), np.linalg.inv(G)
    F, B, K_natural = z @ (plant.A - plant.B @ K) @ T, z @ plant.B @ G, v @ K @ T
    units = block_basis(plant.n, plant.m)
    Q, R = units[:, : plant.n, : plant.n], units[:, plant.n :, plant.n :]
    P = _lyapunov(plant, F, Q + K_natural.T @ R @ K_natural)
    product = B.T @ P @ F if plant.discrete else B.T @ P
    conditions: Array = (product - R @ K_natural).reshape(len(units), -1)
    if metric is not None:
        conditions = _add_metric(conditions, R + B.T @ P @ B if plant.discrete else R, G, metric)
    _, singular, directions = np.linalg.svd(conditions.T)
    count = int(np.count_nonzero(singular > RANK * singular[0]))
    members = directions[count:]
    return GainFibre(
        plant,
        frozen(K),
        frozen(z.T @ np.tensordot(members, Q, 1) @ z),
        frozen(v.T @ np.tensordot(members, R, 1) @ v),
        frozen(T),
        frozen(G),
        frozen(singular),
    )


def natural_coordinates(plant: Plant, K: Array) -> tuple[Array, Array]:
    """Whitened coordinates x = T z, u = G v of a plant under a stabilising gain K (m, n)."""
    F = plant.A - plant.B @ K
    input_factor = np.linalg.cholesky(floored_covariance(_input_metric(plant, K, F), _INPUT_FLOOR))
    G = np.asarray(np.linalg.inv(input_factor).T, dtype=np.float64)
    # Continuous time: noise of the same variance, correlated over the mean time constant of F.
    rate = 1.0 if plant.discrete else -float(np.trace(F)) / plant.n
    driven = plant.B @ G
    covariance = _lyapunov(plant, F.T, (driven @ driven.T / rate)[None])[0]
    return np.asarray(
        np.linalg.cholesky(floored_covariance(covariance, _STATE_FLOOR)), dtype=np.float64
    ), G


def pair_blocks(Q: Array, R: Array) -> Array:
    """Stack blkdiag(Q, R), (k, n + m, n + m), of Q (k, n, n) and R (k, m, m)."""
    n, m = Q.shape[-1], R.shape[-1]
    joined = np.zeros((len(Q), n + m, n + m))
    joined[:, :n, :n], joined[:, n:, n:] = Q, R
    return joined


def split_blocks(X: Array, n: int) -> Weights:
    """Weights with blkdiag(Q, R) = X (n + m, n + m), symmetrised; Q is (n, n)."""
    symmetric = (X + X.T) / 2
    return Weights(frozen(symmetric[:n, :n]), frozen(symmetric[n:, n:]))


def _input_metric(plant: Plant, K: Array, F: Array) -> Array:
    """Metric N ~ B'YB, Y = F'YF + K'NK: Perron eigenvector of a map that preserves N >= 0."""
    m = plant.m
    units = block_basis(m, 0)
    images = plant.B.T @ _lyapunov(plant, F, K.T @ units @ K) @ plant.B
    values, vectors = np.linalg.eig(np.tensordot(units, images, ((1, 2), (1, 2))))
    leading = np.tensordot(vectors[:, int(np.argmax(values.real))].real, units, 1)
    trace = float(np.trace(leading))
    # A zero gain reproduces nothing: keep the units of the inputs.
    return leading * m / trace if abs(trace) > 1e-12 else np.eye(m)


def floored_covariance(covariance: Array, floor: float) -> Array:
    """Covariance (n, n) made definite: eigenvalues of its correlation raised to `floor`."""
    variance = np.diag(covariance)
    scale = np.where(variance > 0, np.sqrt(np.maximum(variance, 1e-300)), 1.0)
    correlation = covariance / np.outer(scale, scale)
    np.fill_diagonal(correlation, 1.0)
    values, vectors = np.linalg.eigh((correlation + correlation.T) / 2)
    floored: Array = (vectors * np.maximum(values, floor)) @ vectors.T
    return np.outer(scale, scale) * floored


def _lyapunov(plant: Plant, F: Array, stack: Array) -> Array:
    """Solve P = F'PF + M (discrete) or 0 = F'P + PF + M (continuous) for a stack of M."""
    if plant.discrete:
        return lyapunov_series(F.T, stack)
    return np.array([scipy.linalg.solve_continuous_lyapunov(F.T, -item) for item in stack])


def _add_metric(conditions: Array, S: Array, G: Array, metric: ArrayLike) -> Array:
    """Append conditions that keep S (k, m, m) in the span of the given metrics."""
    given = [symmetric_matrix("metric", item, len(G)) for item in _stack(metric)]
    sizes = [float(np.max(np.abs(item))) for item in given]
    if not given or min(sizes) == 0:
        raise InputError(
            "metric", "expected a nonzero matrix, got zero", "pass R + B'PB, up to scale"
        )
    scaled = zip(given, sizes, strict=True)
    spanned = np.array([(G.T @ (item / size) @ G).ravel() for item, size in scaled]).T
    basis, _ = np.linalg.qr(spanned / np.linalg.norm(spanned, axis=0))
    flat = S.reshape(len(S), -1)
    return np.hstack([conditions, flat - flat @ basis @ basis.T])


def _stack(metric: ArrayLike) -> list[ArrayLike]:
    """Metrics as a list: one (m, m), or a basis (k, m, m)."""
    return [metric] if np.ndim(metric) < 3 else list(np.asarray(metric))
