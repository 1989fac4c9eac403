"""Unknowns of an output-feedback fit, their prior and start, and the objective of the search.

theta = (coordinates of a gain or of cost weights, initial states, parameters | log noise SDs)

The objective is log-likelihood + log-prior - REML term. The prior is normal about the start for
each coordinate of gain, cost weights and parameters, with a barrier at the stability boundary.
Initial states have the distribution of the states of their trials. With x a noise SD over its
expected size, the density of its logarithm is a power of that of a half-Cauchy SD (Gelman 2006),
x / (1 + x^2): far away, 0.25 nat per factor of e on either side. The expected size of a noise SD is
that which alone would explain the residuals of the start (docs/why/output_feedback.md).

Noise SDs are biased because all else is fitted too. By Laplace's method the likelihood of the noise
SDs alone, all else integrated out, is the maximum over all else minus half the log determinant of
its information: the REML term (restricted likelihood: Patterson and Thompson 1971, Cox and Reid
1987; prior: Chung et al. 2013).
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from impc.arrays import Array, IntArray, frozen
from impc.control.constraint_rows import Directions, directions
from impc.control.controller import Controller
from impc.errors import ImpcError, SolverError
from impc.inverse.laws import GainLaw, WeightLaw
from impc.inverse.problem import Problem
from impc.inverse.regulator_span import kept_to, regulators_alone
from impc.inverse.residuals import residual_only
from impc.inverse.solution_set import natural_coordinates
from impc.inverse.unknowns import Point, Unknowns
from impc.model.plant_family import plant_differential
from impc.model.riccati import is_stable, lyapunov_series
from impc.output_feedback.compiled_filter import Likelihood
from impc.output_feedback.likelihood import NoiseDirections, joint_likelihoods, prepare_filter
from impc.output_feedback.observer import Observer

# Largest absolute log noise SD: its square stays in the range of double precision.
_SQUARED = 300.0
# Curvature that is added so that steps stay finite where the objective is flat: a noise SD near
# zero, or a sense that is not used.
_FLAT = 1e-2
# Nats per factor of e by which a gain near the stability boundary amplifies noise: on the seat the
# likelihood alone is largest at that boundary, where the search makes almost no progress.
_BARRIER = 0.5
# Nats per factor of e by which a noise SD differs from its expected size. With 1 nat, simulated
# subjects with almost no sensory noise got some: 2 SDs too much on the cart.
_UNLIKE = 0.25
# Noise-free recordings have no residual: noise SDs start at this share of the outputs.
_LEAST = 1e-6


@dataclass(frozen=True)
class Request:
    """Settings of a fit."""

    observer: Observer  # which noise exists; fixed noise SDs have their values here
    recorder: Array | None = None  # (p,), initial recording noise SDs; None: of the residuals' size
    held: Sequence[str] = ()  # kinds of noise that are fixed
    spread: float = 1.0  # standard deviation of the prior
    counted: int = 0  # first sample of each trial in the likelihood


@dataclass(frozen=True)
class LikelihoodTerms:
    """Log-likelihood of all recordings at one point, with derivatives."""

    value: float  # nats
    gradient: Array  # (q,)
    information: Array  # (q, q), expected Fisher information
    scores: list[Array]  # (samples, q), gradient of each sample's log-likelihood, by trial
    trials: list[Likelihood]


class Iterate(NamedTuple):
    """Iterate of a search."""

    theta: Array  # (q,)
    identified: LikelihoodTerms  # likelihood with derivatives
    value: float  # objective, nats
    lost: float  # REML term, nats


class NoisyUnknowns:
    """Unknowns theta (q,) of one search about a point: coordinates of inverse MPC, log noise SDs.

    `levels` (l + p,): noise SDs of subject and recording at the start, by default the requested.
    """

    def __init__(self, space: Unknowns, request: Request, levels: Array | None = None) -> None:
        self.space, self.request, observer = space, request, request.observer
        size, plant = _sizes(space.unpack(space.start)), space.problem.plant
        white = size.recorder if request.recorder is None else np.asarray(request.recorder)
        #: All noise SDs at the start, and indices of the estimated ones.
        self.first = np.concatenate([observer.levels, white]) if levels is None else levels
        kinds = [*observer.kinds, *["recorder"] * len(white)]
        free = np.array([kind not in request.held for kind in kinds])
        self.moving = np.flatnonzero((self.first > 0) & free)
        every = [*observer.names(plant), *(f"recorder {name}" for name in plant.outputs)]
        #: Names of the estimated noise SDs.
        self.names = [every[index] for index in self.moving]
        self.start = np.concatenate([space.start, np.log(self.first[self.moving])])
        #: Number of coordinates of gain or cost weights; range of the initial states; number of
        #: unknowns that are not noise SDs.
        law = space.law
        self.gain = len(law.gains) if isinstance(law, GainLaw) else len(law.start)
        self.shared, self.after = space.trial.start, space.trial.stop
        self.own = len(space.start)
        #: Indices of the unknowns that are sensory noise SDs.
        self.senses = self.own + np.flatnonzero([kinds[k] == "sensory" for k in self.moving])
        #: Expected log noise SDs; whether there is a prior; sizes of noise.
        alone = np.concatenate([suggested(observer, size, 1.0, 1.0), size.recorder])
        self.scales, self.used = np.log(alone[self.moving]), bool(np.isfinite(request.spread))
        self._unlikely, self.size = np.full(len(self.scales), _UNLIKE * self.used), size
        #: Mean and inverse covariance (q, q) of the normal prior.
        self.center = self.start.copy()
        self.weights = np.diag(np.where(np.arange(len(self.start)) < self.own,
                                        request.spread**-2.0, 0.0))  # fmt: skip
        unit = space.own_unit
        for trial, mine in zip(space.problem.recordings, self._starts, strict=True):
            if len(mine):
                self.center[mine] = -np.linalg.solve(unit, trial.x0)
                driven = unit @ unit.T + size.sensory
                self.weights[np.ix_(mine, mine)] @= unit.T @ np.linalg.solve(driven, unit)

    @property
    def gain_law(self) -> GainLaw:
        """Whitened coordinates of the gain; only if a gain is searched."""
        law = self.space.law
        if not isinstance(law, GainLaw):
            raise SolverError("gain", "is that of cost weights", "fit without a structure")
        return law

    @property
    def _starts(self) -> IntArray:
        """Indices of the initial states of each trial (trials, n)."""
        return np.arange(self.shared, self.after).reshape(self.space.trials, -1)

    @property
    def origin(self) -> dict[str, Any]:
        """Numbers from which `space_at` makes the same unknowns again."""
        posed, law = self.space.problem, self.space.law
        K, S = law.given if isinstance(law, GainLaw) else law.pair(posed, law.start)
        return {
            "K": K,
            "S": S,
            "cost_weights": self.cost_weights_at(self.start),
            "starts": posed.starts,
            "logarithms": posed.logarithms,
            "levels": self.first,
        }

    def levels(self, theta: Array) -> Array:
        """All noise SDs (l + p,) at theta (q,), including zeros."""
        logarithms = theta[self.own :]
        if not np.all(np.abs(logarithms) <= _SQUARED):
            raise SolverError("noise SD", "is out of range of double precision", "start nearer")
        found = self.first.copy()
        found[self.moving] = np.exp(logarithms)
        return found

    def cost_weights_at(self, theta: Array) -> Array | None:
        """Log cost weights (count,) at theta (q,), if they are estimated."""
        return self.space.law.cost_weights(theta[self.space.controller])

    def changes(self, theta: Array) -> tuple[Array, Array]:
        """Derivatives of K (a, m, n) and S (a, m, m) by all unknowns but noise SDs, at theta."""
        return self.space.changes(theta[: self.own])

    def unpack(self, theta: Array) -> tuple[Point, Observer, Array]:
        """Gain, metric and problem at theta (q,); observer; recording noise SDs (p,)."""
        levels, split = self.levels(theta), len(self.request.observer.levels)
        person = self.request.observer.with_levels(levels[:split])
        return self.space.unpack(theta[: self.own]), person, frozen(levels[split:])

    def about(self, theta: Array) -> NoisyUnknowns:
        """The same unknowns with start, scales and prior at theta (q,)."""
        point, weights = self.space.unpack(theta[: self.own]), self.cost_weights_at(theta)
        return NoisyUnknowns(gain_space(point, weights), self.request, self.levels(theta))

    def value(self, theta: Array) -> float:
        """Log-likelihood at theta (q,) without derivatives, which is faster."""
        return sum(item.value for item in self._trials(theta, np.zeros(0, dtype=np.int64)))

    def identified(self, theta: Array) -> LikelihoodTerms:
        """Log-likelihood with derivatives at theta (q,)."""
        q, starts = len(theta), self._starts
        shared = np.delete(np.arange(q), starts.ravel())
        trials = self._trials(theta, np.concatenate([shared, starts[0]]))
        gradient, information = np.zeros(q), np.zeros((q, q))
        scores: list[Array] = []
        for own, found in zip(starts, trials, strict=True):
            mine = np.concatenate([shared, own])
            gradient[mine] += found.score.sum(axis=0)
            information[np.ix_(mine, mine)] += found.information
            score: Array = np.zeros((len(found.identified), q))
            score[:, mine] = found.score
            scores.append(score)
        value = sum(item.value for item in trials)
        return LikelihoodTerms(value, gradient, information, scores, trials)

    def _trials(self, theta: Array, columns: IntArray) -> list[Likelihood]:
        """Likelihood of each trial along some unknowns, its initial state last."""
        here, person, recorder = self.unpack(theta)
        problem, part = here.problem, theta[self.space.controller]
        controller = self.space.law.controller(problem, part, None, None)
        along, noise = self._directions(theta, controller, here, columns)
        prepared = prepare_filter(controller, person, recorder, along, noise)
        return joint_likelihoods(prepared, problem.recordings, self.request.counted)

    def _directions(
        self, theta: Array, controller: Controller, here: Point, columns: IntArray
    ) -> tuple[Directions, NoiseDirections]:
        """Directions along some unknowns; all initial states have the same scale."""
        count, starts = len(columns), self._starts.shape[1]
        levels = np.zeros((len(self.first), len(self.moving)))
        levels[self.moving, np.arange(len(self.moving))] = self.levels(theta)[self.moving]

        def along(change: Array, first: int) -> Array:
            found = np.zeros((*change.shape[:-1], len(theta)))
            found[..., first : first + change.shape[-1]] = change
            return np.ascontiguousarray(found[..., columns])

        given, family = {}, here.problem.family
        if count:
            changes = zip("KS", self.changes(theta), strict=True)
            given = {name: along(np.moveaxis(part, 0, -1), 0) for name, part in changes}
        if count and starts:
            given["x0"] = along(self.space.own_unit, self.shared)
        if count and family is not None:
            slopes, units = plant_differential(family, here.problem.logarithms), self.space.units
            for name in ("A", "B", "E", "C", "observer"):
                given[name] = along(units * getattr(slopes, name), self.after)
        lasting = NoiseDirections(along(levels, self.own), max(count - starts, 0))
        return directions(controller, count, **given), lasting

    def at(self, theta: Array) -> Iterate:
        """Evaluate the objective at theta (q,)."""
        return self.placed(theta, self.identified(theta))

    def placed(self, theta: Array, identified: LikelihoodTerms) -> Iterate:
        """Evaluate the objective at theta (q,) with a known likelihood."""
        lost = self.lost(theta, identified)
        return Iterate(theta, identified, identified.value + self.log_prior(theta) - lost, lost)

    def tried(self, theta: Array) -> Iterate | None:
        """Evaluate the objective at theta (q,); None if it is undefined or not finite."""
        try:
            there = self.at(theta)
        except ImpcError:
            return None
        return there if np.isfinite(there.value) else None

    def freed(self, along: Array) -> NoisyUnknowns:
        """Without expectation for the noise SD that is fixed along a direction (q,)."""
        freed = copy.copy(self)
        freed._unlikely = self._unlikely * (1 - np.abs(along[self.own :]))
        return freed

    def parabola(self, here: Iterate, unseen: Array) -> tuple[Array, Array]:
        """Gradient (q,) and curvature (q, q), positive definite, of the objective.

        The gradient by a log noise SD is added to its curvature, so that no step moves it by more
        than one: far from the maximum the information is too small by any factor. `unseen` (q,):
        gradient of the REML term.
        """
        slope, bend = self.slopes(here.theta)
        gradient = here.identified.gradient + slope + unseen
        curvature = here.identified.information + bend
        own = np.arange(self.own, len(gradient))
        curvature[own, own] += np.abs(gradient[own])
        return gradient, curvature + _FLAT * np.eye(len(gradient))

    def lost(self, theta: Array, identified: LikelihoodTerms) -> float:
        """REML term at theta (q,) in nats."""
        if not self.used:
            return 0.0
        own = slice(0, self.own)
        information = identified.information[own, own] + self.slopes(theta)[1][own, own]
        return float(np.linalg.slogdet(information)[1]) / 2

    def log_prior(self, theta: Array) -> float:
        """Log-prior at theta (q,), nats; minus infinity if the gain does not stabilise."""
        away = float((theta - self.center) @ self.weights @ (theta - self.center)) / 2
        off = np.abs(theta[self.own :] - self.scales)
        log_cosh = off + np.log1p(np.exp(-2 * off)) - np.log(2)
        return float(-away - self._unlikely @ log_cosh - _BARRIER * self.noise_growth(theta)[0])

    def slopes(self, theta: Array) -> tuple[Array, Array]:
        """Gradient and negative Hessian of the log-prior at theta (q,).

        The Hessian of the barrier is approximated by that of the logarithm of a distance.
        """
        own, slope = self.own, self.noise_growth(theta)[1]
        gradient = -self.weights @ (theta - self.center) - _BARRIER * slope
        turned = np.tanh(theta[own:] - self.scales)
        gradient[own:] -= self._unlikely * turned
        bend = self.weights + _BARRIER * np.outer(slope, slope)
        bend[own:, own:] += np.diag(self._unlikely * (1 - turned**2))
        return gradient, bend

    def noise_growth(self, theta: Array) -> tuple[float, Array]:
        """Log of the noise gain of the loop, relative to the start, and its gradient (q,).

        It tends to infinity at the stability boundary; cost weights never reach that. `theta` (q,).
        """
        space, law, gradient = self.space, self.space.law, np.zeros(len(theta))
        if not isinstance(law, GainLaw) or not self.used:
            return 0.0, gradient
        here = space.unpack(theta[: self.own])
        plant, driven = here.problem.plant, law.G @ law.G.T @ here.problem.plant.B.T
        closed = plant.A - plant.B @ here.K
        if not is_stable(closed, discrete=True):
            return np.inf, gradient
        X = lyapunov_series(closed, (plant.B @ driven)[None])[0]
        weight = np.asarray(np.linalg.inv(law.T @ law.T.T))
        Y = lyapunov_series(closed.T, weight[None])[0]
        size = float(np.sum(weight * X))
        moved = -plant.B @ space.changes(theta[: self.own])[0]
        family = here.problem.family
        if family is not None:
            slopes = plant_differential(family, here.problem.logarithms)
            dA, dB = (np.moveaxis(one * space.units, -1, 0) for one in (slopes.A, slopes.B))
            moved[self.after :] += dA - dB @ here.K
            gradient[self.after : self.own] = 2 * np.einsum("ij,kij->k", Y, dB @ driven)
        gradient[: self.own] += np.einsum("ij,kij->k", 2 * Y @ closed @ X, moved)
        return float(np.log(size / len(X))), gradient / size


def gain_space(point: Point, cost_weights: Array | None) -> Unknowns:
    """Unknowns of gain, or cost weights (count,) if these are estimated, about a point."""
    structure = point.problem.structure
    if cost_weights is not None and structure is not None:
        return Unknowns(point.problem, WeightLaw(structure, np.array(cost_weights)))
    kept, gains = kept_to(point.problem), None
    if kept is not None:
        T, _ = natural_coordinates(point.problem.plant, point.K)
        gains = regulators_alone(point.problem.plant, kept, T)
    return Unknowns(point.problem, GainLaw(point.problem, point.K, point.S, gains))


def space_at(problem: Problem, request: Request, origin: dict[str, Any]) -> NoisyUnknowns:
    """Unknowns about a stored `NoisyUnknowns.origin`."""
    kept = {name: np.array(value, dtype=np.float64) for name, value in origin.items()}
    point = Point(kept["K"], kept["S"], problem.at(kept["starts"], kept["logarithms"]))
    weights = None if origin["cost_weights"] is None else kept["cost_weights"]
    return NoisyUnknowns(gain_space(point, weights), request, kept["levels"])


class Sizes(NamedTuple):
    """Noise SDs each of which alone would explain the size of the residuals."""

    motor: Array  # (m,)
    process: Array  # (n,)
    sensory: Array  # (n, n), covariance of the states that motor noise of this size would cause
    recorder: Array  # (p,)


def _sizes(point: Point) -> Sizes:
    plant, scale = point.problem.plant, point.problem.output_scale
    residual = residual_only(point.problem, point.K, point.S).reshape(-1, len(plant.outputs))
    recorder = scale * np.maximum(np.sqrt(np.mean(residual**2, axis=0)), _LEAST)
    target = float(np.sqrt(np.mean((recorder / scale) ** 2)))
    columns = np.vstack([plant.B.T, np.eye(plant.n)])
    closed = plant.A - plant.B @ point.K
    spread = lyapunov_series(closed, columns[:, :, None] * columns[:, None, :])
    seen = np.einsum("pi,kij,pj->kp", plant.C, spread, plant.C) / scale**2
    each = target / np.sqrt(np.maximum(np.mean(seen, axis=1), 1e-300))
    sensed = np.mean(each[: plant.m, None, None] ** 2 * spread[: plant.m], axis=0)
    return Sizes(each[: plant.m], each[plant.m :], sensed, recorder)


def suggested(observer: Observer, size: Sizes, inside: float, sensed: float) -> Array:
    """Noise SDs of the observer's kinds that together explain the residuals."""
    _, signal, process, _, walk = observer.by_kind
    share = inside / np.sqrt(max(int(np.any(observer.motor)) + int(np.any(process)), 1))
    signals = np.sqrt(np.einsum("si,ij,sj->s", observer.C, size.sensory, observer.C))
    each = share * size.process / np.sqrt(max(int(np.count_nonzero(process)), 1))
    levels = np.concatenate([share * size.motor, signal, each, sensed * signals, walk])
    return np.where(observer.levels > 0, levels, 0.0)
