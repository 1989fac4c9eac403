"""Stage weights (Q, R): validation, scale, condition number and Cholesky parameters.

The controller does not change when Q, R and P are multiplied by one positive number, so weights
are compared after `normalised`: R[0, 0] = 1, which for a single input is the R := 1 of (3.6).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import scipy.linalg

from impc.arrays import Array, frozen, symmetric_matrix
from impc.checking import Value, checked, replace
from impc.errors import WeightsError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike


@dataclass(frozen=True, init=False)
class Weights(Value):
    """Stage weights of the cost  sum x'Qx + u'Ru.

    Parameters
    ----------
    Q, R : array_like
        Shapes (n, n) and (m, m); a number stands for a 1 x 1 matrix.

    Attributes
    ----------
    Q : Array
        State weight (n, n), symmetric, positive semidefinite.
    R : Array
        Input weight (m, m), symmetric, positive definite.

    Raises
    ------
    DataError, InputError
        When a matrix is not square, finite and symmetric.
    WeightsError
        When Q has an eigenvalue below -1e-9 of its largest, or R one that is not positive.

    Examples
    --------
    >>> import impc
    >>> impc.Weights([[1, 0], [0, 4]], 1).R
    array([[1.]])
    """

    _rules: ClassVar[Mapping[str, Any]] = {
        "Q": "n n",
        "R": "m m",
    }

    Q: Array
    R: Array

    @checked
    def __init__(self, Q: ArrayLike, R: ArrayLike) -> None:
        q, r = symmetric_matrix("Q", Q), symmetric_matrix("R", R)
        q_eigenvalues, r_eigenvalues = np.linalg.eigvalsh(q), np.linalg.eigvalsh(r)
        if q_eigenvalues[0] < -1e-9 * max(q_eigenvalues[-1], 1e-300):
            raise WeightsError(
                "Q",
                f"is not positive semidefinite: its least eigenvalue is {q_eigenvalues[0]:.4g}",
                "give Q = LL'",
            )
        if r_eigenvalues[0] <= 0:
            raise WeightsError(
                "R",
                f"is not positive definite: its least eigenvalue is {r_eigenvalues[0]:.4g}",
                "every input needs a positive cost",
            )
        self._fill(Q=frozen(q), R=frozen(r))

    @property
    def block(self) -> Array:
        """The block-diagonal matrix blkdiag(Q, R), (n + m, n + m)."""
        return np.asarray(scipy.linalg.block_diag(self.Q, self.R))


@checked
def condition_number(weights: Weights) -> float:
    """Condition number of blkdiag(Q, R), the kappa of (3.5); infinite when Q is singular."""
    eigenvalues = np.linalg.eigvalsh(weights.block)
    return float(eigenvalues[-1] / eigenvalues[0]) if eigenvalues[0] > 0 else float("inf")


@checked
def normalised(weights: Weights) -> Weights:
    """Return the same weights scaled to R[0, 0] = 1."""
    scale = float(weights.R[0, 0])
    return replace(weights, Q=weights.Q / scale, R=weights.R / scale)


@checked
def weight_error(estimate: Weights, truth: Weights) -> float:
    """Frobenius distance of blkdiag(Q, R) after scaling both to R[0, 0] = 1, equation (3.10).

    Examples
    --------
    >>> import impc
    >>> truth = impc.Weights([[1, 0], [0, 1]], 1)
    >>> impc.weight_error(impc.Weights([[2, 0], [0, 2]], 2), truth)
    0.0
    >>> impc.weight_error(impc.Weights([[1, 0], [0, 4]], 1), truth)
    3.0
    """
    return float(np.linalg.norm(normalised(estimate).block - normalised(truth).block))


@checked
def cholesky_parameters(weights: Weights) -> Array:
    """Lower-triangular entries (k,) of the Cholesky factors of Q and R, row by row.

    R is scaled to R[0, 0] = 1 first and its first entry, then always 1, is left out, so that
    k = n(n+1)/2 + m(m+1)/2 - 1: scale is not one of them. Equation (3.6).
    """
    scaled = normalised(weights)
    try:
        q_factor, r_factor = np.linalg.cholesky(scaled.Q), np.linalg.cholesky(scaled.R)
    except np.linalg.LinAlgError:
        raise WeightsError("Q", "is singular", "add a small multiple of the identity") from None
    q_entries = q_factor[np.tril_indices(len(q_factor))]
    r_entries = r_factor[np.tril_indices(len(r_factor))]
    return np.concatenate([q_entries, r_entries[1:]])


@checked(parameters="*", n=(1, 10_000), m=(1, 10_000))
def weights_from_parameters(parameters: Array, n: int, m: int) -> Weights:
    """Inverse of `cholesky_parameters`: Q = LL' (n, n), R = GG' (m, m) with G[0, 0] = 1.

    `parameters` (k,).
    """
    count, total = n * (n + 1) // 2, (n * (n + 1) + m * (m + 1)) // 2 - 1
    if len(parameters) != total:
        raise WeightsError("parameters", f"has {len(parameters)} numbers", f"give {total}")
    q_factor, r_factor = np.zeros((n, n)), np.zeros((m, m))
    q_factor[np.tril_indices(n)] = parameters[:count]
    r_factor[np.tril_indices(m)] = np.concatenate([[1.0], parameters[count:]])
    return Weights(frozen(q_factor @ q_factor.T), frozen(r_factor @ r_factor.T))
