"""Where a search for a person begins: a gain, and levels that what it leaves suggests.

Of several gains the one is taken whose first guess of the levels is the likeliest. Of its residual
each kind of noise is thought to make a share (docs/noisy-people.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array
from impc.errors import ImpcError, SolverError
from impc.inverse.coordinates import Coordinates
from impc.inverse.regulator_span import kept_to, regulators_alone
from impc.inverse.residuals import residual_only
from impc.inverse.solution_set import natural_coordinates
from impc.inverse.structured_search import WeightCoordinates
from impc.model.riccati import lyapunov_series
from impc.output_feedback.observer import LEVELS
from impc.output_feedback.prior import Prior
from impc.output_feedback.unknowns import PersonCoordinates

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.inverse.coordinates import Point
    from impc.output_feedback.observer import Observer

# Of the residual, shares that a search begins with: inside the loop, of the senses, the recorder's.
# The likeliest is taken. On a seat whose recorder has a thirtieth of the residual the search had
# not ended after 40 steps (docs/noisy-people.md).
_SHARES = ((0.7, 0.5, 0.3), (0.3, 0.3, 0.9), (0.7, 0.1, 0.3), (0.1, 0.1, 1.0))
# Recorded exactly, a residual has no size: its levels begin at this share of the outputs.
_LEAST = 1e-6


@dataclass(frozen=True)
class Asked:
    """What a search is asked for."""

    observer: Observer  # Which levels there are; those that are not searched, at what they are
    # Standard deviations where a search begins (p,); of the size of the residuals by default
    recorder: Array | None
    held: Sequence[str]  # Kinds of levels that are not searched
    spread: float  # Standard deviation of the prior
    counted: int  # The first sample of each trial that is identified


def gain_space(point: Point, cost_weights: Array | None) -> Coordinates:
    """Coordinates of gain or cost weights about a point; `cost_weights` (count,) if searched."""
    structure = point.problem.structure
    if cost_weights is not None and structure is not None:
        return WeightCoordinates(point.problem, structure, np.array(cost_weights))
    kept, gains = kept_to(point.problem), None
    if kept is not None:
        T, _ = natural_coordinates(point.problem.plant, point.K)
        gains = regulators_alone(point.problem.plant, kept, T)
    return Coordinates(point.problem, point.K, point.S, gains)


def cost_weights_at(space: PersonCoordinates, theta: Array) -> Array | None:
    """Cost weights (count,) at theta (q,), where they are searched."""
    own = space.space
    return own.unknowns(theta[: space.own]) if isinstance(own, WeightCoordinates) else None


def prior_about(space: PersonCoordinates, asked: Asked) -> Prior:
    """The prior about the start of some coordinates."""
    return _prior(space, asked, _sizes(space.space.unpack(space.space.start)))


def _prior(space: PersonCoordinates, asked: Asked, size: _Sizes) -> Prior:
    alone = np.concatenate([_suggested(asked.observer, size, 1.0, 1.0), size.recorder])
    return Prior(space, asked.spread, np.log(alone[space.moving]), size.sensory)


def likeliest_start(
    points: Sequence[Point], cost_weights: Array | None, asked: Asked
) -> tuple[Prior, Array]:
    """Where a search begins, of several points; `cost_weights` (count,); returns (q,)."""
    found, highest, reason = None, -np.inf, "no number"
    for point in points:
        try:
            own = gain_space(point, cost_weights)
            size = _sizes(own.unpack(own.start))
            white = size.recorder if asked.recorder is None else np.asarray(asked.recorder)
            space = PersonCoordinates(own, asked.observer, white, asked.held, asked.counted)
            guesses = _guesses(space, asked, size)
            value = space.value(guesses[0])
        except ImpcError as error:
            reason = str(error)
            continue
        if value > highest:
            found, highest = (space, size, guesses), value
    if found is None:
        raise SolverError("person", f"no start has a likelihood: {reason}", "give other levels")
    space, size, guesses = found
    return _prior(space, asked, size), max(guesses, key=lambda theta: _value(space, theta))


def _guesses(space: PersonCoordinates, asked: Asked, size: _Sizes) -> list[Array]:
    """Unknowns (q,) where a search may begin: shares of what is left, then the levels given."""
    guesses = []
    for inside, sensed, recorded in _SHARES if asked.recorder is None else ():
        levels = _suggested(asked.observer, size, inside, sensed)
        log = np.log(np.concatenate([levels, recorded * size.recorder])[space.moving])
        guesses.append(np.concatenate([space.space.start, log]))
    return [*guesses, space.start]


def _value(space: PersonCoordinates, theta: Array) -> float:
    """Log-likelihood at theta (q,); minus infinity where there is none."""
    try:
        return space.value(theta)
    except ImpcError:
        return -np.inf


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
