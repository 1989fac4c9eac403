"""People who explain recordings about as well as the one that was found, and what holds for all.

What the noise of one sense explains that of another may explain as well, with another gain: beside
the hill of the likelihood where a fit has ended there are others, for people one of whose senses is
all but exact. And a hill may be steep on one side and all but flat on the other: along the
direction of the gain that is least told a person is looked for as far as one is as likely. An
interval of 95 % is from the lowest to the highest end of those of all that are as likely as a
number inside an interval is,

    F >= max F - 1.96^2 / 2

by the sandwich where a search has ended, and of the one that was found, whoever is likelier
(docs/noisy-people.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from impc.arrays import Array, frozen
from impc.assess.covariance import TWO_SIDED
from impc.assess.person_covariance import person_covariance
from impc.assess.person_profile import held_person
from impc.checking import replace
from impc.inverse.likelihood_fit import person_at
from impc.inverse.likelihood_search import climb
from impc.inverse.person_prior import TOLD

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.assess.person_covariance import PersonCovariance
    from impc.inverse.likelihood_fit import PersonFit

# Logarithm by which the noise of a sense that is all but exact is below what is expected, and
# likelihoods of a search that begins there.
_EXACT, _LOOK = 5.0, 15
# Who is as likely farthest along a direction is looked for at so many places, by so many
# likelihoods at each, and is found where as much of what may be lost is.
_PLACES, _AT_EACH, _LOST = 5, 10, 0.8


class LikelyPerson(NamedTuple):
    """Somebody who explains the recordings."""

    fit: PersonFit
    # By the sandwich; zero of somebody who is at the end of an interval
    covariance: PersonCovariance


def people_as_likely(fit: PersonFit) -> list[LikelyPerson]:
    """The fit, the first, and people as likely: with one sense exact, or far off."""
    prior, unseen = fit.prior, np.array(fit.unseen)
    found = [fit]
    for index in fit.space.senses:
        exact = np.array(fit.theta)
        exact[index] = prior.scales[index - fit.space.own] - _EXACT
        if there := prior.tried(exact):
            place, slope, spent, settled = climb(prior, there, _LOOK, unseen=unseen)
            found.append(person_at(prior, place, slope, settled, spent))
    least = max(one.value for one in found) - TWO_SIDED**2 / 2
    hills = [fit, *(one for one in found[1:] if one.value >= least)]
    likely = [LikelyPerson(one, person_covariance(one)) for one in hills]
    return [*likely, *_far_off(*likely[0], least)]


def _far_off(fit: PersonFit, covariance: PersonCovariance, least: float) -> list[LikelyPerson]:
    """Who is as likely farthest along the direction of the gain that is least told, either way."""
    told = np.flatnonzero(covariance.deviations < TOLD)
    if not len(told):
        return []
    along = np.zeros(len(fit.theta))
    along[: fit.space.gain] = covariance.directions[told[-1]]
    step = TWO_SIDED * covariance.deviations[told[-1]]
    parts = ("covariance", "levels", "entries", "deviations")
    nothing = replace(covariance, **{name: 0 * getattr(covariance, name) for name in parts})
    found = (_farthest(fit, along, side * step, least) for side in (-1, 1))
    return [LikelyPerson(one, nothing) for one in found if one is not None]


def _farthest(fit: PersonFit, along: Array, step: float, least: float) -> PersonFit | None:
    """Who is as likely farthest along a direction (q,); None where the sandwich ends, `step` away.

    With twice the distance a parabola falls by four times as much.
    """
    prior, here, unseen = fit.prior, fit.prior.placed(np.array(fit.theta), fit.told), fit.unseen
    room, inside, outside, off = fit.value - least, 0.0, np.inf, step
    for _ in range(_PLACES):
        found = held_person(prior, here, along, off - inside, unseen, _AT_EACH)
        if found is not None and found[0].value >= least:
            (here, unseen), inside = found, off
            lost = max((fit.value - here.value) / room, 0.25) if room > 0 else 1.0
            if lost > _LOST:
                break
            off = inside / np.sqrt(lost)
        elif inside == 0.0:
            return None
        else:
            outside = off
        if abs(off) >= abs(outside):
            off = (inside + outside) / 2
    return person_at(prior, here, unseen, True, 0)


def entry_intervals(people: Sequence[LikelyPerson]) -> Array:
    """Intervals of 95 % of the entries of the gain (entries, 2), in their units."""
    return _united([covariance.entry_intervals(one.K) for one, covariance in people])


def level_intervals(people: Sequence[LikelyPerson]) -> Array:
    """Intervals of 95 % of all levels (l, 2), in their units."""
    return _united([covariance.level_intervals(one.levels) for one, covariance in people])


def direction_intervals(people: Sequence[LikelyPerson], ways: Array) -> Array:
    """Intervals of 95 % of combinations of the coordinates of gain or prices (k, 2).

    `ways` (k, g).
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
