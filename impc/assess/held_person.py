"""The likeliest person of whom one number is held: of such are profiles, and ends of intervals."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from impc.inverse.likelihood_search import climb

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.inverse.person_prior import Place, Prior

__all__ = ["held_person"]


def held_person(
    prior: Prior, here: Place, along: Array, off: float, unseen: Array, budget: int
) -> tuple[Place, Array] | None:
    """The best of all else with along'theta so far off (docs/noisy-people.md).

    The search begins on the ridge of the parabola about `here`, or beside it, where it is the
    higher: a straight ridge may leave the gains that stabilise, and moves a level that is all but
    none by many powers of e.

    `along` (q,); `unseen` (q,); returns (q,).
    """
    _, curvature = prior.parabola(here, unseen)
    ridge = np.asarray(np.linalg.solve(curvature, along), dtype=np.float64)
    ways = ridge / float(along @ ridge), along
    starts = [place for way in ways if (place := prior.tried(here.theta + off * way))]
    if not starts:
        return None
    begin = max(starts, key=lambda place: place.value)
    found, unseen, _, _ = climb(prior, begin, budget, _across(along), unseen)
    return found, unseen


def _across(along: Array) -> Array:
    """All that is orthogonal to a direction (q, q - 1); coordinates it leaves alone, as such."""
    mine = np.flatnonzero(along)
    turned = np.zeros((len(along), len(mine) - 1))
    turned[mine] = scipy.linalg.null_space(along[None, mine])
    return np.hstack([np.delete(np.eye(len(along)), mine, axis=1), turned])
