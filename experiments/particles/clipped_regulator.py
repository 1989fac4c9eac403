"""Sensorimotor model whose command is a clipped gain times the estimate.

With z of `joint_loop` and g the command before it is clipped to its bounds,

    z+ = F z + B clip(g) + E d + noise of covariance Q,    g = h'z,    y = C z + noise of R

This is the model of `joint_likelihood` if no later sample of a plan reaches a bound. Given y and g
up to a sample, z is normal with a covariance that depends on neither, so particles sample g only
(experiments/output_feedback.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from impc.arrays import Array, Buffer
from impc.output_feedback.simulation import joint_loop

if TYPE_CHECKING:
    from impc.model.bounds import Bounds
    from impc.model.plant import Plant
    from impc.output_feedback.observer import Observer

__all__ = ["ClippedRegulator", "clipped_regulator", "first_state"]

# Eigenvalues of the noise below this share of the largest are rounding.
_ROUNDING = 1e-14
# An unclipped command with a standard deviation below 1e-7 of the nearer bound is taken as exact.
_KNOWN = 1e-14


class ClippedRegulator(NamedTuple):
    """Matrices of the system, as a named tuple for compiled code.

    Attributes
    ----------
    F, B, E, C : Buffer
        (z, z), (z,), (z, d) and (p, z): transition, command, perturbations, outputs.
    Q, root, R, P0 : Buffer
        Covariance of the noise (z, z), its square root (z, r), covariance of the recording noise
        (p, p) and of the first state (z, z).
    h : Buffer
        Row that gives the unclipped command g = h'z, shape (z,).
    low, high : float
        Bounds of the command, in its unit.
    unit : float
        The bound nearer to zero, as a magnitude.
    known : float
        Variance below which g is taken as exact: 1e-14 of the square of `unit`.
    """

    F: Buffer
    B: Buffer
    E: Buffer
    C: Buffer
    Q: Buffer
    root: Buffer
    R: Buffer
    P0: Buffer
    h: Buffer
    low: float
    high: float
    unit: float
    known: float


def clipped_regulator(
    plant: Plant, gain: Array, bounds: Bounds, person: Observer, recorder: Array
) -> ClippedRegulator:
    """Build the system of a `person` and a `plant` with one input, without signal-dependent noise.

    Parameters
    ----------
    plant : Plant
    gain : Array
        K (1, n), u = -K x.
    bounds : Bounds
        Only the input bounds are used.
    person : Observer
    recorder : Array
        Standard deviations of the recording noise, shape (p,).

    Raises
    ------
    SolverError
        If the filter of the person has no stationary gain.
    """
    joint = joint_loop(plant, person, recorder)
    at = plant.n if person.estimates else 0
    h = np.zeros(len(joint.F))
    h[at : at + plant.n] = -gain[0]
    values, vectors = np.linalg.eigh(joint.Q)
    kept = values > _ROUNDING * values[-1]
    root = np.ascontiguousarray(vectors[:, kept] * np.sqrt(values[kept]))
    low, high = float(bounds.u_min[0]), float(bounds.u_max[0])
    parts = np.ascontiguousarray(joint.B[:, 0]), joint.E, joint.C, joint.Q, root, joint.R, joint.P0
    unit = min(-low, high)
    return ClippedRegulator(joint.F, *parts, h, low, high, unit, _KNOWN * unit**2)


def first_state(plant: Plant, regulator: ClippedRegulator, x0: Array) -> Array:
    """Expected z at the first sample, shape (z,), for the estimate x0, shape (n,).

    Parameters
    ----------
    plant : Plant
    regulator : ClippedRegulator
        System of the plant.
    x0 : Array
        (n,).
    """
    start = np.zeros(len(regulator.F))
    at = 0 if len(start) == plant.n else plant.n
    start[at : at + plant.n] = x0
    return start
