"""A person who senses with noise, by maximum likelihood.

The search starts from a fit that takes all that it does not explain for noise in the recorder, or
from a regulator by Bryson's rule where that is likelier, with levels that what it leaves suggests,
and climbs from there (`likelihood_search`; docs/noisy-people.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.checking import checked
from impc.errors import ImpcError, InputError, SolverError
from impc.inverse.coordinates import Coordinates, Point
from impc.inverse.gain_search import bryson_starts
from impc.inverse.likelihood_search import Prior, climb
from impc.inverse.person_coordinates import PersonCoordinates
from impc.inverse.regulator_span import kept_to
from impc.inverse.residuals import residual_only
from impc.inverse.structured_search import PriceCoordinates
from impc.model.observer import LEVELS
from impc.model.riccati import lyapunov_series

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.inverse.estimates import Estimate
    from impc.inverse.person_coordinates import Told
    from impc.inverse.problem import Problem
    from impc.model.observer import Observer

__all__ = ["PersonFit", "fit_person"]

# Of the residual, shares that a search begins with: inside the loop, of the senses, the recorder's.
# The likeliest is taken. On a seat whose recorder has a thirtieth of the residual the search had
# not ended after 40 steps (docs/noisy-people.md).
_STARTS = ((0.7, 0.5, 0.3), (0.3, 0.3, 0.9), (0.7, 0.1, 0.3), (0.1, 0.1, 1.0))
# Likelihoods for all but the gain, or the prices, at first: while levels are far off the gain that
# explains most is on the border of those that stabilise, and three searches of 21 ended there.
_FIRST = 10
# A search that comes farther in a round, of the prior's deviation, begins anew from there: its
# coordinates and prior are those of a gain that is not the person's (docs/noisy-people.md).
_NEAR, _ROUND = 0.5, 30
# Recorded exactly, a residual has no size: its levels begin at this share of the outputs.
_LEAST = 1e-6


@dataclass(frozen=True)
class PersonFit(Frozen):
    """A person behind recordings, at the largest likelihood.

    Attributes
    ----------
    K, S : Array
        Gain (m, n) and metric (m, m).
    problem : Problem
        At the initial states, as the person takes them, and the parameters.
    observer : Observer
        At the levels found; a level of zero was not searched.
    recorder : Array
        Standard deviations of the recorder's noise (p,), in the outputs' units.
    prices : Array or None
        Unknowns of the problem's structure, where it has one (count,).
    log_likelihood : float
        Of all samples of all trials, nats; without the prior.
    value : float
        What the search made largest: likelihood times prior, less what levels lose, nats.
    count : int
        How many numbers were searched.
    converged : bool
        Whether the search ended by itself.
    evaluations : int
        Filters of all recordings with derivatives.
    theta : Array
        The unknowns, in the coordinates of `space` (count,).
    told : Told
        What the recordings say there.
    losing : Array
        Slope of what levels lose because all else is fitted to the same noise (levels,), nats.
    prior : Prior
        What the search was held by.
    """

    K: Array
    S: Array
    problem: Problem
    observer: Observer
    recorder: Array
    prices: Array | None
    log_likelihood: float
    value: float
    count: int
    converged: bool
    evaluations: int
    theta: Array
    told: Told
    losing: Array
    prior: Prior

    @property
    def space(self) -> PersonCoordinates:
        """The coordinates of the search."""
        return self.prior.space

    @property
    def criterion(self) -> float:
        """Akaike's: 2 count - 2 log L; the smaller the better."""
        return 2 * self.count - 2 * self.log_likelihood


@checked(spread=0, max_evaluations=1, recorder="p")
def fit_person(
    found: Estimate,
    observer: Observer,
    *,
    recorder: Array | None = None,
    spread: float = 1.0,
    max_evaluations: int = 150,
    held: Sequence[str] = (),
) -> PersonFit:
    """Fit gain or prices, levels of noise, initial states and parameters by maximum likelihood.

    Parameters
    ----------
    found : Estimate
        Where the search begins; of the method "structured", prices are searched and not a gain.
        Of another method, where the problem has a structure that leaves states without a price and
        no parameters are searched, the gain keeps to the span of gains that such weights have.
    observer : Observer
        What is sensed, and which noise there is: a level that is not zero is searched, from there
        and from what the residuals of the first fit suggest.
    recorder : Array, optional
        Standard deviations of the recorder's noise where a search begins (p,), in the outputs'
        units; by default of the size of the residuals.
    spread : float
        Standard deviation of a normal prior about the start, of each coordinate (`Coordinates`)
        of gain, initial states and parameters, or of each price's logarithm; infinite for none.
    max_evaluations : int
        Filters of all recordings with derivatives, at most.
    held : sequence of str
        Kinds of levels that are not searched but known: of "motor", "share", "process", "sensory"
        and "walk".

    Returns
    -------
    PersonFit

    Raises
    ------
    InputError
        When a kind of levels is none of these.
    SolverError
        When no start has a likelihood.

    Examples
    --------
    >>> import control
    >>> import numpy as np
    >>> import impc
    >>> from impc.control.noisy_person import simulate_person
    >>> system = control.ss(
    ...     [[1, 0.1], [0, 0.9]], [[0, 0], [0.1, 0.1]], [[1, 0]], 0, 0.1,
    ...     states=["x", "v"], inputs=["u", "push"],
    ... )
    >>> plant = impc.Plant(system, ["u"])
    >>> bounds = impc.Bounds(plant, u_min=-3, u_max=3)
    >>> law = impc.Controller(plant, impc.Weights(np.eye(2), 1), bounds, 3, terminal_set=False)
    >>> person = impc.Observer(plant, ["x"], motor=0.5, sensory=0.05)
    >>> push = np.repeat([1.0, -1.0, 0.0, 1.0, 0.0, -1.0, 1.0, -1.0], 50)
    >>> y = simulate_person(law, person, push, recorder=0.01).outputs
    >>> trial = impc.Recording(plant, y, push)
    >>> found = impc.estimate(impc.Problem(plant, bounds, 3, [trial], terminal_set=False))
    >>> likely = impc.fit_person(found, person)
    >>> likely.converged, bool(0.4 < likely.observer.motor[0] < 0.6)
    (True, True)
    """
    if unknown := [kind for kind in held if kind not in LEVELS]:
        raise InputError("held", f"got {unknown[0]!r}", f"give some of {', '.join(LEVELS)}")
    problem = found.problem
    points = [Point(np.array(found.gain), np.array(found.metric), problem)]
    if found.prices is None:
        points += [Point(K, S, problem) for K, S in bryson_starts(problem)]
    space, size = _begun(points, found.prices, observer, recorder, held)
    prior = _prior(space, observer, size, spread)
    place = prior.at(max(_guesses(space, observer, size, recorder), key=partial(_value, space)))
    rest, none = np.eye(len(place.theta))[:, space.gain :], np.zeros(len(prior.scales))
    place, _, spent, _ = climb(prior, place, min(_FIRST, max_evaluations), rest, none)
    while spent < max_evaluations:
        place, _, more, _ = climb(prior, place, _ROUND, losing=none)
        spent += more - 1
        if np.linalg.norm((place.theta - prior.center)[: space.gain]) <= _NEAR * spread:
            break
        there = space.unpack(place.theta)
        own = _space(there.point, _prices(space, place.theta))
        space = PersonCoordinates(own, there.observer, there.recorder, held)
        prior = _prior(space, observer, _sizes(there.point), spread)
        place, spent = prior.at(space.start), spent + 1
    place, losing, more, settled = climb(prior, place, max_evaluations - spent + 1)
    spent += more - 1
    theta, told = place.theta, place.told
    person, prices = space.unpack(theta), _prices(space, theta)
    return PersonFit(
        frozen(person.point.K),
        frozen(person.point.S),
        person.point.problem,
        person.observer,
        person.recorder,
        None if prices is None else frozen(prices),
        told.value,
        place.value,
        len(theta),
        settled,
        spent,
        frozen(theta),
        told,
        frozen(losing),
        prior,
    )


def _begun(
    points: list[Point],
    prices: Array | None,
    observer: Observer,
    recorder: Array | None,
    held: Sequence[str],
) -> tuple[PersonCoordinates, _Sizes]:
    """Coordinates about the point whose first guess of the levels is the likeliest, and sizes."""
    found, highest, reason = None, -np.inf, "no number"
    for point in points:
        try:
            size = _sizes(point)
            white = size.recorder if recorder is None else np.asarray(recorder)
            space = PersonCoordinates(_space(point, prices), observer, white, held)
            value = space.value(_guesses(space, observer, size, recorder)[0])
        except ImpcError as error:
            reason = str(error)
            continue
        if value > highest:
            found, highest = (space, size), value
    if found is None:
        raise SolverError("person", f"no start has a likelihood: {reason}", "give other levels")
    return found


def _guesses(
    space: PersonCoordinates, observer: Observer, size: _Sizes, recorder: Array | None
) -> list[Array]:
    """Unknowns (q,) where a search may begin: shares of what is left, then the levels given."""
    guesses = []
    for inside, sensed, recorded in _STARTS if recorder is None else ():
        levels = _suggested(observer, size, inside, sensed)
        log = np.log(np.concatenate([levels, recorded * size.recorder])[space.moving])
        guesses.append(np.concatenate([space.space.start, log]))
    return [*guesses, space.start]


def _value(space: PersonCoordinates, theta: Array) -> float:
    """Log-likelihood at theta (q,); minus infinity where there is none."""
    try:
        return space.value(theta)
    except ImpcError:
        return -np.inf


def _space(point: Point, prices: Array | None) -> Coordinates:
    structure = point.problem.structure
    if prices is not None and structure is not None:
        return PriceCoordinates(point.problem, structure, np.array(prices))
    return Coordinates(point.problem, point.K, point.S, kept_to(point.problem))


def _prices(space: PersonCoordinates, theta: Array) -> Array | None:
    own = space.space
    return own.unknowns(theta[: space.own]) if isinstance(own, PriceCoordinates) else None


def _prior(space: PersonCoordinates, observer: Observer, size: _Sizes, spread: float) -> Prior:
    alone = np.concatenate([_suggested(observer, size, 1.0, 1.0), size.recorder])
    return Prior(space, spread, np.log(alone[space.moving]), size.sensory)


@dataclass(frozen=True)
class _Sizes:
    """Levels of which each alone would make residuals of the size that there is."""

    motor: Array
    process: Array
    sensory: Array
    recorder: Array


def _sizes(point: Point) -> _Sizes:
    plant, scale = point.problem.plant, point.problem.output_scale
    residual = residual_only(point.problem, point.K, point.S).reshape(-1, len(plant.outputs))
    recorder = scale * np.maximum(np.sqrt(np.mean(residual**2, axis=0)), _LEAST)
    target = float(np.sqrt(np.mean((recorder / scale) ** 2)))
    closed = plant.A - plant.B @ point.K
    columns = np.vstack([plant.B.T, np.eye(plant.n)])
    spread = lyapunov_series(closed, columns[:, :, None] * columns[:, None, :])
    seen = np.einsum("pi,kij,pj->kp", plant.C, spread, plant.C) / scale**2
    each = target / np.sqrt(np.maximum(np.mean(seen, axis=1), 1e-300))
    sensed = np.mean(each[: plant.m, None, None] ** 2 * spread[: plant.m], axis=0)
    return _Sizes(each[: plant.m], each[plant.m :], sensed, recorder)


def _suggested(observer: Observer, size: _Sizes, inside: float, sensed: float) -> Array:
    """Levels of the observer's kinds that share what the first fit leaves."""
    moved = int(np.any(observer.motor)) + int(np.any(observer.process))
    share = inside / np.sqrt(max(moved, 1))
    signals = np.sqrt(np.einsum("si,ij,sj->s", observer.C, size.sensory, observer.C))
    suggested = {
        "motor": share * size.motor,
        "process": share * size.process / np.sqrt(max(int(np.count_nonzero(observer.process)), 1)),
        "sensory": sensed * signals,
    }
    parts = [suggested.get(name, observer.level(name)) for name in LEVELS]
    levels: Array = np.concatenate(parts)
    return np.where(observer.levels > 0, levels, 0.0)
