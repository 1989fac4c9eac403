"""Maximum likelihood fit of output-feedback MPC (docs/why/output_feedback.md)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.checking import checked
from impc.errors import ImpcError, InputError, SolverError
from impc.inverse.problem import require_riccati
from impc.output_feedback.observer import LEVELS
from impc.output_feedback.search import ROUGH, maximise
from impc.output_feedback.unknowns import (
    Iterate,
    NoisyUnknowns,
    Request,
    gain_space,
    starting_points,
    suggested,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem
    from impc.inverse.unknowns import Point
    from impc.output_feedback.observer import Observer
    from impc.output_feedback.unknowns import LikelihoodTerms

# Evaluations of the first stage, in which the gain is fixed: with noise SDs far off, the best gain
# lies on the stability boundary, where 3 of 21 searches ended.
_FIRST = 10
# Assumed shares of the residual: process and motor noise, senses, recording. The one with the
# highest likelihood is taken. For a seat whose recording noise is 1/30 of the residual, a single
# start had not converged after 40 steps.
_SHARES = ((0.7, 0.5, 0.3), (0.3, 0.3, 0.9), (0.7, 0.1, 0.3), (0.1, 0.1, 1.0))
# If a round moves the gain farther than this (in standard deviations of the prior), coordinates and
# prior are recomputed there; second: evaluations per round.
_NEAR, _ROUND = 0.5, 30
# A second search with re-initialised sensory noise is abandoned after this many evaluations unless
# it gains this much, in nats: from four ends 18 to 90 nats too low, ten evaluations were enough.
# The likelihood has jumps of that size.
_LOOK, _HIGHER = 15, 0.5


@dataclass(frozen=True)
class OutputFeedbackFit(Frozen):
    """Maximum likelihood fit of output-feedback MPC."""

    K: Array  # (m, n), gain
    S: Array  # (m, m), metric
    problem: Problem  # at the fitted initial states (as the subject estimates them) and parameters
    observer: Observer  # with the fitted noise SDs; those that are zero were not estimated
    recorder: Array  # (p,), standard deviations of the recording noise, in the outputs' units
    cost_weights: Array | None  # (count,), log cost weights of the problem's structure, if any
    log_likelihood: float  # of all samples of all trials, nats, without the prior
    value: float  # objective: log-likelihood + log-prior - correction for the noise SDs, nats
    count: int  # number of estimated unknowns
    converged: bool  # whether the search converged
    evaluations: int  # approximate number of likelihood evaluations with derivatives
    theta: Array  # (count,), unknowns in the coordinates of `space`
    identified: LikelihoodTerms  # likelihood with derivatives at `theta`
    unseen: Array  # (q,), gradient of the correction for the noise SDs, nats
    space: NoisyUnknowns  # coordinates and prior of the search

    @property
    def levels(self) -> Array:
        """Fitted noise SDs (l,), named by `space.names`."""
        return np.asarray(np.exp(self.theta[self.space.own :]))

    @property
    def criterion(self) -> float:
        """Akaike information criterion, 2 count - 2 log L; smaller is better."""
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
    """Fit gain or weights, noise SDs, initial states and parameters by maximum likelihood.

    Parameters
    ----------
    found : Estimate
        Starting point. For the method "structured" cost weights are estimated instead of a gain,
        for an observer with an estimator also from larger ones. For other methods, if the problem
        has a structure that leaves states unpenalised and no parameters are fitted, the gain stays
        in the span of gains of such weights.
    observer : Observer
        Sensed signals and noise: standard deviations above zero are estimated, starting from these
        values and from values suggested by the residuals of the first fit.
    recorder : array_like, optional
        Initial standard deviations of the recording noise (p,), in the outputs' units; by default
        of the size of the residuals.
    spread : float
        Standard deviation of the normal prior about the start: of each coordinate of gain, initial
        states and parameters, or of each log cost weight; infinite for no prior.
    max_evaluations : int
        Approximate budget of likelihood evaluations with derivatives, for both starts together.
    held : sequence of str
        Kinds of noise that are fixed instead of estimated: of "motor", "share", "process",
        "sensory" and "walk".
    counted : int
        Index of the first sample of each trial in the likelihood; earlier samples are conditioned
        on, which excludes the start of a movement.

    Returns
    -------
    OutputFeedbackFit

    Raises
    ------
    InputError
        If a name in `held` is unknown, or a trial has no sample after `counted`.
    SolverError
        If the likelihood is undefined at every start.

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
    problem = found.problem.with_body_fixed()  # uncertain parameters keep their fitted values
    _require_plain(problem)
    require_riccati(problem)
    shortest = min(trial.samples for trial in problem.recordings)
    if counted >= shortest:
        left = f"got {counted}, but the shortest trial has {shortest} samples"
        raise InputError("counted", left, "use a smaller value")
    request = Request(observer, recorder, held, spread, counted)
    begun, reasons = [], []
    for points, cost_weights in starting_points(found, problem, request):
        try:
            space, theta = _likeliest_start(points, cost_weights, request)
            # First stage: the gain is fixed.
            rest, none = np.eye(len(theta))[:, space.gain :], np.zeros(len(theta))
            budget = min(_FIRST, max_evaluations)
            begun.append(_End(space, *maximise(space, space.at(theta), budget, rest, none, ROUGH)))
        except ImpcError as error:
            reasons.append(error)
    if not begun:
        raise reasons[0]
    spent, ends = sum(one.spent for one in begun), []
    for start in sorted(begun, key=lambda one: -one.place.identified.value):
        end = _searched(start, max_evaluations - spent)
        ends.append(_retried(end, max_evaluations - spent - end.spent))
        spent += ends[-1].spent
        if ends[-1].settled and found.cost_weights is None:
            break
    end = max(ends, key=lambda one: one.place.identified.value)
    return person_at(end.space, end.place, end.unseen, end.settled, spent)


def _require_plain(problem: Problem) -> None:
    """Reject problems with features that the likelihood does not support."""
    gaps = any(trial.has_gaps for trial in problem.recordings)
    for there, what, remedy in (
        (gaps, "outputs with missing samples", "cut the trials there"),
        (bool(problem.signal_errors), "unknown errors of signals", "correct the recordings"),
        (len(problem.measured) > len(problem.plant.outputs), "commands", "leave them out"),
        (problem.plant.ahead > 0, "targets known in advance", "use a plant without preview"),
    ):
        if there:
            raise InputError("problem", f"has {what}, which this fit does not support", remedy)


def _likeliest_start(
    points: Sequence[Point], cost_weights: Array | None, request: Request
) -> tuple[NoisyUnknowns, Array]:
    """NoisyUnknowns about the likeliest of some points, and their likeliest start (q,)."""
    found, highest, reason = None, -np.inf, "no number"
    for point in points:
        try:
            space = NoisyUnknowns(gain_space(point, cost_weights), request)
            guesses = _guesses(space)
            value = space.value(guesses[0])
        except ImpcError as error:
            reason = str(error)
            continue
        if value > highest:
            found, highest = (space, guesses), value
    if found is None:
        raise SolverError("observer", f"no start has a likelihood: {reason}", "set other noise SDs")
    space, guesses = found
    return space, max(guesses, key=lambda theta: _value(space, theta))


def _guesses(space: NoisyUnknowns) -> list[Array]:
    """Possible starting points (q,): shares of the residual, then the given noise SDs."""
    guesses, size, request = [], space.size, space.request
    for inside, sensed, recorded in _SHARES if request.recorder is None else ():
        levels = suggested(request.observer, size, inside, sensed)
        log = np.log(np.concatenate([levels, recorded * size.recorder])[space.moving])
        guesses.append(np.concatenate([space.space.start, log]))
    return [*guesses, space.start]


def _value(space: NoisyUnknowns, theta: Array) -> float:
    """Log-likelihood at theta (q,); minus infinity if undefined."""
    try:
        return space.value(theta)
    except ImpcError:
        return -np.inf


class _End(NamedTuple):
    """End of a search from one start."""

    space: NoisyUnknowns
    place: Iterate
    unseen: Array
    spent: int
    settled: bool


def _retried(end: _End, budget: int) -> _End:
    """Higher of two ends: of a search, and of one from there with sensory noise reset."""
    space, theta = end.space, end.place.theta.copy()
    theta[space.senses] = space.scales[space.senses - space.own]
    there = space.tried(theta) if len(space.senses) and budget > _LOOK else None
    if there is None:
        return end
    there, unseen, spent, _ = maximise(space, there, _LOOK, unseen=end.unseen, promise=ROUGH)
    if there.value <= end.place.value + _HIGHER:
        return end._replace(spent=end.spent + spent)
    beside = _searched(_End(space, there, unseen, 0, False), budget - spent)
    return beside._replace(spent=end.spent + spent + beside.spent)


def _searched(start: _End, budget: int) -> _End:
    """Search in rounds, recomputing coordinates and prior after large moves, then to the end."""
    space, place, spent = start.space, start.place, 0
    while spent < budget:
        none, part = np.zeros(len(place.theta)), min(_ROUND, budget - spent + 1)
        place, _, more, _ = maximise(space, place, part, unseen=none, promise=ROUGH)
        spent += more - 1
        moved = np.linalg.norm((place.theta - space.center)[: space.gain])
        if moved <= _NEAR * space.request.spread:
            break
        space = space.about(place.theta)
        place, spent = space.at(space.start), spent + 1
    place, unseen, more, settled = maximise(space, place, budget - spent + 1)
    return _End(space, place, unseen, spent + more - 1, settled)


def person_at(
    space: NoisyUnknowns, place: Iterate, unseen: Array, settled: bool, spent: int
) -> OutputFeedbackFit:
    """Fit at the current iterate; `unseen` (q,)."""
    point, observer, recorder = space.unpack(place.theta)
    weights = space.cost_weights_at(place.theta)
    return OutputFeedbackFit(
        frozen(point.K),
        frozen(point.S),
        point.problem,
        observer,
        recorder,
        None if weights is None else frozen(weights),
        place.identified.value,
        place.value,
        len(place.theta),
        settled,
        spent,
        frozen(place.theta),
        place.identified,
        frozen(unseen),
        space,
    )
