"""The search of `Coordinates` over many trials: initial states are eliminated trial by trial.

Time and memory then grow as the number of trials does (docs/speed.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.inverse.arrow import ArrowRows, Prior, arrow_least_squares

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.inverse.arrow import Tolerances
    from impc.inverse.coordinates import Coordinates

__all__ = ["has_many_trials", "search_many"]

# Unknowns from which on a decomposition of all columns takes longer than one trial by trial: at 200
# a step takes 20 ms either way.
_MANY = 200


def has_many_trials(space: Coordinates) -> bool:
    """Whether `space` has so many initial states that `search_many` is to be used."""
    return bool(space.problem.unknown_start and space.trials * space.n > _MANY)


def search_many(
    space: Coordinates, z: Array, along: Array, weights: tuple[Array, float], ends: Tolerances
) -> tuple[Array, int]:
    """Least squares with a prior about the start.

    Parameters
    ----------
    space : Coordinates
        Of a problem with unknown initial states.
    z : Array
        Where the search begins (q,).
    along : Array
        Columns along which gain, metric and parameters may move (g, a), orthonormal.
    weights : tuple of Array and float
        Of the prior: along each of these columns (a,), and of all initial states.
    ends : Tolerances

    Returns
    -------
    z : Array
        Where it ends (q,).
    spent : int
        Evaluations.
    """
    first, last = int(space.ends[1]), int(space.ends[2])
    shape = space.trials, space.n

    def shared(z: Array) -> Array:
        return np.concatenate([z[:first], z[last:]])

    def placed(u: Array, v: Array) -> Array:
        moved = shared(z) + along @ (u - begin)
        return np.concatenate([moved[:first], np.ravel(v), moved[first:]])

    def rows(u: Array, v: Array) -> ArrowRows:
        found = space.at(placed(u, v)).rows
        return ArrowRows(found.residual, found.shared @ along, found.own)

    begin = along.T @ shared(z)
    prior = Prior(along.T @ shared(space.start), np.zeros(shape), *weights)
    u, v, spent = arrow_least_squares(rows, prior, begin, z[first:last].reshape(shape), ends)
    return placed(u, v), spent
