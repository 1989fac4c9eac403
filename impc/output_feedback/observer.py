"""The sensorimotor model: sensed signals, sensory noise, noise that moves the body, the filter.

    body       x+ = A x + B (u + w) + E d + p,   w ~ N(0, motor^2 + (share u)^2)
                                                 p ~ N(0, process^2)
    senses     s = C_s x + v,                    v ~ N(0, sensory^2)
    estimate   xh+ = A xh + B u + E dh + L (s - C_s xh)

All noise is white and independent; its standard deviations are per sample. A perturbation is known,
dh = d, or assumed to follow d+ = r d + n with steps n of SD `walk`, and estimated:
dh+ = r dh + L_d (s - C_s xh), with r = 1 for a random walk and a `persistence` r < 1 for one that
decays. Without sensed signals every state is observed exactly, xh = x.

L is the stationary Kalman gain; signal-dependent noise is left out, so that it stays constant. With
w ~ N(0, Q) and e ~ N(0, R) in z+ = F z + w, y = C z + e, and P the covariance of z given earlier y,

    P = F P F' + Q - L S L',    S = C P C' + R,    L = F P C' S^-1

This is the regulator's equation with F', C' for A, B, and likewise stationary in L, so that its
differential does not contain dL: with G = F - L C and dG = dF - L dC,

    dP = G dP G' + dG P G' + G P dG' + dQ + L dR L'
    dL = (dF P C' + F dP C' + F P dC' - L dS) S^-1,    dS = C dP C' + dC P C' + C P dC' + dR
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from impc.arrays import Array, as_numbers, finite_array, frozen
from impc.checking import Value, checked, replace
from impc.errors import InputError, SolverError
from impc.model.combinations import linear_combination
from impc.model.plant import Plant
from impc.model.riccati import is_stable, lyapunov_series

#: Kinds of noise SDs, in the order of the unknowns.
LEVELS = ("motor", "share", "process", "sensory", "walk")
# Doublings: 2^40 samples exceed the memory of any filter that is stable in double precision.
_DOUBLINGS = 40
_SETTLED = 1e-16
# Entries beyond this count as divergent; their square is still finite.
_LARGEST = 1e100


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
        return np.concatenate(self.by_kind)

    @property
    def by_kind(self) -> list[Array]:
        """Noise SDs of each of `LEVELS`; (0,) for a walk of None."""
        found = (getattr(self, name) for name in LEVELS)
        return [frozen([]) if one is None else np.asarray(one) for one in found]

    @property
    def kinds(self) -> list[str]:
        """Kind of each noise SD, length l."""
        both = zip(LEVELS, self.by_kind, strict=True)
        return [kind for kind, values in both for _ in values]

    @checked(levels="levels")
    def with_levels(self, levels: Array) -> Observer:
        """Return the same model with other noise SDs, `levels` (l,)."""
        parts = np.split(levels, np.cumsum([len(values) for values in self.by_kind])[:-1])
        found = {name: frozen(part) for name, part in zip(LEVELS, parts, strict=True)}
        return replace(self, **{**found, "walk": None if self.walk is None else found["walk"]})

    @checked
    def names(self, plant: Plant) -> tuple[str, ...]:
        """Names of the noise SDs: kind and signal."""
        signals = (plant.controls, plant.controls, plant.states, self.sensed, plant.disturbances)
        used = zip(signals, self.by_kind, strict=True)
        each = [signal for given, values in used for signal in given[: len(values)]]
        return tuple(f"{kind} {signal}" for kind, signal in zip(self.kinds, each, strict=True))


class Body(NamedTuple):
    """Matrices of a plant, or their derivatives along k directions (first axis)."""

    A: Array  # (n, n)
    B: Array  # (n, m)
    E: Array  # (n, d)
    C: Array  # (p, n)


class StationaryFilter(NamedTuple):
    """A stationary filter, or its derivatives along k directions (first axis)."""

    P: Array  # (n, n), covariance of the state given all earlier outputs
    L: Array  # (n, p), gain from an innovation to the next state
    S: Array  # (p, p), covariance of an innovation


def believed_filter(plant: Plant, person: Observer) -> StationaryFilter:
    """Stationary filter of a subject who estimates."""
    return stationary_filter(*believed_matrices(plant, person))


def believed_matrices(
    plant: Plant | Body, person: Observer, levels: Sequence[Array] | None = None
) -> tuple[Array, Array, Array, Array]:
    """F, C, Q and R of the subject's filter: states, then unknown perturbations.

    `levels`: other noise SDs, in the order of `LEVELS`; arrays may have k directions as first axis.
    """
    motor, _, process, sensory, walk = person.by_kind if levels is None else levels
    n, d = plant.A.shape[-1], walk.shape[-1]
    state, push = np.split(np.eye(n + d), [n], axis=1)
    F = state @ plant.A @ state.T + state @ plant.E[..., :d] @ push.T
    F = F + push @ np.diag(person.persistence[:d]) @ push.T
    Q = state @ moving_noise(plant.B, motor, process) @ state.T
    Q = Q + push @ diagonal(walk**2) @ push.T
    return F, person.C @ state.T, Q, diagonal(sensory**2)


def moving_noise(B: Array, motor: Array, process: Array) -> Array:
    """Covariance (n, n) of motor and process noise."""
    return np.asarray(B @ diagonal(motor**2) @ np.swapaxes(B, -1, -2) + diagonal(process**2))


def diagonal(values: Array) -> Array:
    """Diagonal matrices (..., a, a) from rows (..., a)."""
    return np.asarray(values[..., None] * np.eye(values.shape[-1]))


def stationary_filter(F: Array, C: Array, Q: Array, R: Array) -> StationaryFilter:
    """Solve the Riccati equation by doubling (Anderson 1978), insensitive to scaling.

    `F` (n, n); `C` (p, n); `Q` (n, n); `R` (p, p).
    """
    try:
        P = _doubled(F, C, Q, R)
        S = C @ P @ C.T + R
        L = np.linalg.solve(S, C @ P @ F.T).T
    except np.linalg.LinAlgError:
        raise _no_filter() from None
    if not is_stable(F - L @ C, discrete=True):
        raise _no_filter()
    return StationaryFilter(P, np.asarray(L), S)


def _doubled(F: Array, C: Array, Q: Array, R: Array) -> Array:
    eye = np.eye(len(F))
    A, G, P = F.T, C.T @ np.linalg.solve(R, C), np.array(Q)
    for _ in range(_DOUBLINGS):
        if not (np.max(np.abs(A)) < _LARGEST and np.max(np.abs(P)) < _LARGEST):
            raise _no_filter()
        left = np.linalg.solve((eye + G @ P).T, A.T).T  # A (I + G P)^-1
        change = A.T @ P @ np.linalg.solve(eye + G @ P, A)
        A, G, P = left @ A, G + left @ G @ A.T, P + (change + change.T) / 2
        if np.max(np.abs(change)) <= _SETTLED * np.max(np.abs(P)):
            break
    return P


def filter_changes(
    found: StationaryFilter, given: tuple[Array, Array], changes: Sequence[Array]
) -> StationaryFilter:
    """Derivatives of a filter of `given` F and C along the k `changes` of F, C, Q and R."""
    (F, C), (P, L, S), (dF, dC, dQ, dR) = given, found, changes
    turned = (dF - L @ dC) @ P @ (F - L @ C).T
    dP = lyapunov_series(F - L @ C, turned + turned.transpose(0, 2, 1) + dQ + L @ dR @ L.T)
    seen = dC @ P @ C.T
    dS = C @ dP @ C.T + seen + seen.transpose(0, 2, 1) + dR
    product = dF @ P @ C.T + F @ dP @ C.T + F @ P @ dC.transpose(0, 2, 1) - L @ dS
    dL = np.linalg.solve(S.T, product.transpose(0, 2, 1)).transpose(0, 2, 1)
    return StationaryFilter(dP, np.asarray(dL), dS)


def _no_filter() -> SolverError:
    return SolverError(
        "observer",
        "has no stationary Kalman filter: a mode that does not decay is unobserved or noise-free",
        "add a signal to `sensed`, or set motor or process noise above zero",
    )


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
