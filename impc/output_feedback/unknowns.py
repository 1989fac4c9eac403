"""Unknowns of an output-feedback fit: those of a gain or of weights, then log noise SDs.

theta = (coordinates of `Coordinates` or `WeightCoordinates` | log noise SDs that are estimated)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, frozen
from impc.control.constraint_rows import directions
from impc.errors import SolverError
from impc.inverse.problem import controller_for
from impc.inverse.structured_search import WeightCoordinates
from impc.model.bounds import bound_rows
from impc.model.plant_family import plant_differential
from impc.model.riccati import is_stable, lyapunov_series, stabilises
from impc.output_feedback.likelihood import NoiseDirections, joint_likelihoods, prepare_filter
from impc.output_feedback.observer import LEVELS

if TYPE_CHECKING:
    from collections.abc import Collection

    from impc.control.constraint_rows import Directions
    from impc.control.controller import Controller
    from impc.inverse.coordinates import Coordinates
    from impc.inverse.unknowns import Point
    from impc.output_feedback.compiled_filter import Likelihood
    from impc.output_feedback.observer import Observer

# Largest absolute log noise SD: its square stays in the range of double precision.
_SQUARED = 300.0


@dataclass(frozen=True)
class Person:
    """Controller and noise at one point of a search."""

    point: Point  # gain, metric, and the problem at initial states and parameters
    observer: Observer  # with its noise SDs
    recorder: Array  # (p,), recording noise SDs


@dataclass(frozen=True)
class LikelihoodTerms:
    """Log-likelihood of all recordings at one point, with derivatives."""

    value: float  # nats
    gradient: Array  # (q,)
    information: Array  # (q, q), expected Fisher information
    scores: list[Array]  # (samples, q), gradient of each sample's log-likelihood, by trial
    trials: list[Likelihood]


class PersonCoordinates:
    """Unknowns of one search; `recorder` (p,)."""

    def __init__(
        self,
        space: Coordinates,
        observer: Observer,
        recorder: Array,
        held: Collection[str] = (),
        counted: int = 0,
    ) -> None:
        self.space, self.observer, self.counted = space, observer, counted
        self.first = np.concatenate([observer.levels, recorder])
        kinds = [kind for kind in LEVELS for _ in observer.level(kind)]
        free = np.array([*(kind not in held for kind in kinds), *[True] * len(recorder)])
        self.moving = np.flatnonzero((self.first > 0) & free)
        self.start = np.concatenate([space.start, np.log(self.first[self.moving])])
        #: Number of coordinates of gain or cost weights; range of the initial states; number of
        #: unknowns that are not noise SDs.
        self.gain = int(space.ends[0])
        self.shared, self.after = int(space.ends[1]), int(space.ends[2])
        self.own = len(space.start)
        sensed = np.array([*(kind == "sensory" for kind in kinds), *[False] * len(recorder)])
        #: Indices of the unknowns that are sensory noise SDs.
        self.senses = self.own + np.flatnonzero(sensed[self.moving])

    @property
    def names(self) -> list[str]:
        """Names of the estimated noise SDs."""
        plant = self.space.problem.plant
        every = [*self.observer.names(plant), *(f"recorder {name}" for name in plant.outputs)]
        return [every[index] for index in self.moving]

    def levels(self, theta: Array) -> Array:
        """All noise SDs (levels + p,) at theta (q,), including zeros."""
        logarithms = theta[self.own :]
        if not np.all(np.abs(logarithms) <= _SQUARED):
            raise SolverError("noise SD", "is out of range of double precision", "start nearer")
        found = self.first.copy()
        found[self.moving] = np.exp(logarithms)
        return found

    def changes(self, theta: Array) -> tuple[Array, Array]:
        """Derivatives of K (a, m, n) and S (a, m, m) by all unknowns but noise SDs, at theta."""
        return self.space.changes(self.space.unpack(theta[: self.own]), theta[: self.own])

    def unpack(self, theta: Array) -> Person:
        """Controller and noise at theta (q,)."""
        levels = self.levels(theta)
        split = len(self.observer.levels)
        person = self.observer.with_levels(levels[:split])
        return Person(self.space.unpack(theta[: self.own]), person, frozen(levels[split:]))

    def value(self, theta: Array) -> float:
        """Log-likelihood at theta (q,) without derivatives, which is faster."""
        person = self.unpack(theta)
        nothing = _Moved(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), 0)
        return sum(item.value for item in self._trials(theta, person, [nothing]))

    def identified(self, theta: Array) -> LikelihoodTerms:
        """Log-likelihood with derivatives at theta (q,)."""
        person, q = self.unpack(theta), len(theta)
        columns = [self._columns(trial) for trial in range(self.space.trials)]
        trials = self._trials(theta, person, columns)
        gradient, information = np.zeros(q), np.zeros((q, q))
        scores: list[Array] = []
        for moved, found in zip(columns, trials, strict=True):
            gradient[moved.all] += found.score.sum(axis=0)
            information[np.ix_(moved.all, moved.all)] += found.information
            score: Array = np.zeros((len(found.identified), q))
            score[:, moved.all] = found.score
            scores.append(score)
        value = sum(item.value for item in trials)
        return LikelihoodTerms(value, gradient, information, scores, trials)

    def noise_growth(self, theta: Array) -> tuple[float, Array]:
        """Log of the noise gain of the loop, relative to the start, and its gradient (q,).

        It tends to infinity at the stability boundary; cost weights never reach that. `theta` (q,).
        """
        space, gradient = self.space, np.zeros(len(theta))
        if isinstance(space, WeightCoordinates):
            return 0.0, gradient
        here = space.unpack(theta[: self.own])
        plant = here.problem.plant
        closed = plant.A - plant.B @ here.K
        if not is_stable(closed, discrete=True):
            return np.inf, gradient
        X = lyapunov_series(closed, (plant.B @ space.G @ space.G.T @ plant.B.T)[None])[0]
        weight = np.asarray(np.linalg.inv(space.T @ space.T.T))
        Y = lyapunov_series(closed.T, weight[None])[0]
        size = float(np.sum(weight * X))
        dK, _ = space.changes(here, theta[: self.own])
        moved = -plant.B @ dK
        turned = np.zeros_like(moved)
        family = here.problem.family
        if family is not None:
            differential = plant_differential(family, here.problem.logarithms)
            mine = slice(self.own - len(family.names), self.own)
            dA, dB = (
                np.moveaxis(part * space.units, -1, 0) for part in (differential.A, differential.B)
            )
            moved[mine] += dA - dB @ here.K
            turned[mine] = dB @ space.G @ space.G.T @ plant.B.T
        change = np.einsum("ij,kij->k", 2 * Y @ closed @ X, moved)
        change += 2 * np.einsum("ij,kij->k", Y, turned)
        gradient[: self.own] = change / size
        return float(np.log(size / len(X))), gradient

    def _columns(self, trial: int) -> _Moved:
        """Unknowns that affect one trial: its own initial state comes last."""
        start = np.arange(self.shared, self.after)
        n = self.space.n if len(start) else 0
        shared = np.delete(np.arange(len(self.start)), start)
        mine = start[trial * n : (trial + 1) * n]
        return _Moved(np.concatenate([shared, mine]), shared, n)

    def _trials(self, theta: Array, person: Person, columns: list[_Moved]) -> list[Likelihood]:
        here = person.point
        problem, plant = here.problem, here.problem.plant
        bounded = problem.terminal_set or len(bound_rows(problem.bounds, plant).b) > 0
        if bounded and not stabilises(plant, here.K):
            raise SolverError("gain", "does not stabilise the plant", "use another start")
        controller = controller_for(problem, here.K, here.S)
        # All initial states have the same scale, so one law serves all trials.
        along, noise = self._directions(theta, controller, person, columns[0])
        prepared = prepare_filter(controller, person.observer, person.recorder, along, noise)
        return joint_likelihoods(prepared, problem.recordings, self.counted)

    def _directions(
        self, theta: Array, controller: Controller, person: Person, moved: _Moved
    ) -> tuple[Directions, NoiseDirections]:
        plant, count = controller.plant, len(moved.all)
        given: dict[str, Array] = {}
        levels = np.zeros((len(self.first), count))
        dC = np.zeros((*plant.C.shape, count))
        if count:
            dK, dS = self.space.changes(person.point, theta[: self.own])
            own = moved.shared[moved.shared < self.own]
            for name, change in (("K", dK), ("S", dS)):
                given[name] = np.zeros((*change.shape[1:], count))
                given[name][..., : len(own)] = np.moveaxis(change[own], 0, -1)
            at = np.arange(len(own), len(moved.shared))
            levels[self.moving, at] = self.levels(theta)[self.moving]
            given["x0"] = np.zeros((plant.n, count))
            given["x0"][:, count - moved.start :] = self.space.own_unit[:, : moved.start]
            family = person.point.problem.family
            if family is not None:
                differential = plant_differential(family, person.point.problem.logarithms)
                width = len(family.names)
                mine = slice(len(own) - width, len(own))
                for name in ("A", "B", "E"):
                    change = getattr(differential, name)
                    given[name] = np.zeros((*change.shape[:-1], count))
                    given[name][..., mine] = self.space.units * change
                dC[..., mine] = self.space.units * differential.C
        along = directions(controller, count, **given)
        return along, NoiseDirections(dC, levels, len(moved.shared))


@dataclass(frozen=True)
class _Moved:
    """Unknowns of one trial: shared ones, then its initial state (length `start`)."""

    all: np.ndarray[tuple[int], np.dtype[np.int64]]
    shared: np.ndarray[tuple[int], np.dtype[np.int64]]
    start: int
