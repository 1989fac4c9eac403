"""The fibre of a gain: the linear space of the weights (Q, R) that have it.

With F = A - BK, the P of a candidate (Q, R) follows from one Lyapunov equation, and what makes K
its gain is then linear in (Q, R):

    discrete:    P = F'PF + Q + K'RK,        B'PF = RK
    continuous:  0 = F'P + PF + Q + K'RK,    B'P  = RK

so the weights with the gain K are the positive definite members of a linear space. With P
eliminated nothing has to be asked of it: Q, R > 0 give P > 0 (docs/equivalent-weights.md,
section 1).

The fibre is computed in natural coordinates, which follow from the plant and the gain alone: in
them white noise at the inputs gives the states a covariance of I, and the inputs are measured in
the metric N that the closed loop reproduces, N ~ B'YB with Y = F'YF + K'NK (continuous:
0 = F'Y + YF + K'NK). They make the answers independent of units, and the seat plant nearly as well
conditioned as a textbook example: its singular values span a factor of 240, in raw units 5e5.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from impc.arrays import Array, Frozen, finite_array, frozen, symmetric_matrix
from impc.checking import checked
from impc.errors import InputError, WeightsError
from impc.inverse.proximal_step import block_basis
from impc.model.riccati import lyapunov_series, stabilises
from impc.model.weights import Weights

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from impc.model.plant import Plant

#: Singular values of the gain condition below this, of the largest, are zero: exact gains leave
#: 1e-15 there (a singular A, or a metric given with its own gain), the seat's smallest is 4e-3.
RANK = 1e-10
# A direction that the inputs hardly reach is stretched no further than this, in variance; an input
# direction that the loop hardly reproduces (always, when m > n) no further than that.
_STATE_FLOOR, _INPUT_FLOOR = 1e-8, 1e-3


@dataclass(frozen=True, eq=False)  # a fibre is itself only: what is found of it may be kept by it
class GainFibre(Frozen):
    """The linear space of the pairs (Q, R) for which the gain is stationary."""

    plant: Plant
    gain: Array  # K, (m, n)
    # Basis of k pairs, (k, n, n) and (k, m, m), in the units of the plant; orthonormal in natural
    # coordinates, where a pair is blkdiag(T'QT, G'RG)
    Q: Array
    R: Array
    T: Array  # Natural coordinates of states x = T z (n, n) and inputs u = G v (m, m)
    G: Array
    # Of the gain condition in natural coordinates (s,), largest first: those below 1e-10 of the
    # first count as zero
    singular_values: Array

    @property
    def dimension(self) -> int:
        """Number of independent pairs, scale counted: k."""
        return len(self.Q)

    def natural_basis(self) -> Array:
        """The basis as blkdiag(T'QT, G'RG), (k, n + m, n + m)."""
        return pair_blocks(self.T.T @ self.Q @ self.T, self.G.T @ self.R @ self.G)

    def to_natural(self, weights: Weights) -> Array:
        """blkdiag(T'QT, G'RG) of any weights, (n + m, n + m)."""
        both = scipy.linalg.block_diag(self.T, self.G)
        return np.asarray(both.T @ weights.block @ both)

    def from_natural(self, X: Array) -> Weights:
        """Weights in the units of the plant of an X (n + m, n + m); inverse of `to_natural`."""
        back = np.linalg.inv(scipy.linalg.block_diag(self.T, self.G))
        return split_blocks(back.T @ X @ back, self.plant.n)


@checked(gain="m n")
def gain_fibre(plant: Plant, gain: ArrayLike, metric: ArrayLike | None = None) -> GainFibre:
    """Compute the space of the weights that have a given gain.

    Parameters
    ----------
    plant : Plant
        Discrete or continuous.
    gain : array_like
        K (m, n) of u = -Kx.
    metric : array_like, optional
        S (m, m), known up to scale: only pairs whose R + B'PB (continuous: R) is a multiple of
        it. Where the recordings identify less of it, a basis (k, m, m) of the metrics that they
        leave (`GainFit.metrics`): only pairs whose R + B'PB is in its span. With a single input it
        says nothing.

    Raises
    ------
    DataError, InputError
        When the gain is not a finite (m, n) matrix, or a metric not a symmetric (m, m) one.
    WeightsError
        When A - BK is not stable: no weights have such a gain.

    Examples
    --------
    Two states and one input: four numbers of (Q, R), of which a gain of two fixes two.

    >>> import impc
    >>> from plants import yalmip_example
    >>> plant = impc.Plant(yalmip_example())
    >>> gain = impc.solve_lqr(plant, impc.Weights([[1, 0], [0, 1]], 1)).K
    >>> impc.gain_fibre(plant, gain).dimension
    2
    """
    K = finite_array("gain", gain, (plant.m, plant.n))
    if not stabilises(plant, K):
        raise WeightsError("gain", "A - BK is not stable", "no weights have such a gain")
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
    """Natural coordinates x = T z, u = G v of a plant under a stabilising gain K (m, n)."""
    F = plant.A - plant.B @ K
    input_factor = np.linalg.cholesky(floored_covariance(_input_metric(plant, K, F), _INPUT_FLOOR))
    G = np.asarray(np.linalg.inv(input_factor).T, dtype=np.float64)
    # Continuous: noise of the same variance, correlated over the mean time constant of F.
    rate = 1.0 if plant.discrete else -float(np.trace(F)) / plant.n
    driven = plant.B @ G
    covariance = _lyapunov(plant, F.T, (driven @ driven.T / rate)[None])[0]
    return np.asarray(
        np.linalg.cholesky(floored_covariance(covariance, _STATE_FLOOR)), dtype=np.float64
    ), G


def pair_blocks(Q: Array, R: Array) -> Array:
    """blkdiag(Q, R) for stacks Q (k, n, n) and R (k, m, m): (k, n + m, n + m)."""
    n, m = Q.shape[-1], R.shape[-1]
    joined = np.zeros((len(Q), n + m, n + m))
    joined[:, :n, :n], joined[:, n:, n:] = Q, R
    return joined


def split_blocks(X: Array, n: int) -> Weights:
    """The pair whose blkdiag(Q, R) is X (n + m, n + m), symmetrised; Q is (n, n)."""
    symmetric = (X + X.T) / 2
    return Weights(frozen(symmetric[:n, :n]), frozen(symmetric[n:, n:]))


def _input_metric(plant: Plant, K: Array, F: Array) -> Array:
    """N ~ B'YB, Y = F'YF + K'NK: the Perron eigenvector of a map that keeps N >= 0."""
    m = plant.m
    units = block_basis(m, 0)
    images = plant.B.T @ _lyapunov(plant, F, K.T @ units @ K) @ plant.B
    values, vectors = np.linalg.eig(np.tensordot(units, images, ((1, 2), (1, 2))))
    leading = np.tensordot(vectors[:, int(np.argmax(values.real))].real, units, 1)
    trace = float(np.trace(leading))
    # A gain of zero reproduces nothing: the inputs' own units are as good as any.
    return leading * m / trace if abs(trace) > 1e-12 else np.eye(m)


def floored_covariance(covariance: Array, floor: float) -> Array:
    """Make a covariance (n, n) definite: unit variance where there is none, correlations floored.

    The eigenvalues of the correlation are raised to the floor. The answer is (n, n) too.
    """
    variance = np.diag(covariance)
    scale = np.where(variance > 0, np.sqrt(np.maximum(variance, 1e-300)), 1.0)
    correlation = covariance / np.outer(scale, scale)
    np.fill_diagonal(correlation, 1.0)
    values, vectors = np.linalg.eigh((correlation + correlation.T) / 2)
    floored: Array = (vectors * np.maximum(values, floor)) @ vectors.T
    return np.outer(scale, scale) * floored


def _lyapunov(plant: Plant, F: Array, stack: Array) -> Array:
    """P of P = F'PF + M, or of 0 = F'P + PF + M, for a stack of M."""
    if plant.discrete:
        return lyapunov_series(F.T, stack)
    return np.array([scipy.linalg.solve_continuous_lyapunov(F.T, -item) for item in stack])


def _add_metric(conditions: Array, S: Array, G: Array, metric: ArrayLike) -> Array:
    """Rows that keep S (k, m, m), natural, in the span of the given metrics."""
    given = [symmetric_matrix("metric", item, len(G)) for item in _stack(metric)]
    sizes = [float(np.max(np.abs(item))) for item in given]
    if not given or min(sizes) == 0:
        raise InputError("metric", "is zero", "give R + B'PB, up to scale")
    scaled = zip(given, sizes, strict=True)
    spanned = np.array([(G.T @ (item / size) @ G).ravel() for item, size in scaled]).T
    basis, _ = np.linalg.qr(spanned / np.linalg.norm(spanned, axis=0))
    flat = S.reshape(len(S), -1)
    return np.hstack([conditions, flat - flat @ basis @ basis.T])


def _stack(metric: ArrayLike) -> list[ArrayLike]:
    """One metric, or a basis of them (k, m, m), as a list."""
    return [metric] if np.ndim(metric) < 3 else list(np.asarray(metric))
