"""Likelihood of a clipped regulator, approximated by particles only.

The filter of `joint_likelihood` treats a clipped command as a normal variable, which biases its
score along the size of the gain at a limit. The particle score is unbiased
(experiments/output_feedback.md).
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

# Linearisations of the commands: with one the weights vary more, with six no less.
_ROUNDS = 2


def particle_likelihood(
    regulator: ClippedRegulator,
    outputs: Array,
    disturbance: Array,
    start: Array,
    count: int,
    seed: int,
) -> float:
    """Log-likelihood of a recording, nats; its exponential is unbiased.

    Parameters
    ----------
    regulator : ClippedRegulator
    outputs, disturbance : Array
        (samples, p) and (samples, d).
    start : Array
        Expected first state, shape (z,).
    count : int
        Number of particles.
    seed : int
        Seed of the random numbers.
    """
    known = gains(regulator, len(outputs))
    ahead = twist(regulator, outputs, disturbance, start, _ROUNDS)
    return float(particles(regulator, known, ahead, outputs, disturbance, start, seed, count))
