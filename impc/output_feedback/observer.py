"""A person who senses with noise: what is sensed, how well, and what else moves the body.

    body       x+ = A x + B (u + w) + E d + p,   w ~ N(0, motor^2 + (share u)^2)
                                                 p ~ N(0, process^2)
    senses     s = C_s x + v,                    v ~ N(0, sensory^2)
    estimate   xh+ = A xh + B u + E dh + L (s - C_s xh)

All noise is white from sample to sample and independent; a level is the standard deviation of one
sample. A perturbation is known, dh = d, or believed to be a random walk whose steps have the
deviation `walk`, and is estimated too: dh+ = r dh + L_d (s - C_s xh), with r = 1; with a
`persistence` r below one it is believed to fade. L is the stationary Kalman gain of what the person
believes of plant and levels. A share of the command is left out there, so that
the gain stays the same. Who senses nothing in particular sees every state as it is: xh = x
(docs/noisy-people.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import scipy.linalg

from impc.arrays import Array, as_numbers, finite_array, frozen
from impc.checking import Value, add_value, checked, replace
from impc.errors import InputError
from impc.model.combinations import linear_combination
from impc.output_feedback.kalman import stationary_filter

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike

    from impc.model.plant import Plant
    from impc.output_feedback.kalman import StationaryFilter

add_value("Observer", "Observer(plant, ...)")

#: The levels of noise, in the order in which they are searched.
LEVELS = ("motor", "share", "process", "sensory", "walk")


@dataclass(frozen=True, init=False)
class Observer(Value):
    """How a person senses, and the noise inside the loop.

    Parameters
    ----------
    plant : Plant
        Whose signals are meant.
    sensed : sequence of str, optional
        Combinations of states and outputs by name, as in ``["theta1", "theta2 - theta1"]``; left
        out, every state is seen without noise.
    motor, share, process, sensory : array_like
        See the attributes; one number stands for all.
    walk : array_like, optional
        Left out, the perturbation is known.
    persistence : array_like
        See the attributes.

    Attributes
    ----------
    sensed : tuple of str
        What is sensed (s,).
    C : Array
        The same as rows (s, n).
    motor : Array
        Standard deviation of the noise on each command (m,), in its unit.
    share : Array
        The same as a share of the command (m,).
    process : Array
        Standard deviation of what else moves each state from one sample to the next (n,).
    sensory : Array
        Standard deviation of the noise of each sensed signal (s,), in its unit.
    walk : Array or None
        Standard deviation of the steps that each perturbation is believed to make (d,), in its
        unit; None when it is known.
    persistence : Array
        Share of each perturbation that is believed to be left a sample later (d,), where it is not
        known: 1 for a random walk, 0 for one that is new at every sample, of the deviation `walk`.

    Raises
    ------
    InputError
        When a signal is not known, a level is negative, sensed signals have no noise, or a
        persistence is not between 0 and 1.

    Examples
    --------
    >>> import control
    >>> import impc
    >>> cart = control.ss([[1, 0.1], [0, 1]], [[0], [0.1]], [[1, 0]], 0, 0.1, states=["x", "v"])
    >>> plant = impc.Plant(cart)
    >>> person = impc.Observer(plant, ["x"], motor=0.2, sensory=0.01)
    >>> person.C, person.motor
    (array([[1., 0.]]), array([0.2]))
    """

    _rules: ClassVar[Mapping[str, Any]] = {
        "C": "* n",
        "motor": "m",
        "share": "m",
        "process": "n",
        "sensory": "*",
        "walk": "d",
        "persistence": "d",
    }

    sensed: tuple[str, ...]
    C: Array
    motor: Array
    share: Array
    process: Array
    sensory: Array
    walk: Array | None
    persistence: Array

    @checked
    def __init__(
        self,
        plant: Plant,
        sensed: Sequence[str] = (),
        *,
        motor: ArrayLike = 0.0,
        share: ArrayLike = 0.0,
        process: ArrayLike = 0.0,
        sensory: ArrayLike = 0.0,
        walk: ArrayLike | None = None,
        persistence: ArrayLike = 1.0,
    ) -> None:
        plant.require_discrete()
        rows = _sensed_rows(plant, sensed)
        if walk is not None and not len(rows):
            raise InputError("walk", "is given, but every state is seen", "say what is sensed")
        d = plant.E.shape[1]
        self._fill(
            sensed=tuple(sensed),
            C=frozen(rows),
            motor=_levels("motor", motor, plant.m),
            share=_levels("share", share, plant.m),
            process=_levels("process", process, plant.n),
            sensory=_levels("sensory", sensory, len(rows)),
            walk=None if walk is None else _levels("walk", walk, d),
            persistence=_levels("persistence", persistence, d),
        )
        if np.any(self.persistence > 1):
            got = self.persistence.tolist()
            raise InputError("persistence", f"got {got}", "give shares between 0 and 1")
        if np.any(self.sensory == 0):
            raise InputError("sensory", "has a zero", "give each sensed signal some noise")

    @property
    def estimates(self) -> bool:
        """Whether the person senses with noise, and estimates the state."""
        return len(self.C) > 0

    @property
    def levels(self) -> Array:
        """All levels in a row (l,), those of `LEVELS` one after the other."""
        return np.concatenate([self.level(name) for name in LEVELS])

    def with_levels(self, levels: Array) -> Observer:
        """The same person at other `levels` (l,), in their order."""
        sizes = [len(self.level(name)) for name in LEVELS]
        parts = np.split(levels, np.cumsum(sizes)[:-1])
        found = {name: frozen(part) for name, part in zip(LEVELS, parts, strict=True)}
        return replace(self, **{**found, "walk": None if self.walk is None else found["walk"]})

    def names(self, plant: Plant) -> tuple[str, ...]:
        """What each of `levels` is called: kind and signal of the `plant`."""
        signals = (plant.controls, plant.controls, plant.states, self.sensed, plant.disturbances)
        return tuple(
            f"{kind} {signal}"
            for kind, each in zip(LEVELS, signals, strict=True)
            for signal in each[: len(self.level(kind))]
        )

    def level(self, name: str) -> Array:
        """Level of a kind by its `name`, one of `LEVELS`; (0,) for the walk where none is."""
        found = getattr(self, name)
        return frozen([]) if found is None else np.asarray(found)


def believed_matrices(plant: Plant, person: Observer) -> tuple[Array, Array, Array, Array]:
    """F, C, Q and R of what a person who estimates believes: states, then unknown perturbations."""
    unknown = person.walk is not None
    d = plant.E.shape[1] if unknown else 0
    F = scipy.linalg.block_diag(plant.A, np.diag(person.persistence[:d]))
    F[: plant.n, plant.n :] = plant.E[:, :d]
    moved = plant.B @ np.diag(person.motor**2) @ plant.B.T + np.diag(person.process**2)
    steps = np.zeros(0) if person.walk is None else np.asarray(person.walk)
    Q = scipy.linalg.block_diag(moved, np.diag(steps**2))
    C = np.hstack([person.C, np.zeros((len(person.C), d))])
    return F, C, Q, np.diag(person.sensory**2)


def believed_filter(plant: Plant, person: Observer) -> StationaryFilter:
    """The stationary filter of a person who estimates."""
    return stationary_filter(*believed_matrices(plant, person))


def _sensed_rows(plant: Plant, sensed: Sequence[str]) -> Array:
    """One row of states (s, n) for each combination of states and outputs."""
    outputs = [index for index, name in enumerate(plant.outputs) if name not in plant.states]
    names = (*plant.states, *(plant.outputs[index] for index in outputs))
    meaning = np.vstack([np.eye(plant.n), plant.C[outputs]])
    rows = [linear_combination(text, names) @ meaning for text in sensed]
    return np.array(rows).reshape(len(rows), plant.n)


def _levels(name: str, given: ArrayLike, size: int) -> Array:
    values = as_numbers(name, given)
    found = finite_array(name, np.full(size, values) if values.ndim == 0 else values, (size,))
    if np.any(found < 0):
        raise InputError(name, f"got {found.tolist()}", "give standard deviations")
    return frozen(found)
