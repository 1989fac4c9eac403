"""Maximum likelihood fit of output-feedback MPC (docs/why/output_feedback.md).

The search is that of inverse MPC (`impc.inverse.minimiser`), with the Fisher information as
curvature. The REML term has no exact gradient: the search learns it along the noise SDs by
Broyden's update, and computes it by differences where it ends.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy.linalg

from impc.arrays import Array, Frozen, frozen
from impc.assess.variance_accounted_for import whiteness
from impc.attached_methods import attach
from impc.checking import checked
from impc.errors import ImpcError, InputError, SolverError
from impc.inverse.estimates import Estimate
from impc.inverse.minimiser import Prior, Rows, Stop, minimise
from impc.inverse.problem import Problem, require_riccati
from impc.inverse.starts import regulators
from impc.inverse.unknowns import Point
from impc.output_feedback.observer import LEVELS, Observer
from impc.output_feedback.unknowns import (
    Iterate,
    LikelihoodTerms,
    NoisyUnknowns,
    Request,
    gain_space,
    suggested,
)

# Lags of the whiteness test: 1 s, which shows a missed rhythm; at least this many.
_LEAST_LAGS = 10
# Evaluations of the first stage, in which the gain is fixed: with noise SDs far off, the best gain
# lies on the stability boundary, where 3 of 21 searches ended.
_FIRST = 10
# Assumed shares of the residual: process and motor noise, senses, recording. The one with the
# highest likelihood is taken. For a seat whose recording noise is 1/30 of the residual, a single
# start had not converged after 40 steps.
_SHARES = ((0.7, 0.5, 0.3), (0.3, 0.3, 0.9), (0.7, 0.1, 0.3), (0.1, 0.1, 1.0))
# Increase of the log cost weights at the second start: a low cost weight and noisy senses both
# delay the response, and a search from least squares, which assumes exact senses, may end at the
# first.
_FAR = 4.0
# If a round moves the gain farther than this (in standard deviations of the prior), coordinates and
# prior are recomputed there; second: evaluations per round.
_NEAR, _ROUND = 0.5, 30
# A second search with re-initialised sensory noise is abandoned after this many evaluations unless
# it gains this much, in nats: from four ends 18 to 90 nats too low, ten evaluations were enough.
# The likelihood has jumps of that size.
_LOOK, _HIGHER = 15, 0.5
# Promised decrease of -2 log posterior below which a search has converged: a hundredth of a
# standard error in any direction without prior, a tenth with it, as the gradient of the REML term
# is inexact.
_SETTLED, _ENOUGH = 2e-4, 1e-2
# The likelihood jumps where a later stage of a plan reaches a bound, for a seat at its limit by
# 0.5 nat within one standard error: a search that is stuck has converged below this promise.
_ROUGH = 1.0
# A further round with the REML gradient by differences is skipped if the last gained less, in nats,
# of a search that has converged and of one that has not.
_WON, _PROGRESS = 0.25, 0.02
# Close to instability the information of the first state spans 35 digits: adding this share of each
# diagonal keeps the matrix positive definite.
_ROUNDING = 1e-12
# Difference step of a log noise SD; squared step at which Broyden's update is halved.
_DIFFERENCE, _DAMPING = 0.1, 0.1


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

    if TYPE_CHECKING:  # attached by `impc.attached_methods`

        @property
        def doubts(self) -> tuple[str, ...]:
            """Sentences that qualify the result, as those of `Estimate.doubts`."""

    def __str__(self) -> str:
        gain = np.array2string(self.K, precision=4)
        levels = zip(self.space.names, self.levels, strict=True)
        noise = ", ".join(f"{name} {value:.3g}" for name, value in levels)
        return " ".join(["output feedback:", *self.doubts, f"K = {gain}, noise SDs: {noise}"])

    @property
    def standardised(self) -> Array:
        """Innovations of all trials (samples, p) over their standard deviations."""
        trials = self.identified.trials
        return np.concatenate(
            [one.innovations / np.sqrt(np.einsum("tpp->tp", one.spreads)) for one in trials]
        )

    @property
    def lags(self) -> int:
        """Samples of a second, at least ten: past that tests of prediction errors look at."""
        return max(_LEAST_LAGS, round(1 / self.problem.plant.dt))

    @property
    def whiteness(self) -> Array:
        """p-values (p,) of whiteness of the standardised innovations of each output."""
        joined = self.standardised
        return whiteness(joined, min(self.lags, len(joined) - 1))


attach(OutputFeedbackFit)


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
    # Uncertain parameters and times keep their fitted values.
    problem = found.problem.with_body_fixed().with_signals_placed()
    _require_plain(problem)
    require_riccati(problem)
    shortest = min(trial.samples for trial in problem.recordings)
    if counted >= shortest:
        left = f"got {counted}, but the shortest trial has {shortest} samples"
        raise InputError("counted", left, "use a smaller value")
    request = Request(observer, recorder, held, spread, counted)
    begun, ends, reasons = [], [], []
    for points, cost_weights in _starting_points(found, problem, request):
        try:
            begun.append(_begun(points, cost_weights, request, min(_FIRST, max_evaluations)))
        except ImpcError as error:
            reasons.append(error)
    if not begun:
        raise reasons[0]
    spent = sum(one.spent for one in begun)
    for start in sorted(begun, key=lambda one: -one.place.identified.value):
        end = _searched(start, max_evaluations - spent)
        ends.append(_retried(end, max_evaluations - spent - end.spent))
        spent += ends[-1].spent
        if ends[-1].converged and found.cost_weights is None:
            break
    end = max(ends, key=lambda one: one.place.identified.value)
    return person_at(end._replace(spent=spent))


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


class End(NamedTuple):
    """End of a search from one start."""

    space: NoisyUnknowns
    place: Iterate
    unseen: Array  # (q,), gradient of the REML term
    spent: int  # evaluations
    converged: bool


def _starting_points(
    found: Estimate, problem: Problem, request: Request
) -> list[tuple[list[Point], Array | None]]:
    """Points from which a fit starts, and their cost weights (count,), if these are estimated."""
    first = [Point(np.array(found.gain), np.array(found.metric), problem)]
    if found.cost_weights is None:
        others = [Point(np.array(one.K), np.array(one.S), problem) for one in regulators(problem)]
        return [(first, None), (others, None)]
    larger = [(first, np.array(found.cost_weights) + _FAR)] if request.observer.estimates else []
    return [(first, found.cost_weights), *larger]


def _begun(
    points: Sequence[Point], cost_weights: Array | None, request: Request, budget: int
) -> End:
    """Search with the gain fixed, from the likeliest of some points and its likeliest noise SDs."""
    spaces, reason = [], "no number"
    for point in points:
        try:
            space = NoisyUnknowns(gain_space(point, cost_weights), request)
            value = space.value(_guesses(space)[0])
        except ImpcError as error:
            reason = str(error)
            continue
        if np.isfinite(value):
            spaces.append((value, space))
    if not spaces:
        raise SolverError("observer", f"no start has a likelihood: {reason}", "set other noise SDs")
    _, space = max(spaces, key=lambda one: one[0])
    theta = max(_guesses(space), key=lambda theta: _value(space, theta))
    rest = np.eye(len(theta))[:, space.gain :]
    begin = space.at(theta)
    return End(space, *maximise(space, begin, budget, rest, np.zeros(len(theta)), _ROUGH))


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


def _searched(start: End, budget: int) -> End:
    """Search in rounds, recomputing coordinates and prior after large moves, then to the end."""
    space, place, spent = start.space, start.place, 0
    while spent < budget:
        none, part = np.zeros(len(place.theta)), min(_ROUND, budget - spent + 1)
        place, _, more, _ = maximise(space, place, part, unseen=none, promise=_ROUGH)
        spent += more - 1
        moved = np.linalg.norm((place.theta - space.center)[: space.gain])
        if moved <= _NEAR * space.request.spread:
            break
        space = space.about(place.theta)
        place, spent = space.at(space.start), spent + 1
    end = End(space, *maximise(space, place, budget - spent + 1))
    return end._replace(spent=spent + end.spent - 1)


def _retried(end: End, budget: int) -> End:
    """Higher of two ends: of a search, and of one from there with sensory noise reset."""
    space, theta = end.space, end.place.theta.copy()
    theta[space.senses] = space.scales[space.senses - space.own]
    there = space.tried(theta) if len(space.senses) and budget > _LOOK else None
    if there is None:
        return end
    look = End(space, *maximise(space, there, _LOOK, unseen=end.unseen, promise=_ROUGH))
    spent = end.spent + look.spent
    if look.place.value > end.place.value + _HIGHER:
        end = _searched(look, budget - look.spent)
        spent += end.spent
    return end._replace(spent=spent)


def person_at(end: End) -> OutputFeedbackFit:
    """Fit at the end of a search."""
    space, place = end.space, end.place
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
        end.converged,
        end.spent,
        frozen(place.theta),
        place.identified,
        frozen(end.unseen),
        space,
    )


def maximise(
    space: NoisyUnknowns,
    begin: Iterate,
    budget: int,
    along: Array | None = None,
    unseen: Array | None = None,
    promise: float | None = None,
) -> tuple[Iterate, Array, int, bool]:
    """Best iterate, its REML gradient `unseen` (q,), evaluations used, and whether converged.

    `along` (q, r): directions of the search, by default all; with `unseen` (q,) given, the REML
    gradient is never computed by differences.
    """
    way = np.eye(len(begin.theta)) if along is None else along
    promise = promise or (_ENOUGH if space.used else _SETTLED)
    differences, evaluated = space.used and unseen is None, len(space.scales)
    here, spent, u, v = begin, 1, np.zeros(way.shape[1]), np.zeros((1, 0))
    unseen = np.zeros(len(way)) if unseen is None else unseen
    while True:
        if differences and spent + evaluated < budget:
            unseen, spent = reml_slope(space, here), spent + evaluated
        model, known = Objective(space, here, way, unseen), here.value
        stop = Stop(promise, 0.0, budget - spent + 1, costly=True)
        end = minimise(model, Prior(u, v, u, 0.0), (u, v), stop)
        here, unseen, spent = model.place(end.u) or here, model.unseen, spent + model.spent
        settled = end.converged or end.promised < _ROUGH
        enough = _WON if settled else _PROGRESS
        if not differences or here.value <= known + enough or spent >= budget:
            return here, unseen, spent, settled


class Objective:
    """-2 log posterior along directions `way` (q, r) from a point, for the minimiser."""

    def __init__(self, space: NoisyUnknowns, begin: Iterate, way: Array, unseen: Array) -> None:
        self.space, self.way, self.unseen, self.here, self.spent = space, way, unseen, begin, 0
        self.begin = begin
        self.tried: dict[bytes, Iterate | None] = {np.zeros(way.shape[1]).tobytes(): begin}

    def place(self, u: Array) -> Iterate | None:
        """Iterate at `u` (r,), evaluated once; None if undefined."""
        key = u.tobytes()
        if key not in self.tried:
            self.tried[key] = self.space.tried(self.begin.theta + self.way @ u)
            self.spent += 1
        return self.tried[key]

    def rows(self, u: Array, _v: Array) -> Rows | None:
        """Factor F of the curvature, F'F, and the residual r of the gradient, F'r."""
        here = self.place(u)
        if here is None:
            return None
        self.unseen = updated_slope(self.space, self.unseen, self.here, here)
        self.here, self.tried = here, {u.tobytes(): here}  # frees memory
        gradient, curvature = self.space.parabola(here, self.unseen)
        gradient, curvature = self.way.T @ gradient, self.way.T @ curvature @ self.way
        unit = np.sqrt(np.diag(curvature))
        scaled = curvature / np.outer(unit, unit) + _ROUNDING * np.eye(len(unit))
        root = np.linalg.cholesky(scaled)
        residual = -scipy.linalg.solve_triangular(root, gradient / unit, lower=True)
        none = np.zeros((1, len(unit), 0))
        return Rows(residual[None], (root.T * unit)[None], none, -2 * here.value, 1.0)

    def value(self, u: Array, _v: Array) -> float:
        """-2 log posterior; infinite where it is undefined."""
        there = self.place(u)
        return np.inf if there is None else -2 * there.value

    def bend(self, _du: Array, _dv: Array, _share: float) -> None:
        """No geodesic acceleration: it needs a second derivative of the residual."""


def reml_slope(space: NoisyUnknowns, here: Iterate) -> Array:
    """Gradient of the REML term (q,) in nats, by differences.

    Along each noise SD all else moves on its ridge; zero where the objective is undefined.
    """
    own, slope = space.own, np.zeros(len(here.theta))
    if not space.used:
        return slope
    information = here.identified.information + space.slopes(here.theta)[1]
    ridges = -np.linalg.solve(information[:own, :own], information[:own, own:])
    ways = _DIFFERENCE * np.hstack([ridges.T, np.eye(len(slope) - own)])
    for (index, way), sign in itertools.product(enumerate(ways, own), (1, -1)):
        there = space.tried(here.theta + sign * way) if slope[index] == 0.0 else None
        if there is not None:
            slope[index] = sign * (here.lost - there.lost) / _DIFFERENCE
    return slope


def updated_slope(space: NoisyUnknowns, slope: Array, here: Iterate, there: Iterate) -> Array:
    """REML gradient (q,) after a step, by Broyden's update, damped for short steps.

    `slope` (q,).
    """
    own, slope = space.own, slope.copy()
    moved = (there.theta - here.theta)[own:]
    missed = here.lost - there.lost - float(slope[own:] @ moved)
    slope[own:] += missed * moved / (float(moved @ moved) + _DAMPING)
    # Doubling the noise halves the standard errors, and a noise SD is at most all of the noise.
    slope[own:] = np.clip(slope[own:], 0.0, float(own))
    return slope
