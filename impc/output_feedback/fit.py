"""Fit a person who senses with noise by maximum likelihood (docs/noisy-people.md, "The fit")."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.checking import checked
from impc.errors import ImpcError, InputError
from impc.inverse.coordinates import Point
from impc.inverse.gain_search import regulators
from impc.inverse.problem import require_riccati
from impc.output_feedback.observer import LEVELS
from impc.output_feedback.prior import Place, Prior
from impc.output_feedback.search import climb
from impc.output_feedback.start import (
    Asked,
    cost_weights_at,
    gain_space,
    likeliest_start,
    prior_about,
)
from impc.output_feedback.unknowns import PersonCoordinates

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem
    from impc.output_feedback.observer import Observer
    from impc.output_feedback.unknowns import LikelihoodTerms

# Likelihoods for all but the gain, or the cost weights, at first: while levels are far off the gain
# that explains most is on the border of those that stabilise, and three searches of 21 ended there.
_FIRST = 10
# A search that comes farther in a round, of the prior's deviation, begins anew from there: its
# coordinates and prior are those of a gain that is not the person's (docs/noisy-people.md).
_NEAR, _ROUND = 0.5, 30
# Likelihoods after which a search with every sense anew is given up unless it is higher by so much
# than where one ended, nats: from four ends 18 to 90 nats too low ten were enough. A likelihood
# that jumps is known to no less.
_LOOK, _HIGHER = 15, 0.5
# Logarithm by which cost weights are larger at the other start: a low cost weight and a noisy sense
# both answer late, and a search from least squares, which knows no such sense, may end at the
# first.
_FAR = 4.0


@dataclass(frozen=True)
class OutputFeedbackFit(Frozen):
    """A person behind recordings, at the largest likelihood."""

    K: Array  # Gain (m, n)
    S: Array  # Metric (m, m)
    problem: Problem  # At the initial states, as the person takes them, and the parameters
    observer: Observer  # At the levels found; a level of zero was not searched
    recorder: Array  # Standard deviations of the recorder's noise (p,), in the outputs' units
    cost_weights: Array | None  # Unknowns of the problem's structure, where it has one (count,)
    log_likelihood: float  # Of all samples of all trials, nats; without the prior
    # What the search made largest: likelihood times prior, less what levels lose, nats
    value: float
    count: int  # How many numbers were searched
    converged: bool  # Whether the search ended by itself
    evaluations: int  # Filters of all recordings with derivatives, about
    theta: Array  # The unknowns, in the coordinates of `space` (count,)
    identified: LikelihoodTerms  # What the recordings say there
    unseen: Array  # Slope that scores do not have (q,), nats: of what levels lose
    prior: Prior  # What the search was held by

    @property
    def space(self) -> PersonCoordinates:
        """The coordinates of the search."""
        return self.prior.space

    @property
    def levels(self) -> Array:
        """The levels of noise that were searched (l,), as `space.names` calls them."""
        return np.asarray(np.exp(self.theta[self.space.own :]))

    @property
    def criterion(self) -> float:
        """Akaike's: 2 count - 2 log L; the smaller the better."""
        return 2 * self.count - 2 * self.log_likelihood


@checked(spread=0, max_evaluations=1, recorder="p", counted=0)
def fit_output_feedback(
    found: Estimate,
    observer: Observer,
    *,
    recorder: Array | None = None,
    spread: float = 1.0,
    max_evaluations: int = 250,
    held: Sequence[str] = (),
    counted: int = 0,
) -> OutputFeedbackFit:
    """Fit gain or weights, levels of noise, initial states and parameters by maximum likelihood.

    Parameters
    ----------
    found : Estimate
        Where the search begins; of the method "structured", cost weights are searched and not a
        gain, of somebody who estimates from larger ones too. Of another method, where the problem
        has a structure that leaves states without a cost weight and no parameters are searched, the
        gain keeps to the span of gains that such weights have.
    observer : Observer
        What is sensed, and which noise there is: a level that is not zero is searched, from there
        and from what the residuals of the first fit suggest.
    recorder : Array, optional
        Standard deviations of the recorder's noise where a search begins (p,), in the outputs'
        units; by default of the size of the residuals.
    spread : float
        Standard deviation of a normal prior about the start, of each coordinate (`Coordinates`)
        of gain, initial states and parameters, or of each cost weight's logarithm; infinite for
        none.
    max_evaluations : int
        Filters of all recordings with derivatives, about; those of both starts together.
    held : sequence of str
        Kinds of levels that are not searched but known: of "motor", "share", "process", "sensory"
        and "walk".
    counted : int
        The first sample of each trial that is identified: those before are given, so that how a
        person began is not taken for how the person goes on.

    Returns
    -------
    PersonFit

    Raises
    ------
    InputError
        When a kind of levels is none of these, or a trial has no sample that is identified.
    SolverError
        When no start has a likelihood.

    Examples
    --------
    >>> import control
    >>> import numpy as np
    >>> import impc
    >>> from impc.output_feedback.simulation import simulate_person
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
    >>> found = impc.fit(impc.Problem(plant, bounds, 3, [trial], terminal_set=False))
    >>> likely = impc.fit_output_feedback(found, person)
    >>> likely.converged, bool(0.4 < likely.observer.motor[0] < 0.6)
    (True, True)
    """
    if unknown := [kind for kind in held if kind not in LEVELS]:
        raise InputError("held", f"got {unknown[0]!r}", f"give some of {', '.join(LEVELS)}")
    problem = found.problem.with_body_fixed()  # what is uncertain of it, as it was found
    _require_plain(problem)
    require_riccati(problem)
    shortest = min(trial.samples for trial in problem.recordings)
    if counted >= shortest:
        left = f"got {counted}, and the shortest trial has {shortest} samples"
        raise InputError("counted", left, "give fewer")
    asked = Asked(observer, recorder, held, spread, counted)
    first = [Point(np.array(found.gain), np.array(found.metric), problem)]
    starts: list[tuple[list[Point], Array | None]] = [(first, found.cost_weights)]
    if found.cost_weights is None:
        begun_at = [Point(np.array(one.K), np.array(one.S), problem) for one in regulators(problem)]
        starts.append((begun_at, None))
    elif observer.estimates:
        starts.append((first, np.array(found.cost_weights) + _FAR))
    begun, reasons = [], []
    for points, cost_weights in starts:
        try:
            prior, theta = likeliest_start(points, cost_weights, asked)
            begun.append(_levelled(prior, theta, min(_FIRST, max_evaluations)))
        except ImpcError as error:
            reasons.append(error)
    if not begun:
        raise reasons[0]
    spent, ends = sum(one.spent for one in begun), []
    for start in sorted(begun, key=lambda one: -one.place.identified.value):
        end = _searched(start, asked, max_evaluations - spent)
        ends.append(_looked_beside(end, asked, max_evaluations - spent - end.spent))
        spent += ends[-1].spent
        if ends[-1].settled and found.cost_weights is None:
            break
    end = max(ends, key=lambda one: one.place.identified.value)
    return person_at(end.prior, end.place, end.unseen, end.settled, spent)


def _require_plain(problem: Problem) -> None:
    """Refuse what the likelihood has no terms for."""
    gaps = any(trial.has_gaps for trial in problem.recordings)
    for there, what, remedy in (
        (gaps, "outputs with missing samples", "cut the trials there"),
        (bool(problem.offsets), "unknown offsets", "take them out of the recordings"),
        (len(problem.measured) > len(problem.plant.outputs), "commands", "leave them out"),
        (problem.plant.ahead > 0, "targets known ahead", "give a plant without preview"),
    ):
        if there:
            raise InputError("problem", f"has {what}, which this fit does not know", remedy)


class _End(NamedTuple):
    """Where a search has come to from one start."""

    prior: Prior
    place: Place
    unseen: Array
    spent: int
    settled: bool


def _levelled(prior: Prior, theta: Array, budget: int) -> _End:
    """The first likelihoods from theta (q,), in which the gain stands."""
    rest, none = np.eye(len(theta))[:, prior.space.gain :], np.zeros(len(theta))
    return _End(prior, *climb(prior, prior.at(theta), budget, rest, none))


def _looked_beside(end: _End, asked: Asked, budget: int) -> _End:
    """The higher end, of a search and of one from where it ended with every sense anew."""
    prior, theta = end.prior, end.place.theta.copy()
    senses = prior.space.senses
    theta[senses] = prior.scales[senses - prior.space.own]
    there = prior.tried(theta) if len(senses) and budget > _LOOK else None
    if there is None:
        return end
    there, unseen, spent, _ = climb(prior, there, _LOOK, unseen=end.unseen)
    if there.value <= end.place.value + _HIGHER:
        return end._replace(spent=end.spent + spent)
    beside = _searched(_End(prior, there, unseen, 0, False), asked, budget - spent)
    return beside._replace(spent=end.spent + spent + beside.spent)


def _searched(start: _End, asked: Asked, budget: int) -> _End:
    """Climb in rounds, coordinates and prior made anew where one went far, and then to the end."""
    prior, place, spent = start.prior, start.place, 0
    while spent < budget:
        none, part = np.zeros(len(place.theta)), min(_ROUND, budget - spent + 1)
        place, _, more, _ = climb(prior, place, part, unseen=none)
        spent += more - 1
        if np.linalg.norm((place.theta - prior.center)[: prior.space.gain]) <= _NEAR * asked.spread:
            break
        there, cost_weights = (
            prior.space.unpack(place.theta),
            cost_weights_at(prior.space, place.theta),
        )
        own = gain_space(there.point, cost_weights)
        parts = there.observer, there.recorder, asked.held, asked.counted
        prior = prior_about(PersonCoordinates(own, *parts), asked)
        place, spent = prior.at(prior.space.start), spent + 1
    place, unseen, more, settled = climb(prior, place, budget - spent + 1)
    return _End(prior, place, unseen, spent + more - 1, settled)


def person_at(
    prior: Prior, place: Place, unseen: Array, settled: bool, spent: int
) -> OutputFeedbackFit:
    """What is said of a person where a search has come to; `unseen` (q,)."""
    space = prior.space
    person, cost_weights = space.unpack(place.theta), cost_weights_at(space, place.theta)
    return OutputFeedbackFit(
        frozen(person.point.K),
        frozen(person.point.S),
        person.point.problem,
        person.observer,
        person.recorder,
        None if cost_weights is None else frozen(cost_weights),
        place.identified.value,
        place.value,
        len(place.theta),
        settled,
        spent,
        frozen(place.theta),
        place.identified,
        frozen(unseen),
        prior,
    )
