"""A trial of a person who senses with noise, under the constrained controller.

The system is that of `joint_loop`: commands follow from the estimate, with every bound active.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.arrays import Array, Frozen, finite_array, frozen
from impc.checking import checked
from impc.control.closed_loop import Status, prepare_loop, scenario
from impc.control.compiled_filter import run_person
from impc.control.constraint_rows import directions
from impc.control.joint_loop import joint_loop

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from impc.control.controller import Controller
    from impc.control.joint_loop import JointLoop
    from impc.model.observer import Observer

__all__ = ["PersonTrial", "simulate_person"]


@dataclass(frozen=True)
class PersonTrial(Frozen):
    """What a person does, and what is recorded of it.

    Attributes
    ----------
    outputs : Array
        Recorded, with the recorder's noise (samples, p).
    states, estimates : Array
        What is, and what the person takes it for (samples, n).
    u : Array
        Commands without motor noise (samples, m).
    status : Array
        `Status` of each sample (samples,).
    """

    outputs: Array
    states: Array
    estimates: Array
    u: Array
    status: np.ndarray[tuple[int], np.dtype[np.int8]]

    @property
    def reached(self) -> int:
        """Samples with a command; where it is less than all, the rest repeats the last."""
        return int(np.count_nonzero(self.status <= Status.SOFTENED))


@checked(x0="n", steps=(1, 10_000_000))
def simulate_person(
    controller: Controller,
    person: Observer,
    disturbance: ArrayLike | None = None,
    *,
    steps: int | None = None,
    recorder: ArrayLike = 0.0,
    x0: ArrayLike | None = None,
    believes: Observer | None = None,
    seed: Any = 0,
) -> PersonTrial:
    """Simulate one trial.

    Parameters
    ----------
    controller : Controller
        What the person does with the estimate.
    person : Observer
        What is sensed, and the noise that there is.
    disturbance : array_like, optional
        (samples, d), or (samples,) for one.
    steps : int, optional
        Number of samples, where there is no disturbance.
    recorder : array_like
        Standard deviation of the noise in the recorded outputs, in their units, one or (p,).
    x0 : array_like, optional
        What the person takes for the state at first (n,); rest by default. A person who estimates
        errs there by as much as always.
    believes : Observer, optional
        What the person takes for true, when that is not what is; the same signals are sensed.
    seed : int or SeedSequence
        All numbers drawn follow from it.

    Raises
    ------
    DataError
        When the disturbance is not of the plant's shape.
    SolverError
        When the person's filter has no stationary gain.
    """
    plant = controller.plant
    given = scenario(plant, np.zeros(plant.n) if x0 is None else x0, steps, disturbance)
    rng, p = np.random.default_rng(seed), len(plant.outputs)
    white = finite_array("recorder", np.full(p, recorder, dtype=np.float64), (p,))
    joint = joint_loop(plant, person, white, believes)
    at = plant.n if person.estimates else 0
    z, u, status = _moved(controller, joint, at, given.x0, np.array(given.disturbance), rng)
    estimates = z[:, at : at + plant.n]
    states = estimates + z[:, : plant.n] if person.estimates else estimates
    outputs = states @ plant.C.T + white * rng.standard_normal((len(u), p))
    return PersonTrial(frozen(outputs), frozen(states), frozen(estimates), frozen(u), status)


def _moved(
    controller: Controller,
    joint: JointLoop,
    at: int,
    x0: Array,
    disturbance: Array,
    rng: np.random.Generator,
) -> tuple[Array, Array, np.ndarray[tuple[int], np.dtype[np.int8]]]:
    """States of the joint system and commands at each sample."""
    steps, size, (m, n) = len(disturbance), len(joint.F), controller.K.shape
    law = prepare_loop(controller, directions(controller, 0))
    z, u = np.zeros((steps + 1, size)), np.zeros((steps, m))
    z[0] = _root(joint.P0) @ rng.standard_normal(size)
    z[0, at : at + n] += x0
    noise = rng.standard_normal((steps, size)) @ _root(joint.Q).T
    status = np.full(steps, Status.NOT_REACHED, dtype=np.int8)
    reached = run_person(
        law.matrices,
        law.matrix_directions,
        law.rows,
        law.row_directions,
        law.unit,
        joint,
        at,
        disturbance,
        noise,
        rng.standard_normal((steps, m)),
        z,
        u,
        status,
    )
    z[reached + 1 :], u[reached:] = z[reached], u[max(reached - 1, 0)]
    return z[:steps], u, status


def _root(covariance: Array) -> Array:
    """A with A A' the covariance, which need not be definite."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
