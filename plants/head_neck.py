"""Head tracking in yaw and pitch: visual, vestibular, proprioceptive and intrinsic pathways.

r is the target angle, y the head angle, e = r - y. With the trunk at rest

    visual           T_vis = Kvis exp(-tau s) e
    vestibular       T_vcr = Kvcr s^2 (tau1A s + 1)(tauCNS1 s + 1) / ((tauC s + 1)(tauCNS2 s + 1)) y
    proprioceptive   T_ccr = Kccr (tauMS1 s + 1)(tauMS2 s + 1) y
    torque           T = (T_vis - T_vcr - T_ccr) / (tau_c s + 1)
    head             (J s^2 + B s + K - m g l) y = T        m g l in pitch only

(Peng, Hain, Peterson 1996; Chen et al. 2002; the dissertation's chapters 4 and 5.) The vestibular
and proprioceptive blocks alone are improper, so the loop is one fraction:

    y = N / D u,   u = Kvis exp(-tau s) (r - y),   N = (tauC s + 1)(tauCNS2 s + 1)
    D = (tau_c s + 1)(J s^2 + B s + K - m g l) N + Kvcr s^2 (tau1A s + 1)(tauCNS1 s + 1)
        + Kccr (tauMS1 s + 1)(tauMS2 s + 1) N

of degree 5, with a Padé approximant of the delay. Internally time is in units of 1/3 s, which
reduces the range of the companion form's coefficients from 1e9 to 1e4. The fast pole (about
16 000 1/s) requires exact discretisation.
"""

from __future__ import annotations

import itertools
from typing import Any, Literal, NamedTuple

import casadi as ca
import control
import numpy as np
from numpy.typing import NDArray

from plants._checks import finite_number, whole_number
from plants._units import with_signals
from plants.actuation import pade_delay

#: An axis of the head, for annotations.
Axis = Literal["yaw", "pitch"]
_SCALE = 3.0  # rad/s


class HeadNeckParameter(NamedTuple):
    """A candidate parameter of the loop.

    Attributes
    ----------
    name, meaning : str
        Name in table 4.2, and description.
    unit : str
        Unit of its values.
    low, high : float
        Bounds, in that unit.
    pathway : str
        Pathway of the loop to which it belongs.
    """

    name: str
    meaning: str
    unit: str
    low: float
    high: float
    pathway: str


#: The twelve candidate parameters of chapters 4 and 5, in their order. Names: dissertation, table
#: 4.2; bounds: likely, consistent with its interval widths.
HEAD_NECK_PARAMETERS = tuple(
    HeadNeckParameter(*row)
    for row in (
        ("Kvis", "visual gain", "N m/rad", 50.0, 1000.0, "visual"),
        ("Kvcr", "vestibular gain", "N m s^2/rad", 500.0, 10000.0, "vestibular"),
        ("Kccr", "proprioceptive gain", "N m/rad", 1.0, 300.0, "proprioceptive"),
        ("tau", "visual delay", "s", 0.1, 0.4, "visual"),
        ("tau1A", "lead of irregular vestibular afferents", "s", 0.01, 0.4, "vestibular"),
        ("tauCNS1", "lead of the central nervous system", "s", 0.05, 1.0, "vestibular"),
        ("tauC", "lag of irregular vestibular afferents", "s", 0.1, 5.0, "vestibular"),
        ("tauCNS2", "lag of the central nervous system", "s", 5.0, 60.0, "vestibular"),
        ("tauMS1", "first lead of the muscle spindle", "s", 0.01, 1.0, "proprioceptive"),
        ("tauMS2", "second lead of the muscle spindle", "s", 0.01, 1.0, "proprioceptive"),
        ("B", "intrinsic damping", "N m s/rad", 0.1, 5.0, "intrinsic"),
        ("K", "intrinsic stiffness", "N m/rad", 0.1, 5.0, "intrinsic"),
    )
)
#: Fixed: inertia of the head (yaw; pitch adds m l^2), torque converter, mass and lever in pitch.
HEAD_NECK_FIXED = {
    "J": (0.0148, "kg m^2", "Peng et al. 1996"),
    "tau_c": (0.1, "s", "Peng et al. 1996"),
    "m": (4.5, "kg", "chosen: not in the dissertation"),
    "l": (0.15, "m", "chosen: not in the dissertation"),
}
#: Table 4.3 of the dissertation, means over ten subjects; None: fixed at the nominal mean.
TABLE_4_3: dict[str, tuple[float | None, ...]] = {
    "nominal": (428, 4860, 87.9, 0.263, 0.099, 0.675, 1.733, 27.2, 0.433, 0.439, 1.690, 2.170),
    "fim": (279, None, 16.2, 0.242, 0.069, 0.918, None, None, None, None, None, None),
    "lasso": (401, 8055, 36.4, 0.226, None, None, 2.200, None, None, None, None, None),
}
# SD of the nominal column over its ten subjects. It includes estimation errors, mostly in the last
# five parameters, so it overstates the differences between people.
_BETWEEN_PEOPLE = (125, 2205, 55.3, 0.027, 0.063, 0.280, 1.118, 16.2, 0.381, 0.325, 1.213, 1.736)


def table_4_3_column(name: str) -> NDArray[np.float64]:
    """All twelve parameters of the column `name` of table 4.3; empty cells: nominal mean."""
    filled = zip(TABLE_4_3[name], TABLE_4_3["nominal"], strict=True)
    return np.array([base if value is None else value for value, base in filled], dtype=float)


def head_neck_matrices(axis: Axis = "yaw", delay_order: int = 5) -> ca.Function:
    """Return the function theta (12) -> A (n, n), B (n, 1), C (1, n), n = 5 + order.

    Parameters
    ----------
    axis : {"yaw", "pitch"}
        Axis of rotation; gravity acts in pitch only.
    delay_order : int
        Order of the Padé approximant.

    Raises
    ------
    ValueError
        If the axis is unknown or the order is out of range.
    """
    if axis not in ("yaw", "pitch"):
        raise ValueError(f"axis: expected yaw or pitch, got {axis!r:.60}; give one of them")
    order = whole_number("delay_order", delay_order, "5 is usual", least=1, most=10)
    theta = ca.SX.sym("theta", len(HEAD_NECK_PARAMETERS))
    kvis, tau = theta[0], theta[3]
    numerator, denominator = _inner(theta, axis)
    lead = denominator[-1]
    a = [coefficient / lead for coefficient in denominator[:-1]]
    n = len(a)
    inner = ca.SX(np.eye(n, k=1))
    inner[n - 1, :] = ca.horzcat(*(-coefficient for coefficient in a))
    seen = ca.SX.zeros(1, n)
    seen[: len(numerator)] = ca.horzcat(*(coefficient / lead for coefficient in numerator))
    enters = ca.SX(np.eye(n)[:, -1:])
    delay = pade_delay(1.0, order)  # for one second; rescaled in time by `rate`
    rate = 1 / (tau * _SCALE)
    D = np.asarray(delay.A)
    E, F = np.reshape(delay.B, (order, 1)), np.reshape(delay.C, (1, order))
    through = float(np.ravel(delay.D)[0])
    # Delayed signal: F z + through w, z' = rate (D z + E w), w = Kvis (r - y).
    A = ca.vertcat(
        ca.horzcat(inner - enters * through * kvis @ seen, enters @ ca.SX(F)),
        ca.horzcat(-rate * kvis * ca.SX(E) @ seen, rate * ca.SX(D)),
    )
    B = ca.vertcat(enters * through * kvis, rate * kvis * ca.SX(E))
    C = ca.horzcat(seen, ca.SX.zeros(1, order))
    return ca.Function(
        "head_neck", [theta], [_SCALE * A, _SCALE * B, C], ["theta"], ["A", "B", "C"]
    )


def head_neck_plant(values: NDArray[np.float64], axis: Axis = "yaw") -> Any:
    """Return the closed loop from reference to head angle as a continuous control.StateSpace.

    Parameters
    ----------
    values : array_like
        Parameters (12,), in the order and units of `HEAD_NECK_PARAMETERS`.
    axis : {"yaw", "pitch"}
        Axis of rotation; gravity acts in pitch only.

    Raises
    ------
    ValueError
        If there are not twelve finite values, or see `head_neck_matrices`.
    """
    given = np.asarray(values, dtype=np.float64)
    if given.shape != (len(HEAD_NECK_PARAMETERS),):
        raise ValueError(
            f"values: expected 12 numbers, got shape {given.shape}; give one a parameter"
        )
    for item, value in zip(HEAD_NECK_PARAMETERS, given, strict=True):
        finite_number(item.name, float(value), f"give it in {item.unit}")
    A, B, C = (item.full() for item in head_neck_matrices(axis)(given))
    names: dict[str, Any] = {"inputs": ["reference"], "outputs": ["head"]}
    signals = {"reference": ("rad", "target angle"), "head": ("rad", "head angle")}
    return with_signals(control.ss(A, B, C, 0, **names), signals)


def step_reference(
    duration: float = 30.0,
    rate: float = 60.0,
    amplitude: float = 4.0,
    shortest: float = 0.3,
    longest: float = 0.9,
    seed: int = 0,
) -> NDArray[np.float64]:
    """Steps of random duration and size: the reference signal of chapters 4 and 5.

    Parameters
    ----------
    duration : float
        Duration in s.
    rate : float
        Samples per s.
    amplitude : float
        Largest magnitude, in any unit. The dissertation does not give it.
    shortest, longest : float
        Durations of a step in s: 0.3 and 0.9 in chapter 5.
    seed : int
        Seed of the random numbers.

    Returns
    -------
    ndarray of shape (samples,)
        samples = round(duration * rate).
    """
    rng = np.random.default_rng(seed)
    samples = round(duration * rate)
    values = np.empty(samples)
    first = 0
    while first < samples:
        last = first + max(1, round(rng.uniform(shortest, longest) * rate))
        values[first:last] = rng.uniform(-amplitude, amplitude)
        first = last
    return values


def _inner(theta: Any, axis: Axis) -> tuple[list[Any], list[Any]]:
    """Coefficients of N and D in p = s / scale, lowest power first."""
    kvcr, kccr, t1a, tcns1, tc, tcns2, tms1, tms2, damping, stiffness = (
        theta[index] for index in (1, 2, 4, 5, 6, 7, 8, 9, 10, 11)
    )
    J, converter, m, lever = (HEAD_NECK_FIXED[name][0] for name in ("J", "tau_c", "m", "l"))
    gravity = m * 9.81 * lever if axis == "pitch" else 0.0
    inertia = J + m * lever**2 if axis == "pitch" else J
    N = _product([1, tc], [1, tcns2])
    head = _product([1, converter], [stiffness - gravity, damping, inertia])
    canal = _product([0, 0, kvcr], _product([1, t1a], [1, tcns1]))
    spindle = _product([kccr, kccr * tms1], [1, tms2])
    D = _sum(_product(head, N), canal, _product(spindle, N))
    return (
        [item * _SCALE**power for power, item in enumerate(N)],
        [item * _SCALE**power for power, item in enumerate(D)],
    )


def _product(one: list[Any], other: list[Any]) -> list[Any]:
    found: list[Any] = [0] * (len(one) + len(other) - 1)
    for i, a in enumerate(one):
        for j, b in enumerate(other):
            found[i + j] = found[i + j] + a * b
    return found


def _sum(*polynomials: list[Any]) -> list[Any]:
    return [sum(each) for each in itertools.zip_longest(*polynomials, fillvalue=0)]


def head_neck_model(axis: Axis = "yaw", delay_order: int = 5) -> dict[str, Any]:
    """Return the model for `impc select`: names, bounds, pathways, matrices.

    Typical values are the nominal column of table 4.3, deviations between people its SDs. For
    `axis`, `delay_order` and errors see `head_neck_matrices`.
    """
    names, meanings, units, low, high, pathways = zip(*HEAD_NECK_PARAMETERS, strict=True)
    return {
        "names": names,
        "low": low,
        "high": high,
        "typical": [float(value) for value in TABLE_4_3["nominal"] if value is not None],
        "deviation": list(_BETWEEN_PEOPLE),
        "pathways": pathways,
        "meanings": meanings,
        "units": units,
        "inputs": ["reference"],
        "outputs": ["head"],
        "rate": 60.0,
        "matrices": head_neck_matrices(axis, delay_order),
    }
