"""Stage weights (Q, R): validation, scale and condition number.

The controller does not change if Q, R and P are multiplied by the same positive number, so weights
are compared after `normalised`: R[0, 0] = 1, which for a single input is the R := 1 of (3.6).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import scipy
from numpy.typing import ArrayLike

from impc.arrays import Array, frozen, symmetric_matrix
from impc.checking import Value, checked, replace
from impc.errors import WeightsError


@dataclass(frozen=True, init=False)
class Weights(Value):
    """Stage weights of the cost sum x'Qx + u'Ru.

    Parameters
    ----------
    Q, R : array_like
        Matrices of shape (n, n) and (m, m); a number stands for a 1 x 1 matrix.

    Attributes
    ----------
    Q : ndarray of shape (n, n)
        State weight, symmetric, positive semidefinite.
    R : ndarray of shape (m, m)
        Input weight, symmetric, positive definite.

    Raises
    ------
    DataError, InputError
        If a matrix is not square, finite and symmetric.
    WeightsError
        If Q has an eigenvalue below -1e-9 of its largest, or R is not positive definite.

    Examples
    --------
    >>> import impc
    >>> impc.Weights([[1, 0], [0, 4]], 1).R
    array([[1.]])
    """

    _rules: ClassVar[Mapping[str, Any]] = {"Q": "n n", "R": "m m"}

    Q: Array
    R: Array

    @checked
    def __init__(self, Q: ArrayLike, R: ArrayLike) -> None:
        q, r = symmetric_matrix("Q", Q), symmetric_matrix("R", R)
        require_semidefinite("Q", q)
        r_eigenvalues = np.linalg.eigvalsh(r)
        if r_eigenvalues[0] <= 0:
            raise WeightsError(
                "R",
                f"is not positive definite: its smallest eigenvalue is {r_eigenvalues[0]:.4g}",
                "give every input a positive cost weight",
            )
        self._fill(Q=frozen(q), R=frozen(r))

    @property
    def block(self) -> Array:
        """The block-diagonal matrix blkdiag(Q, R), (n + m, n + m)."""
        return np.asarray(scipy.linalg.block_diag(self.Q, self.R))


def require_semidefinite(name: str, matrix: Array) -> None:
    """Require a positive semidefinite matrix (n, n), up to rounding."""
    eigenvalues = np.linalg.eigvalsh(matrix)
    if eigenvalues[0] < -1e-9 * max(eigenvalues[-1], 1e-300):
        problem = f"is not positive semidefinite: its smallest eigenvalue is {eigenvalues[0]:.4g}"
        raise WeightsError(name, problem, f"give {name} = LL'")


@checked
def condition_number(weights: Weights) -> float:
    """Condition number of blkdiag(Q, R), kappa of (3.5); infinite if Q is singular."""
    eigenvalues = np.linalg.eigvalsh(weights.block)
    return float(eigenvalues[-1] / eigenvalues[0]) if eigenvalues[0] > 0 else float("inf")


@checked
def normalised(weights: Weights) -> Weights:
    """Return the weights scaled to R[0, 0] = 1."""
    scale = float(weights.R[0, 0])
    return replace(weights, Q=weights.Q / scale, R=weights.R / scale)


@checked
def weight_error(estimate: Weights, truth: Weights) -> float:
    """Return the distance of two weights: Frobenius norm at R[0, 0] = 1, equation (3.10).

    Parameters
    ----------
    estimate, truth : Weights
        Weights to compare; both are scaled first.

    Returns
    -------
    float
        Norm of the difference of the matrices blkdiag(Q, R).

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
