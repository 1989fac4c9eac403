"""The misfit near a structured fit, as a function of the prices alone and in a millisecond.

The recordings tell a gain; what is far from linear is the way from prices to gains. So near a fit
the misfit is taken as a quadratic form of gain and metric, known from one simulation,

    m^2(z) = |q + R (k(z) - k)|^2 + rest,       k = (G^-1 K T, S),

R and q the triangle and the residual in the columns of k, without what initial states and
parameters can make up for, these to first order; `rest` is what no gain near by makes up
(docs/structures.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy.optimize

from impc.arrays import Array
from impc.errors import WeightsError
from impc.inverse.residuals import scaled_changes
from impc.inverse.solution_set import natural_coordinates
from impc.inverse.structured_search import regulator_slopes
from impc.model.riccati import solve_lqr

if TYPE_CHECKING:
    from impc.assess.structured_weights import Tangent
    from impc.model.riccati import LqrSolution

# A price about its value in the fit: far wider than any interval that has an end.
_SPREAD = 20.0
_TRIES = 30


class NearFit:
    """The quadratic form near a fit."""

    def __init__(self, at: Tangent) -> None:
        self.at = at
        size, m = len(at.residual), at.problem.plant.m
        # In natural units of the gain, so that the triangle is as well conditioned as can be.
        T, G = natural_coordinates(at.problem.plant, np.array(at.solution.K))
        self.right, self.left = T, np.linalg.inv(G)
        units = np.eye(at.solution.K.size).reshape(-1, *at.solution.K.shape)
        unit = np.linalg.inv(self._natural(units).reshape(len(units), -1))
        columns = [at.found.dK.reshape(size, -1) @ unit.T]
        columns += [at.found.dS.reshape(size, -1)] if m > 1 else []
        seen = at.without_nuisance(np.hstack(columns))
        self.triangle: Array = np.asarray(np.linalg.qr(seen, mode="r"), dtype=np.float64)
        self.here = self._place(at.solution)
        # R'q = (columns)'residual: what of the residual lies in the columns.
        residual = at.without_nuisance(np.array(at.residual)[:, None])[:, 0]
        self.inside = np.linalg.pinv(self.triangle.T) @ (seen.T @ residual)
        self.rest = float(residual @ residual - self.inside @ self.inside)

    def least(self, z: Array, along: Array, aim: LqrSolution | None = None) -> tuple[float, Array]:
        """Least m^2 from z along columns, and the unknowns there.

        `z` (count,); `along` (moving, a); returns (count,).
        """
        moving = np.isfinite(z)
        offset, rest = self.inside, self.rest
        if aim is not None:
            offset, rest = self.triangle @ (self.here - self._place(aim)), 0.0
        weight = self.at.noise / _SPREAD
        kept: dict[bytes, tuple[Array, Array]] = {}

        def seen(step: Array) -> tuple[Array, Array]:
            key = step.tobytes()
            if key not in kept:
                kept.clear()
                value, slopes = self._form(_moved(z, moving, along @ step), moving)
                kept[key] = offset + value, slopes @ along
            return kept[key]

        def residual(step: Array) -> Array:
            try:
                return np.concatenate([seen(step)[0], weight * step])
            except WeightsError:
                return np.full(len(self.triangle) + len(step), 1e6 * self.at.noise)

        def derivative(step: Array) -> Array:
            try:
                slopes = seen(step)[1]
            except WeightsError:  # only where a search begins: it ends there
                slopes = np.zeros((len(self.triangle), along.shape[1]))
            return np.vstack([slopes, weight * np.eye(along.shape[1])])

        step: Array = np.zeros(along.shape[1])
        if len(step):
            step = scipy.optimize.least_squares(
                residual, step, jac=derivative, ftol=1e-6, max_nfev=_TRIES
            ).x
        data = residual(step)[: len(self.triangle)]
        return float(data @ data) + rest, _moved(z, moving, along @ step)

    def _natural(self, gains: Array) -> Array:
        """G^-1 K T, (..., m, n), of gains (..., m, n)."""
        return np.asarray(self.left @ gains @ self.right)

    def _place(self, solution: LqrSolution) -> Array:
        """k of a regulator."""
        gain = self._natural(np.array(solution.K)).ravel()
        if solution.plant.m == 1:
            return np.asarray(gain)
        S = np.array(solution.S)
        return np.concatenate([gain, (S * len(S) / np.trace(S)).ravel()])

    def _form(self, z: Array, moving: Array) -> tuple[Array, Array]:
        """R (k(z) - k) and its derivative with respect to the unknowns that move."""
        problem, structure = self.at.problem.known(), self.at.structure
        solution = solve_lqr(problem.plant, structure.weights(z))
        dK, dS = regulator_slopes(problem, structure, z, solution)
        slopes = self._natural(dK[moving]).reshape(int(np.sum(moving)), -1)
        if problem.plant.m > 1:
            turned = scaled_changes(np.array(solution.S), dS[moving])
            slopes = np.hstack([slopes, turned.reshape(len(slopes), -1)])
        return self.triangle @ (self._place(solution) - self.here), self.triangle @ slopes.T


def _moved(z: Array, moving: Array, step: Array) -> Array:
    there = z.copy()
    there[moving.astype(bool)] += step
    return there
