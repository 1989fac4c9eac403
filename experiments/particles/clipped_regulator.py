"""A person whose command is a gain times the estimate, clipped: what particles can be exact about.

With z of `joint_loop` and g the command that is wanted, before the bounds at the present sample,

    z+ = F z + B clip(g) + E d + noise of covariance Q,    g = h'z,    y = C z + noise of R

which is the person of `joint_likelihood` where no later sample of a plan meets a bound. Once y and
g are given up to a sample, z is normal, with a covariance that depends on neither: particles need
to draw g alone (docs/noisy-people.md, section "Particles").
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from impc.arrays import Array, Buffer
from impc.output_feedback.joint_loop import joint_loop

if TYPE_CHECKING:
    from impc.model.bounds import Bounds
    from impc.model.plant import Plant
    from impc.output_feedback.observer import Observer

__all__ = ["ClippedRegulator", "clipped_regulator", "first_state"]

# Eigenvalues of the noise below that, of the largest, are rounding.
_ROUNDING = 1e-14
# A wanted command whose deviation is below 1e-7 of the nearer bound is known.
_KNOWN = 1e-14


class ClippedRegulator(NamedTuple):
    """The system; a named tuple because compiled code takes it as it is.

    Attributes
    ----------
    F, B, E, C : Buffer
        (z, z), (z,), (z, d) and (p, z): transition, command, perturbations, outputs.
    Q, root, R, P0 : Buffer
        Covariance of the noise (z, z) and A with A A' = Q (z, r); that of the recorder (p, p) and
        of the first state (z, z).
    h : Buffer
        The wanted command of z (z,).
    low, high : float
        Bounds of the command, in its unit.
    unit : float
        The nearer of them.
    known : float
        A wanted command of a smaller variance is known: 1e-14 of the square of that.
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
    """The system of a `person` at a `plant` of one input, with noise that is no share of commands.

    Parameters
    ----------
    plant : Plant
    gain : Array
        K (1, n), u = -K x.
    bounds : Bounds
        Those of the input are met.
    person : Observer
    recorder : Array
        Standard deviations of the noise in the recorded outputs (p,).

    Raises
    ------
    SolverError
        When the person's filter has no stationary gain.
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
    """What is expected of z at the first sample (z,), the estimate being x0 (n,).

    Parameters
    ----------
    plant : Plant
    regulator : ClippedRegulator
        Of the plant.
    x0 : Array
        (n,).
    """
    start = np.zeros(len(regulator.F))
    at = 0 if len(start) == plant.n else plant.n
    start[at : at + plant.n] = x0
    return start
