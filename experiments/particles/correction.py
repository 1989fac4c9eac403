"""What the filter's score of a person at a limit lacks, by particles.

The filter of `joint_likelihood` takes what it knows of a clipped command for a normal number. Of
the regulator that is clipped, which is the person but for bounds that later samples of a plan meet,
particles have the likelihood itself. The difference of the two scores is what the person's own
lacks (docs/noisy-people.md, section "Particles").
"""

from __future__ import annotations

import copy
import os
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from experiments.particles.clipped_regulator import clipped_regulator, first_state
from experiments.particles.likelihood import (
    SLOPE_STEP,
    Paths,
    particle_paths,
    path_slopes,
    stein_fields,
)
from impc.arrays import Array
from impc.checking import replace
from impc.model.bounds import bound_rows

if TYPE_CHECKING:
    from experiments.particles.clipped_regulator import ClippedRegulator
    from impc.inverse.person_coordinates import PersonCoordinates
    from impc.inverse.problem import Problem

__all__ = ["ParticleSlope", "particle_slope", "particles_serve", "regulator_alone"]

# Particles, and paths drawn from them. On the seat the slope along what is told best has a noise of
# a tenth of a deviation then, along what is told least of half of one.
_PARTICLES, _PATHS = 200, 100


class ParticleSlope(NamedTuple):
    """What the filter lacks at a point of a search.

    Attributes
    ----------
    value : float
        Log-likelihood of the clipped regulator by particles, less that by the filter, nats.
    slope : Array
        Its derivatives (q,), nats; zero along initial states.
    noise : Array
        Covariance of the slope, for paths are drawn (q, q).
    share : float
        The least effective share of particles on the way.
    """

    value: float
    slope: Array
    noise: Array
    share: float


def particles_serve(problem: Problem, space: PersonCoordinates) -> bool:
    """Whether particles know more: one input with bounds, none on states, no noise by its share.

    Parameters
    ----------
    problem : Problem
    space : PersonCoordinates
    """
    bounds, plant = problem.bounds, problem.plant
    finite = np.isfinite(bounds.u_min) | np.isfinite(bounds.u_max)
    if plant.m != 1 or not finite[0] or np.any(space.observer.share):
        return False
    return not np.any(bound_rows(bounds, plant).on_state) and not problem.terminal_set


def particle_slope(space: PersonCoordinates, theta: Array, seed: int) -> ParticleSlope:
    """What the filter's likelihood of a person lacks.

    Parameters
    ----------
    space : PersonCoordinates
        For which particles serve.
    theta : Array
        The point (q,).
    seed : int
        Of all numbers drawn.

    Raises
    ------
    ImpcError
        When there is no likelihood at the point or beside it.
    """
    moved = np.r_[0 : space.shared, space.after : len(theta)]
    here, steps = _regulator(space, theta), SLOPE_STEP * np.eye(len(theta))[moved]
    near = [(_regulator(space, theta + s), _regulator(space, theta - s)) for s in steps]
    problem = space.unpack(theta).point.problem

    def one(index: int) -> tuple[Paths, Array, Array]:
        trial = problem.recordings[index]
        start = first_state(problem.plant, here, trial.x0)
        given = np.array(trial.outputs), np.array(trial.disturbance), start
        paths = particle_paths(here, *given, _PARTICLES, _PATHS, _seed(seed, index))
        slopes = path_slopes(near, *given, paths.wanted)
        return paths, slopes, stein_fields(here, *given, paths.wanted)

    # The compiled code lets other threads run.
    trials = len(problem.recordings)
    with ThreadPoolExecutor(min(trials, os.cpu_count() or 1)) as pool:
        paths, slopes, fields = zip(*pool.map(one, range(trials)), strict=True)
    mean, spread = _controlled(slopes, fields)
    own = regulator_alone(space).told(theta)
    slope, noise = np.zeros(len(theta)), np.zeros((len(theta),) * 2)
    slope[moved], noise[np.ix_(moved, moved)] = mean - own.gradient[moved], spread
    value = sum(one.value for one in paths) - own.value
    return ParticleSlope(value, slope, noise, min(one.share for one in paths))


def regulator_alone(space: PersonCoordinates) -> PersonCoordinates:
    """The same unknowns of plans of one sample, without terminal set: a gain, clipped.

    Parameters
    ----------
    space : PersonCoordinates
    """
    found = copy.copy(space)
    found.space = copy.copy(space.space)
    found.space.problem = replace(space.space.problem, horizon=1, terminal_set=False)
    return found


def _regulator(space: PersonCoordinates, theta: Array) -> ClippedRegulator:
    person = space.unpack(theta)
    problem = person.point.problem
    return clipped_regulator(
        problem.plant, person.point.K, problem.bounds, person.observer, person.recorder
    )


def _seed(seed: int, trial: int) -> int:
    """A seed of each trial, apart from those of others by more than the two that a trial takes."""
    return int(np.random.SeedSequence([seed, trial]).generate_state(1)[0] // 2)


def _controlled(slopes: tuple[Array, ...], fields: tuple[Array, ...]) -> tuple[Array, Array]:
    """Sum over trials of the mean slope, and its covariance, less what goes with the fields.

    How slopes go with fields is taken for the same in all trials. Paths are drawn from particles
    that are drawn themselves: slopes scatter by half as much again as paths do on the seat.
    """
    off, noise = (
        np.vstack([each - each.mean(axis=0) for each in both]) for both in (slopes, fields)
    )
    unit = np.where(np.any(noise, axis=0), np.linalg.norm(noise, axis=0), 1.0)
    share = np.linalg.lstsq(noise / unit, off, rcond=None)[0] / unit[:, None]
    left = [one - each @ share for one, each in zip(slopes, fields, strict=True)]
    degrees = len(off) / max(len(off) - noise.shape[1], 1)
    mean = np.sum([each.mean(axis=0) for each in left], axis=0)
    spread = np.sum([np.cov(each.T) / len(each) for each in left], axis=0)
    return np.asarray(mean), np.asarray((1 + _PATHS / _PARTICLES) * degrees * spread)
