"""People who explain recordings about as well as the one that was found, and what holds for all.

What the noise of one sense explains that of another may explain as well, with another gain: beside
the hill of the likelihood where a fit has ended there are others, for people one of whose senses is
all but exact. An interval of 95 % is from the lowest to the highest end of those of all that are
as likely as a number inside an interval is,

    F >= max F - 1.96^2 / 2

each by the sandwich, and of the one that was found, whoever is likelier (docs/noisy-people.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from impc.arrays import Array, frozen
from impc.assess.covariance import TWO_SIDED
from impc.assess.person_covariance import person_covariance
from impc.inverse.likelihood_fit import person_at
from impc.inverse.likelihood_search import climb

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.assess.person_covariance import PersonCovariance
    from impc.inverse.likelihood_fit import PersonFit

__all__ = [
    "LikelyPerson",
    "direction_intervals",
    "entry_intervals",
    "level_intervals",
    "people_as_likely",
]

# Logarithm by which the noise of a sense that is all but exact is below what is expected, and
# likelihoods of a search that begins there.
_EXACT, _LOOK = 5.0, 15


class LikelyPerson(NamedTuple):
    """Somebody who explains the recordings.

    Attributes
    ----------
    fit : PersonFit
    covariance : PersonCovariance
        By the sandwich.
    """

    fit: PersonFit
    covariance: PersonCovariance


def people_as_likely(fit: PersonFit) -> list[LikelyPerson]:
    """The fit, the first, and people as likely, from it with one sense after the other exact.

    Parameters
    ----------
    fit : PersonFit
    """
    prior, unseen = fit.prior, np.array(fit.unseen)
    found = [fit]
    for index in fit.space.senses:
        exact = np.array(fit.theta)
        exact[index] = prior.scales[index - fit.space.own] - _EXACT
        if there := prior.tried(exact):
            place, lost, spent, settled = climb(prior, there, _LOOK, unseen=unseen)
            found.append(person_at(prior, place, lost, settled, spent))
    least = max(one.value for one in found) - TWO_SIDED**2 / 2
    likely = [fit, *(one for one in found[1:] if one.value >= least)]
    return [LikelyPerson(one, person_covariance(one)) for one in likely]


def entry_intervals(people: Sequence[LikelyPerson]) -> Array:
    """Intervals of 95 % of the entries of the gain (entries, 2), in their units.

    Parameters
    ----------
    people : sequence of LikelyPerson
    """
    return _united([covariance.entry_intervals(one.K) for one, covariance in people])


def level_intervals(people: Sequence[LikelyPerson]) -> Array:
    """Intervals of 95 % of all levels (l, 2), in their units.

    Parameters
    ----------
    people : sequence of LikelyPerson
    """
    return _united([covariance.level_intervals(one.levels) for one, covariance in people])


def direction_intervals(people: Sequence[LikelyPerson], ways: Array) -> Array:
    """Intervals of 95 % of combinations of the coordinates of gain or prices (k, 2).

    Parameters
    ----------
    people : sequence of LikelyPerson
    ways : Array
        One a row (k, g).
    """
    found = []
    for one, covariance in people:
        own = slice(0, one.space.gain)
        spread = ways @ np.array(covariance.covariance)[own, own] @ ways.T
        about = TWO_SIDED * np.sqrt(np.diag(spread))
        found.append((ways @ one.theta[own])[:, None] + about[:, None] * [-1, 1])
    return _united(found)


def _united(intervals: Sequence[Array]) -> Array:
    """From the lowest to the highest end of intervals (k, 2) of several people."""
    ends = np.array(intervals)
    return frozen(np.stack([ends[..., 0].min(axis=0), ends[..., 1].max(axis=0)], axis=-1))
