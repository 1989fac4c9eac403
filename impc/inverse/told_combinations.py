"""Which combinations of the parameters the recordings tell: singular values, with names.

docs/nonlinear.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen

if TYPE_CHECKING:
    from impc.control.optimal_control import OptimalControlProblem

__all__ = ["Combinations", "combinations"]


@dataclass(frozen=True, eq=False)
class Combinations(Frozen):
    """Stub until the words are written."""

    singular_values: Array
    vectors: Array


def combinations(
    problem: OptimalControlProblem, theta: Array, jacobian: Array, residual: Array
) -> Combinations:
    """Split."""
    p = len(theta)
    own, rest = jacobian[:, :p], jacobian[:, p:]
    if rest.shape[1]:
        own = own - rest @ np.linalg.lstsq(rest, own, rcond=None)[0]
    _, values, right = np.linalg.svd(own, full_matrices=False)
    return Combinations(values, right)
