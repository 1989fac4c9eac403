"""The likelihood of a clipped regulator, with no approximation but that of particles.

The filter of `joint_likelihood` takes what it knows of a command that is clipped for a normal
number. Along the size of a whole gain its score is then off by half a deviation for each trial of
the seat at its limit; that of particles is not (docs/noisy-people.md, section "Particles").
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from experiments.particles.drawn_particles import particles
from experiments.particles.lookahead import twist
from experiments.particles.wanted_paths import complete, drawn_back, gains, pull
from impc.arrays import Array

if TYPE_CHECKING:
    from collections.abc import Sequence

    from experiments.particles.clipped_regulator import ClippedRegulator

__all__ = [
    "SLOPE_STEP",
    "Paths",
    "particle_likelihood",
    "particle_paths",
    "path_slopes",
    "stein_fields",
]

# How often the commands are replaced by lines before particles look ahead; with one their weights
# differ more, with six no less.
_ROUNDS = 2
#: Difference along an unknown, of a coordinate.
SLOPE_STEP = 1e-4
# Samples by which what moves a path lags behind what it is made of.
_INNOVATION_LAGS = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48)
_EXCESS_LAGS = (0, 1, 2, 4, 8, 16, 32, 64)


class Paths(NamedTuple):
    """Wanted commands as all outputs have them.

    Attributes
    ----------
    value : float
        Log-likelihood, nats.
    share : float
        The least effective share of particles on the way.
    wanted : Array
        Paths, of all samples but the last (samples - 1, paths).
    """

    value: float
    share: float
    wanted: Array


def particle_likelihood(
    regulator: ClippedRegulator,
    outputs: Array,
    disturbance: Array,
    start: Array,
    count: int,
    seed: int,
) -> float:
    """Log-likelihood of a recording, nats; its exponential has no bias.

    Parameters
    ----------
    regulator : ClippedRegulator
    outputs, disturbance : Array
        (samples, p) and (samples, d).
    start : Array
        What is expected of the first state (z,).
    count : int
        How many particles.
    seed : int
        Of all numbers drawn.
    """
    known, room = gains(regulator, len(outputs)), _room(1, len(start), count)
    ahead = twist(regulator, outputs, disturbance, start, _ROUNDS)
    return float(particles(regulator, known, ahead, outputs, disturbance, start, seed, *room)[0])


def particle_paths(
    regulator: ClippedRegulator,
    outputs: Array,
    disturbance: Array,
    start: Array,
    count: int,
    paths: int,
    seed: int,
) -> Paths:
    """Likelihood of a recording, and wanted commands drawn from what it says of them.

    Parameters
    ----------
    regulator : ClippedRegulator
    outputs, disturbance, start : Array
        (samples, p), (samples, d) and (z,), as in `particle_likelihood`.
    count, paths, seed : int
        How many particles and paths, and that of all numbers drawn.
    """
    known, room = gains(regulator, len(outputs)), _room(len(outputs), len(start), count)
    ahead = twist(regulator, outputs, disturbance, start, _ROUNDS)
    value, share = particles(regulator, known, ahead, outputs, disturbance, start, seed, *room)
    drawn = drawn_back(regulator, known, outputs, disturbance, *room, seed + 1, paths)
    return Paths(float(value), float(share), drawn)


def path_slopes(
    near: Sequence[tuple[ClippedRegulator, ClippedRegulator]],
    outputs: Array,
    disturbance: Array,
    start: Array,
    wanted: Array,
) -> Array:
    """Derivatives of log p(y, g) of each path along some unknowns (paths, unknowns).

    Their mean is the score (Fisher's identity).

    Parameters
    ----------
    near : sequence of pairs of ClippedRegulator
        `SLOPE_STEP` above and below along each unknown.
    outputs, disturbance, start : Array
        (samples, p), (samples, d) and (z,), as in `particle_likelihood`.
    wanted : Array
        Paths (samples - 1, paths).
    """
    room = np.zeros((1, outputs.shape[1], wanted.shape[1])), np.zeros((1, wanted.shape[1]))
    samples, found = len(outputs), []
    for pair in near:
        up, down = (
            complete(one, gains(one, samples), outputs, disturbance, start, wanted, *room)
            for one in pair
        )
        found.append((up - down) / (2 * SLOPE_STEP))
    return np.array(found).T


def stein_fields(
    regulator: ClippedRegulator, outputs: Array, disturbance: Array, start: Array, wanted: Array
) -> Array:
    """Numbers of each path whose expectation is zero (paths, fields).

    For any field phi of paths the sum over samples of phi d log p(y, g) / dg and of the divergence
    of phi has no mean (Stein). What of the slopes goes with such numbers is noise, and can be taken
    away (control variates; Oates, Girolami and Chopin 2017). The fields are wanted and clipped
    commands, and with some lags what is wanted beyond the bounds and what was not expected of it.

    Parameters
    ----------
    regulator : ClippedRegulator
        Where the paths were drawn.
    outputs, disturbance, start : Array
        (samples, p), (samples, d) and (z,), as in `particle_likelihood`.
    wanted : Array
        Paths (samples - 1, paths).
    """
    known = gains(regulator, len(outputs))
    shape = len(outputs), outputs.shape[1], wanted.shape[1]
    missed, innovation = np.zeros(shape), np.zeros(wanted.shape)
    complete(regulator, known, outputs, disturbance, start, wanted, missed, innovation)
    slope = pull(regulator, known, wanted, missed, innovation)
    met = np.clip(wanted, regulator.low, regulator.high)
    inside = np.sum(met == wanted, axis=0)
    found = [_field(wanted, slope, 0) + len(wanted), _field(met, slope, 0) + inside]
    own = np.count_nonzero(known.spread[:-1])
    found += [_field(innovation, slope, lag) + own * (lag == 0) for lag in _INNOVATION_LAGS]
    beyond = len(wanted) - inside
    found += [_field(wanted - met, slope, lag) + beyond * (lag == 0) for lag in _EXCESS_LAGS]
    return np.array(found).T


def _room(samples: int, size: int, count: int) -> tuple[Array, Array, Array]:
    """What is kept of particles: expected states, weights and wanted commands."""
    return (
        np.zeros((samples, size, count)),
        np.zeros((samples, count)),
        np.zeros((samples, count)),
    )


def _field(values: Array, slope: Array, lag: int) -> Array:
    """Sum over samples of values (samples, paths), some samples later, times the slope there."""
    return np.asarray(np.sum(values[: len(values) - lag] * slope[lag:], axis=0))
