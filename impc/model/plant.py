"""The plant: matrices and signal names read from a `control.StateSpace`.

    x_{t+1} = A x_t + B u_t + E d_t,    y_t = C x_t          (discrete)
    dx/dt   = A x   + B u   + E d,      y   = C x            (continuous)

where u are the inputs that the controller commands and d the recorded disturbances
(docs/why/theory.md, section 1). A plant may also have a nonlinear body x_{t+1} = f(x_t, u_t, d_t).
The matrices are its linearisation at rest: simulations use the body, the controller predicts with
the matrices. Units of gains and weights follow from those of the signals; weights are scaled to
R[0, 0] = 1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import scipy

from impc.arrays import Array, System, as_numbers, finite_array, frozen
from impc.checking import Value, asked, checked, replace
from impc.errors import PlantError, brief
from impc.model.body import Body, lines_at, read_body


@dataclass(frozen=True, init=False)
class Plant(Value):
    """A linear plant with named signals, read from a `control.StateSpace`.

    Parameters
    ----------
    system : control.StateSpace or Plant
        Discrete (``dt`` positive, or True for one second) or continuous (``dt`` zero).
    controls : sequence of str, optional
        Names of the inputs that the controller commands; the others are disturbances. By default
        all inputs are controls.
    units : mapping of str to str, optional
        Unit of each signal by name, such as "rad/s"; "1" for a signal without unit. By default
        `system.units`; signals in neither have an unknown unit.
    words : mapping of str to str, optional
        Description of each signal by name, for reports: "tilt of the seat". By default
        `system.words`.
    body : casadi.Function or callable, optional
        Nonlinear body (state, input) -> next state, or a function that returns it. By default
        `system.body`, if it exists.

    Attributes
    ----------
    A, B, E, C : ndarray
        State matrix (n, n), control matrix (n, m), disturbance matrix (n, d), output matrix (p, n).
    dt : float
        Sample time in s; 0 for continuous time.
    states, controls, disturbances, outputs : tuple of str
        Names of the signals, in the order of the arrays.
    units : tuple of (str, str)
        Pairs of signal and unit; `unit` looks one up.
    words : tuple of (str, str)
        Pairs of signal and description; `word` looks one up.
    directions : tuple of (str, str)
        Pairs of signal and what is positive, from `system.directions`; `direction` looks one up.
    gravity : tuple of (str, float)
        Pairs of an angle and m g h, the moment of gravity in N m/rad, from `system.gravity`; the
        report gives gains in multiples of it.
    commands : tuple of str
        States that are the last command of a control (`with_rates`); usually none.
    body : Body or None
        Nonlinear body that simulations use; None for the linear plant itself.
    observer : ndarray of shape (d,)
        Rate in 1/s at which the controller estimates each disturbance: 0 if it does not, infinite
        if it knows the disturbance; see `with_observer`.
    ahead : int
        Number of samples by which targets are known in advance; see `with_preview`.
    previewed : tuple of str
        Signals whose targets are known in advance.

    Raises
    ------
    PlantError
        If matrices are missing or not finite, an output depends directly on an input, a control is
        not an input, a unit or description names no signal, (A, B) is not stabilisable, or the
        matrices are not the linearisation of the body at rest.

    Examples
    --------
    >>> import control
    >>> import impc
    >>> cart = control.ss([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], 0)
    >>> plant = impc.Plant(control.c2d(cart, 0.1))
    >>> plant.n, plant.m, plant.dt
    (2, 1, 0.1)
    """

    _rules: ClassVar[Mapping[str, Any]] = {
        "A": "n n",
        "B": "n m",
        "E": "n d",
        "C": "p n",
        "dt": 0,
        "observer": "~d",
    }

    A: Array
    B: Array
    E: Array
    C: Array
    dt: float
    states: tuple[str, ...]
    controls: tuple[str, ...]
    disturbances: tuple[str, ...]
    outputs: tuple[str, ...]
    units: tuple[tuple[str, str], ...]
    words: tuple[tuple[str, str], ...]
    directions: tuple[tuple[str, str], ...]
    gravity: tuple[tuple[str, float], ...]
    body: Body | None
    observer: Array
    ahead: int
    previewed: tuple[str, ...]
    commands: tuple[str, ...]

    @checked
    def __init__(
        self,
        system: System,
        controls: Sequence[str] | None = None,
        units: Mapping[str, str] | None = None,
        words: Mapping[str, str] | None = None,
        body: Any = None,
    ) -> None:
        if isinstance(system, Plant):
            self._fill(**vars(system))
            return
        matrices = _matrices(system)
        names = tuple(system.input_labels)
        chosen = names if controls is None else tuple(controls)
        unknown = [name for name in chosen if name not in names]
        if unknown or not chosen:
            raise PlantError(
                "controls",
                f"{brief(unknown or 'none given')}: the inputs are {list(names)}",
                "name at least one of them",
            )
        rest = tuple(name for name in names if name not in chosen)
        moves = getattr(system, "body", None) if body is None else body
        if callable(moves) and not hasattr(moves, "n_in"):  # factory of the body
            moves = asked("plant.body", moves)
        order = [names.index(name) for name in (*chosen, *rest)]
        self._fill(
            A=matrices["A"],
            B=matrices["B"][:, [names.index(name) for name in chosen]],
            E=matrices["B"][:, [names.index(name) for name in rest]],
            C=matrices["C"],
            dt=_sample_time(system.dt),
            states=tuple(system.state_labels),
            controls=chosen,
            disturbances=rest,
            outputs=tuple(system.output_labels),
            units=_texts(system, "units", units, 'unit, as in {"angle": "rad"}'),
            words=_texts(system, "words", words, 'text, as in {"angle": "tilt of the seat"}'),
            directions=_texts(system, "directions", None, 'text, as in {"angle": "to the right"}'),
            gravity=_gravity(system),
            body=None if moves is None else read_body(moves, order, len(matrices["A"])),
            observer=frozen(np.zeros(len(rest))),
            ahead=0,
            previewed=(),
            commands=(),
            # Function and its number of states: no field, and so neither compared nor sent.
            _drawing=(getattr(system, "drawing", None), len(matrices["A"])),
        )
        self.drawing(np.zeros((1, self.n)))
        _require_stabilisable(self)
        if moves is not None:
            _require_linearisation(self.require_discrete(), moves, matrices["B"])

    @property
    def n(self) -> int:
        """Number of states."""
        return self.A.shape[0]

    @property
    def m(self) -> int:
        """Number of control inputs."""
        return self.B.shape[1]

    @property
    def moves(self) -> str:
        """Kind of body that simulations use: "nonlinear" or "linear"."""
        return "linear" if self.body is None else "nonlinear"

    def linear(self) -> Plant:
        """Return the plant without its nonlinear body."""
        return replace(self, body=None)

    @checked
    def unit(self, name: str) -> str:
        """Unit of signal `name`; "SI" if unknown."""
        return dict(self.units).get(name, UNKNOWN)

    @checked
    def word(self, name: str) -> str:
        """Description of signal `name`; empty if the plant has none."""
        return dict(self.words).get(name, "")

    @checked
    def direction(self, name: str) -> str:
        """What is positive in signal `name`, in words; empty if the plant has none."""
        return dict(self.directions).get(name, "")

    @checked(states="* n")
    def drawing(self, states: Array) -> tuple[Array, ...]:
        """Lines (samples, points, 2) in m of the body at `states` (samples, n); y is up.

        They come from `system.drawing`, state (n,) -> lines (points, 2); a plant without has none.
        """
        draw, n = getattr(self, "_drawing", (None, 0))
        return () if draw is None else lines_at(draw, states[:, :n])

    @property
    def discrete(self) -> bool:
        """Whether the plant is sampled."""
        return self.dt > 0

    def require_discrete(self) -> Plant:
        """Return the plant itself if it is discrete.

        Raises
        ------
        PlantError
            If the plant is continuous.
        """
        if not self.discrete:
            raise PlantError(
                "plant",
                "is continuous, but a discrete one is needed",
                "sample it: control.c2d(sys, dt)",
            )
        return self


@checked(T="n n", G="m m")
def change_coordinates(plant: Plant, T: Array, G: Array | None = None) -> Plant:
    """Return the linear plant in z = T^-1 x and v = G^-1 u, T (n, n), G (m, m); same names."""
    back = np.linalg.inv(T)
    inputs = np.eye(plant.m) if G is None else G
    moved = replace(
        plant,
        A=frozen(back @ plant.A @ T),
        B=frozen(back @ plant.B @ inputs),
        E=frozen(back @ plant.E),
        C=frozen(plant.C @ T),
        body=None,
    )
    vars(moved).pop("_drawing", None)  # it is of the other states
    return moved


def _matrices(system: Any) -> dict[str, Array]:
    if not all(hasattr(system, name) for name in ("A", "B", "C", "D", "dt", "input_labels")):
        kind = type(system).__name__
        raise PlantError(
            "plant", f"expected a control.StateSpace, got {kind}", "pass control.ss(A, B, C, D, dt)"
        )
    matrices = {name: frozen(as_numbers(f"plant.{name}", getattr(system, name))) for name in "ABCD"}
    for name, matrix in matrices.items():
        if not np.all(np.isfinite(matrix)):
            raise PlantError(f"plant.{name}", "has NaN or infinite entries", "correct the model")
    if matrices["A"].shape[0] == 0 or matrices["B"].shape[1] == 0:
        raise PlantError("plant", "has no states or no inputs", "give at least one of each")
    if np.any(matrices["D"]):
        raise PlantError(
            "plant.D", "is not zero", "delay the output by a sample or drop the feedthrough"
        )
    return matrices


def _texts(system: Any, kind: str, given: Any, such: str) -> tuple[tuple[str, str], ...]:
    """Pairs (signal, text) from `given` or the system's own attribute `kind`."""
    given = getattr(system, kind, {}) if given is None else given
    known = {*system.state_labels, *system.input_labels, *system.output_labels}
    pairs = tuple(given.items()) if isinstance(given, Mapping) else ((kind, given),)
    for name, text in pairs:
        if name not in known or not isinstance(text, str) or not text.isprintable():
            raise PlantError(
                f"plant.{kind}",
                f"maps {brief(name)} to {brief(text)}",
                f"map the name of a signal to a {such}",
            )
    return pairs


def _gravity(system: Any) -> tuple[tuple[str, float], ...]:
    """Pairs (state, moment of gravity) from the system's own attribute, if it has one."""
    given = getattr(system, "gravity", {})
    if not isinstance(given, Mapping) or not given.keys() <= set(system.state_labels):
        raise PlantError(
            "plant.gravity", f"is {brief(given)}", 'map names of angles to m g h: {"angle": 60.0}'
        )
    values = finite_array("plant.gravity", list(given.values()), (len(given),))
    return tuple(zip(given, values.tolist(), strict=True))


def _sample_time(dt: object) -> float:
    if dt is None:
        raise PlantError("plant.dt", "is missing", "set dt, or 0 for a continuous plant")
    if dt is True:
        return 1.0
    return float(dt)  # type: ignore[arg-type]  # python-control: a number from here on


def _require_linearisation(plant: Plant, body: Any, B: Array) -> None:
    """Require that rest is an equilibrium of the body, with slopes A and B to 1e-3.

    Central differences with step 1e-4: their error is the body's curvature times 1e-8.
    """
    n, count = B.shape
    step = 1e-4 * np.eye(n + count)
    states, inputs = (np.hstack([part, -part]) for part in np.split(step, [n]))
    moved = body.map(2 * (n + count))(states, inputs).full()
    found = (moved[:, : n + count] - moved[:, n + count :]) / 2e-4
    wanted = np.hstack([plant.A, B])
    sizes = np.maximum(np.max(np.abs(wanted), axis=0), 1e-300)
    rest = body(0, 0).full()
    if not np.max(np.abs(rest)) <= 1e-9 or not np.max(np.abs(found - wanted) / sizes) <= 1e-3:
        raise PlantError(
            "plant.body",
            "does not have the linearisation A, B at rest",
            "linearise it at rest, with its order of states and inputs",
        )


def _of_length_one(B: Array) -> Array:
    """Columns divided by their largest entries, unless these are zero."""
    return np.asarray(B / np.maximum(np.max(np.abs(B), axis=0), 1e-300))


def _require_stabilisable(plant: Plant) -> None:
    """Hautus test on the modes that do not decay: [A - s I, B] must have full row rank.

    States are balanced and inputs scaled first, so that units do not matter. The rank is taken at
    1e-10 of the largest singular value; a less stabilisable mode would need gains beyond double
    precision.
    """
    # scipy.linalg.matrix_balance casts extreme scales (1e200 with a denormal) to integers.
    A, _, _, scale, _ = scipy.linalg.lapack.dgebal(plant.A, scale=1, permute=0)
    B = _of_length_one(_of_length_one(plant.B) / scale[:, None]) * max(1.0, np.max(np.abs(A)))
    for mode in scipy.linalg.eigvals(A):
        decays = abs(mode) < 1 if plant.discrete else mode.real < 0
        if decays:
            continue
        singular = scipy.linalg.svdvals(np.hstack([A - mode * np.eye(plant.n), B]))
        if singular[plant.n - 1] <= 1e-10 * singular[0]:
            raise PlantError(
                "plant",
                f"is not stabilisable: no input reaches the mode {mode:.4g}",
                "add an input or remove that mode",
            )


#: Unit of a signal for which the plant states none.
UNKNOWN = "SI"


def gain_unit(plant: Plant, control: str, state: str) -> str:
    """Unit of the gain from a `state` to a `control`, such as "N m/rad"."""
    return _ratio(plant.unit(control), plant.unit(state))


def weight_unit(plant: Plant, one: str, other: str) -> str:
    """Unit of the weight on the product of signals `one` and `other`, such as "(N m)²/rad²"."""
    first = _power(plant.unit(plant.controls[0]))
    pair = plant.unit(one), plant.unit(other)
    if UNKNOWN in pair:
        return UNKNOWN
    bottom = _power(pair[0]) if pair[0] == pair[1] else " ".join(map(_grouped, sorted(pair)))
    return "1" if bottom == first else _ratio(first, bottom)


def _ratio(top: str, bottom: str) -> str:
    if UNKNOWN in (top, bottom):
        return UNKNOWN
    return top if bottom == "1" else f"{top}/{_factor(bottom)}"


def _factor(unit: str) -> str:
    """Denominator, in brackets if it would be ambiguous otherwise."""
    return unit if unit.endswith("²") and unit.count("²") == 1 else _grouped(unit)


def _power(unit: str) -> str:
    if unit in ("1", UNKNOWN):
        return unit
    return f"{_grouped(unit)}²"


def _grouped(unit: str) -> str:
    return f"({unit})" if set(unit) & set(" /") else unit
