"""The set of all weights with a given gain and a condition number up to a limit.

    { X = blkdiag(Q, R) : X in the fibre of the gain,  trace R = m,  kappa(X) <= limit }

is convex: kappa(X) <= limit says that some t has  t I <= X <= limit t I.  Nothing that the
recordings say of the weights can be finer than this set (docs/equivalent-weights.md, section 2);
what holds for all of it is found by programs over it (`impc.assess.extreme_weights`).

They are written as seen from the analytic centre LL' of the fibre, L^-1 X L^-T, in which
tr(L^-1 X L^-T) is the same for every X of one scale: all members lie within n + m of it, which
bounds the variables and makes the dual bounds proofs (`solve_semidefinite`). As seen from the
member of least condition number, a corner of the cone, members of the seat's set lie at 2e4 and
farther: what the programs then returned was 1.4e-3 from the optimum and called solved.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from impc.arrays import Array, Frozen
from impc.checking import checked
from impc.errors import InputError, SolverError, WeightsError
from impc.inverse.equivalent_weights import analytic_centre, inverse_factor, least_condition_weights
from impc.inverse.semidefinite import Cone, matrix_inequality
from impc.inverse.solution_set import pair_blocks

if TYPE_CHECKING:
    from impc.inverse.equivalent_weights import EquivalentWeights
    from impc.inverse.solution_set import GainFibre


@dataclass(frozen=True)
class WeightsSet(Frozen):
    """The set of the module's text, ready for programs over it."""

    fibre: GainFibre
    least: EquivalentWeights  # The member of least condition number
    limit: float  # Largest condition number in the set
    # blkdiag(Q, R) = first + sum_i y_i level_i spans the members: (n + m, n + m) and (k, n + m, n +
    # m), the levels orthonormal as seen from the analytic centre
    first: Array
    level: Array
    inverse: Array  # L^-1 of that centre, (n + m, n + m)
    reach: float  # No member has a larger |y|

    @cached_property
    def cones(self) -> list[Cone]:
        """t l I <= X <= limit t l I in the variables (y, t), with l I at most I as seen."""
        n, size = self.fibre.plant.n, len(self.first)
        seen_first = self.inverse @ self.first @ self.inverse.T
        seen = self.inverse @ self.level @ self.inverse.T
        unit = float(1 / np.linalg.norm(self.inverse, 2) ** 2)
        floor = self.inverse @ self.inverse.T * unit
        top = self.limit * unit
        cones = []
        for block in (slice(0, n), slice(n, size)):
            below = np.concatenate([seen[:, block, block], -floor[None, block, block]])
            cones.append(matrix_inequality(seen_first[block, block], below))
            eye = np.eye(size)[None, block, block]
            above = np.concatenate([-self.level[:, block, block] / top, eye])
            cones.append(matrix_inequality(-self.first[block, block] / top, above))
        return cones


@checked
def weights_set(fibre: GainFibre, ratio: float = 10.0, *, rough: bool = False) -> WeightsSet:
    """Prepare the set of weights with condition number up to `ratio` times the least.

    `rough` as in `least_condition_weights`.
    """
    if not 1 < ratio < np.inf:
        raise InputError("ratio", f"got {ratio}", "give a number above 1")
    least = least_condition_weights(fibre, rough=rough)
    n, m = fibre.plant.n, fibre.plant.m
    try:
        centre = analytic_centre(fibre).weights
    except WeightsError:  # the cost on some combination of states is free but for the limit
        centre = None
    view = least.weights if centre is None else centre
    inverse = inverse_factor(fibre, view)
    raw = pair_blocks(fibre.Q, fibre.R)
    triangle = np.linalg.qr((inverse @ raw @ inverse.T).reshape(len(raw), -1).T, mode="r")
    raw = np.tensordot(np.linalg.inv(triangle).T, raw, 1)
    traces = np.trace(raw[:, n:, n:], axis1=1, axis2=2)
    first = view.block * (m / np.trace(view.R))
    level = np.tensordot(scipy.linalg.null_space(traces[None]).T, raw, 1)
    limit = ratio * (least.least or least.condition)
    if centre is None:  # X <= limit I, since the least eigenvalue is at most that of R
        trace = limit * float(np.linalg.norm(inverse)) ** 2
    else:
        trace = _largest_trace(fibre, inverse, raw)
    reach = trace + float(np.linalg.norm(inverse @ first @ inverse.T))
    return WeightsSet(fibre, least, limit, first, level, inverse, reach)


def _largest_trace(fibre: GainFibre, inverse: Array, raw: Array) -> float:
    """Largest tr(L^-1 X L^-T) of a semidefinite X with trace R = m; `raw` is orthonormal as seen.

    At the analytic centre it is alpha tr(G'RG) for all X = sum c_k raw_k, up to an error e'c of the
    centre; |c| is at most that trace again, and tr(G'RG) at most m times the largest value of GG'.
    """
    n, m = fibre.plant.n, fibre.plant.m
    seen = np.trace(inverse @ raw @ inverse.T, axis1=1, axis2=2)
    scale = np.trace(fibre.G.T @ raw[:, n:, n:] @ fibre.G, axis1=1, axis2=2)
    alpha = float(seen @ scale) / float(scale @ scale)
    error = float(np.linalg.norm(seen - alpha * scale))
    if error >= 0.5:
        raise SolverError(
            "analytic centre", f"is off by {error:.2g} of a trace", "scale the states and inputs"
        )
    return alpha * m * float(np.linalg.norm(fibre.G, 2)) ** 2 / (1 - error)
