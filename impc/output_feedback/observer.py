"""The sensorimotor model: sensed signals, sensory noise, and noise that moves the body.

    body       x+ = A x + B (u + w) + E d + p,   w ~ N(0, motor^2 + (share u)^2)
                                                 p ~ N(0, process^2)
    senses     s = C_s x + v,                    v ~ N(0, sensory^2)
    estimate   xh+ = A xh + B u + E dh + L (s - C_s xh)

All noise is white and independent; its standard deviations are per sample. A perturbation is known,
dh = d, or assumed to follow d+ = r d + n with steps n of SD `walk`, and estimated:
dh+ = r dh + L_d (s - C_s xh), with r = 1 for a random walk and a `persistence` r < 1 for one that
decays. L is the stationary Kalman gain for plant and noise; signal-dependent noise is left out of
it, so that it stays constant. Without sensed signals every state is observed exactly, xh = x
(docs/why/output_feedback.md).
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

#: Kinds of noise SDs, in the order of the unknowns.
LEVELS = ("motor", "share", "process", "sensory", "walk")


@dataclass(frozen=True, init=False)
class Observer(Value):
    """Sensed signals and noise of a subject (sensorimotor model).

    Parameters
    ----------
    plant : Plant
        Plant whose signals are meant.
    sensed : sequence of str, optional
        Sensed combinations of states and outputs, such as ``["theta1", "theta2 - theta1"]``; by
        default every state is observed exactly.
    motor, share, process, sensory : array_like
        Noise standard deviations, see the attributes; one number stands for all.
    walk : array_like, optional
        Assumed random-walk step, see the attributes; by default the perturbation is known.
    persistence : array_like
        Assumed AR(1) coefficient, see the attributes.

    Attributes
    ----------
    sensed : tuple of str
        Sensed signals, length s.
    C : ndarray of shape (s, n)
        Sensed signals as rows over the states.
    motor : ndarray of shape (m,)
        Standard deviation of the noise on each command, in its unit.
    share : ndarray of shape (m,)
        Standard deviation of signal-dependent motor noise, as a share of the command.
    process : ndarray of shape (n,)
        Standard deviation of the unmodelled change of each state from sample to sample.
    sensory : ndarray of shape (s,)
        Standard deviation of the noise of each sensed signal, in its unit.
    walk : ndarray of shape (d,) or None
        Standard deviation of the steps that the subject's filter assumes for each perturbation, in
        its unit; None if the subject knows the perturbation.
    persistence : ndarray of shape (d,)
        Assumed AR(1) coefficient of each unknown perturbation: 1 for a random walk, 0 for one that
        is new at every sample, with standard deviation `walk`.

    Raises
    ------
    InputError
        If a signal is unknown, a standard deviation is negative, a sensed signal has no noise, or a
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
            raise InputError("walk", "is given, but all states are observed", "set `sensed`")
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
            raise InputError("persistence", f"got {got}", "give numbers between 0 and 1")
        if np.any(self.sensory == 0):
            raise InputError("sensory", "has a zero", "give every sensed signal some noise")

    @property
    def estimates(self) -> bool:
        """Whether the subject has noisy senses and estimates the state."""
        return len(self.C) > 0

    @property
    def levels(self) -> Array:
        """All noise SDs (l,), in the order of `LEVELS`."""
        return np.concatenate([self.level(name) for name in LEVELS])

    def with_levels(self, levels: Array) -> Observer:
        """Return the same model with other noise SDs, `levels` (l,)."""
        sizes = [len(self.level(name)) for name in LEVELS]
        parts = np.split(levels, np.cumsum(sizes)[:-1])
        found = {name: frozen(part) for name, part in zip(LEVELS, parts, strict=True)}
        return replace(self, **{**found, "walk": None if self.walk is None else found["walk"]})

    def names(self, plant: Plant) -> tuple[str, ...]:
        """Names of the noise SDs: kind and signal."""
        signals = (plant.controls, plant.controls, plant.states, self.sensed, plant.disturbances)
        return tuple(
            f"{kind} {signal}"
            for kind, each in zip(LEVELS, signals, strict=True)
            for signal in each[: len(self.level(kind))]
        )

    def level(self, name: str) -> Array:
        """Noise SDs of the kind `name`, one of `LEVELS`; (0,) for a walk of None."""
        found = getattr(self, name)
        return frozen([]) if found is None else np.asarray(found)


def believed_matrices(plant: Plant, person: Observer) -> tuple[Array, Array, Array, Array]:
    """F, C, Q and R of the subject's filter: states, then unknown perturbations."""
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
    """Stationary filter of a subject who estimates."""
    return stationary_filter(*believed_matrices(plant, person))


def _sensed_rows(plant: Plant, sensed: Sequence[str]) -> Array:
    """Rows over the states (s, n) of combinations of states and outputs."""
    outputs = [index for index, name in enumerate(plant.outputs) if name not in plant.states]
    names = (*plant.states, *(plant.outputs[index] for index in outputs))
    meaning = np.vstack([np.eye(plant.n), plant.C[outputs]])
    rows = [linear_combination(text, names) @ meaning for text in sensed]
    return np.array(rows).reshape(len(rows), plant.n)


def _levels(name: str, given: ArrayLike, size: int) -> Array:
    values = as_numbers(name, given)
    found = finite_array(name, np.full(size, values) if values.ndim == 0 else values, (size,))
    if np.any(found < 0):
        raise InputError(name, f"got {found.tolist()}", "give standard deviations >= 0")
    return frozen(found)
