"""The likelihood of a clipped regulator, with no approximation but that of particles.

The filter of `joint_likelihood` takes what it knows of a command that is clipped for a normal
number. Along the size of a whole gain its score is then off by half a deviation for each trial of
the seat at its limit; that of particles is not (docs/noisy-people.md, section "Particles").
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from experiments.particles.drawn_particles import particles
from experiments.particles.gains import gains
from experiments.particles.lookahead import twist

if TYPE_CHECKING:
    from experiments.particles.clipped_regulator import ClippedRegulator
    from impc.arrays import Array

__all__ = ["particle_likelihood"]

# How often the commands are replaced by lines before particles look ahead; with one their weights
# differ more, with six no less.
_ROUNDS = 2


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
    known = gains(regulator, len(outputs))
    ahead = twist(regulator, outputs, disturbance, start, _ROUNDS)
    return float(particles(regulator, known, ahead, outputs, disturbance, start, seed, count))
