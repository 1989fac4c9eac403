"""Starting point of an output-feedback fit: a gain, and noise SDs that explain its residuals.

Of several gains the one with the highest likelihood is taken; each kind of noise is assumed to
explain a share of the residual (docs/why/output_feedback.md).
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

    from impc.inverse.unknowns import Point
    from impc.output_feedback.observer import Observer

# Assumed shares of the residual: process and motor noise, senses, recording. The one with the
# highest likelihood is taken. For a seat whose recording noise is 1/30 of the residual, a single
# start had not converged after 40 steps.
_SHARES = ((0.7, 0.5, 0.3), (0.3, 0.3, 0.9), (0.7, 0.1, 0.3), (0.1, 0.1, 1.0))
# Noise-free recordings have no residual: noise SDs start at this share of the outputs.
_LEAST = 1e-6


@dataclass(frozen=True)
class Asked:
    """Settings of a fit."""

    observer: Observer  # which noise exists; fixed noise SDs have their values here
    recorder: Array | None  # (p,), initial recording noise SDs; None: of the size of the residuals
    held: Sequence[str]  # kinds of noise that are fixed
    spread: float  # standard deviation of the prior
    counted: int  # first sample of each trial in the likelihood


def gain_space(point: Point, cost_weights: Array | None) -> Coordinates:
    """Coordinates of gain, or cost weights (count,) if these are estimated, about a point."""
    structure = point.problem.structure
    if cost_weights is not None and structure is not None:
        return WeightCoordinates(point.problem, structure, np.array(cost_weights))
    kept, gains = kept_to(point.problem), None
    if kept is not None:
        T, _ = natural_coordinates(point.problem.plant, point.K)
        gains = regulators_alone(point.problem.plant, kept, T)
    return Coordinates(point.problem, point.K, point.S, gains)


def cost_weights_at(space: PersonCoordinates, theta: Array) -> Array | None:
    """Log cost weights (count,) at theta (q,), if they are estimated."""
    own = space.space
    return own.unknowns(theta[: space.own]) if isinstance(own, WeightCoordinates) else None


def prior_about(space: PersonCoordinates, asked: Asked) -> Prior:
    """Prior about the start of `space`."""
    return _prior(space, asked, _sizes(space.space.unpack(space.space.start)))


def _prior(space: PersonCoordinates, asked: Asked, size: _Sizes) -> Prior:
    alone = np.concatenate([_suggested(asked.observer, size, 1.0, 1.0), size.recorder])
    return Prior(space, asked.spread, np.log(alone[space.moving]), size.sensory)


def likeliest_start(
    points: Sequence[Point], cost_weights: Array | None, asked: Asked
) -> tuple[Prior, Array]:
    """Starting point (q,) with the highest likelihood; `cost_weights` (count,)."""
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
        raise SolverError("observer", f"no start has a likelihood: {reason}", "set other noise SDs")
    space, size, guesses = found
    return _prior(space, asked, size), max(guesses, key=lambda theta: _value(space, theta))


def _guesses(space: PersonCoordinates, asked: Asked, size: _Sizes) -> list[Array]:
    """Possible starting points (q,): shares of the residual, then the given noise SDs."""
    guesses = []
    for inside, sensed, recorded in _SHARES if asked.recorder is None else ():
        levels = _suggested(asked.observer, size, inside, sensed)
        log = np.log(np.concatenate([levels, recorded * size.recorder])[space.moving])
        guesses.append(np.concatenate([space.space.start, log]))
    return [*guesses, space.start]


def _value(space: PersonCoordinates, theta: Array) -> float:
    """Log-likelihood at theta (q,); minus infinity if undefined."""
    try:
        return space.value(theta)
    except ImpcError:
        return -np.inf


@dataclass(frozen=True)
class _Sizes:
    """Noise SDs each of which alone would explain the size of the residuals."""

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
    """Noise SDs of the observer's kinds that together explain the residuals."""
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
