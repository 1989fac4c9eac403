"""Balance on a seat that tilts sideways: equations (3.18) to (3.20) of the dissertation.

Both angles are absolute, from the vertical and in the same sense: theta1 of the lower body and
seat, theta2 of the upper body. The lumbar torque u turns the upper body towards +theta2 and reacts
on the lower body; d is the perturbation torque of the robot on the seat. All are positive to the
right, seen from behind; the plant is symmetric, so that all may be positive to the left instead.
With h = m2 l12 l2 and x = theta1 - theta2,

    (J1 + m1 l1^2 + m2 l12^2) theta1'' + h cos(x) theta2'' = - h sin(x) theta2'^2
        + (m1 l1 + m2 l12) g sin(theta1) - k_r theta1 - c_r theta1' - k_h x - c_h x' + d - u
    (J2 + m2 l2^2) theta2'' + h cos(x) theta1'' = h sin(x) theta1'^2
        + m2 g l2 sin(theta2) + k_h x + c_h x' + u

The command drives u through a delay and a muscle (`plants.actuation`). States, in this order:
theta1, theta2 (rad), theta1_rate, theta2_rate (rad/s), delay_1 ... delay_n and muscle_torque
(N m); ten states at the default order 5 of the delay. Inputs: command, perturbation (N m). Outputs:
theta1, theta2 (rad). A bound on the command acts before delay and muscle.

The coordinates of the delay states, and therefore weights on them and gains from them, depend on
the realisation of the delay; body states, torque and their gains do not.
"""

from __future__ import annotations

import functools
from dataclasses import fields
from types import SimpleNamespace
from typing import Any

import casadi as ca
import control
import numpy as np
import scipy.linalg

from plants._checks import finite_number
from plants._units import with_signals
from plants.actuation import delayed_muscle
from plants.seated_drawing import seated_lines
from plants.seated_parameters import SeatedBalanceParameters

_TURNS = "to the right: it turns the trunk to the right and the seat to the left"
_PUSHES = "to the right: it turns the right edge of the seat down"
# Name of a signal -> unit, words, and what is positive.
_SIGNALS: dict[str, tuple[str, ...]] = {
    "theta1": ("rad", "seat tilt", "to the right: the right edge of the seat goes down"),
    "theta2": ("rad", "trunk tilt", "to the right: the head goes to the right"),
    "theta1_rate": ("rad/s", "seat velocity", "to the right"),
    "theta2_rate": ("rad/s", "trunk velocity", "to the right"),
    "muscle_torque": ("N m", "muscle torque", _TURNS),
    "command": ("N m", "commanded torque", _TURNS),
    "perturbation": ("N m", "perturbation torque", _PUSHES),
}
_BODY, _TORQUE, _INPUTS = list(_SIGNALS)[:4], list(_SIGNALS)[4], list(_SIGNALS)[5:]


def seated_balance_plant(
    parameters: SeatedBalanceParameters | None = None,
    sample_time: float = 0.01,
    delay_order: int = 5,
) -> Any:
    """Return the linear plant, sampled with its inputs held.

    Parameters
    ----------
    parameters : SeatedBalanceParameters, optional
        The defaults if omitted.
    sample_time : float
        Sample time in s.
    delay_order : int
        Order of the Padé approximant of the delay, see `plants.actuation.pade_delay`.

    Returns
    -------
    control.StateSpace
        Discrete, with ``5 + delay_order`` states, the inputs command and perturbation in N m, the
        outputs theta1 and theta2 in rad; order and units as in the module's docstring.

    Raises
    ------
    ValueError
        If the sample time or the order is out of range.
    """
    sample_time = finite_number("sample_time", sample_time, "give it in seconds", above=0.0)
    parameters = parameters or SeatedBalanceParameters()
    # exp([A B; 0 0] T) = [Ad Bd; 0 I]: exact also for singular A.
    held = scipy.linalg.expm(_augmented(*_matrices(parameters, delay_order)) * sample_time)
    n = len(held) - len(_INPUTS)
    return _named(held[:n, :n], held[:n, n:], sample_time, "seated_balance", parameters)


def seated_balance_slopes(
    parameters: SeatedBalanceParameters, sample_time: float, delay_order: int
) -> dict[str, tuple[Any, Any]]:
    """Return the derivatives of A and B of `seated_balance_plant` by each parameter, by name."""
    A, B = _matrices(parameters, delay_order)
    whole, known, n = _augmented(A, B), fields(parameters), len(A)
    along = np.zeros((len(known), *whole.shape))
    by_state, by_input = _slopes_at_rest(derivatives=True)(_values(parameters))
    along[:, :4, :4] = by_state.full().T.reshape(-1, 4, 4).swapaxes(1, 2)
    by = by_input.full().T.reshape(-1, 2, 4).swapaxes(1, 2)
    along[:, :4, n - 1], along[:, :4, n + 1] = by[..., 0], by[..., 1]
    # The rows of the delay are proportional to 1 / tau_d, that of the muscle to 1 / tau_m.
    names = [each.name for each in known]
    along[names.index("tau_d"), 4 : n - 1] = -whole[4 : n - 1] / parameters.tau_d
    along[names.index("tau_m"), n - 1] = -whole[n - 1] / parameters.tau_m
    # exp([M D; 0 M]) has the derivative of exp(M) along D beside exp(M).
    size = len(whole)
    both = np.zeros((len(known), 2 * size, 2 * size))
    both[:, :size, :size] = both[:, size:, size:] = whole
    both[:, :size, size:] = along
    moved = scipy.linalg.expm(both * sample_time)[:, :n, size:]
    return {name: (part[:, :n], part[:, n:]) for name, part in zip(names, moved, strict=True)}


def continuous_seated_balance_plant(
    parameters: SeatedBalanceParameters | None = None, delay_order: int = 5
) -> Any:
    """Return the linear plant in continuous time: the exact linearisation at upright rest.

    Parameters
    ----------
    parameters : SeatedBalanceParameters, optional
        The defaults if omitted.
    delay_order : int
        Order of the Padé approximant of the delay.

    Returns
    -------
    control.StateSpace
        Continuous (``dt`` 0), names and units as for `seated_balance_plant`.

    Raises
    ------
    ValueError
        If the order is out of range.
    """
    parameters = parameters or SeatedBalanceParameters()
    A, B = _matrices(parameters, delay_order)
    return _named(A, B, 0.0, "seated_balance_continuous", parameters)


def _matrices(parameters: SeatedBalanceParameters, delay_order: int) -> tuple[Any, Any]:
    """A and B in continuous time."""
    chain = delayed_muscle(parameters.tau_d, parameters.tau_m, delay_order)
    by_state, by_input = (part.full() for part in _slopes_at_rest()(_values(parameters)))
    n = 4 + len(chain.B)
    A, B = np.zeros((n, n)), np.zeros((n, 2))
    A[:4, :4], A[:4, -1], A[4:, 4:] = by_state, by_input[:, 0], chain.A
    B[:4, 1], B[4:, 0] = by_input[:, 1], chain.B
    return A, B


def _augmented(A: Any, B: Any) -> Any:
    """[A B; 0 0]."""
    return np.block([[A, B], [np.zeros((B.shape[1], len(A) + B.shape[1]))]])


def _values(parameters: SeatedBalanceParameters) -> list[float]:
    return [getattr(parameters, each.name) for each in fields(parameters)]


@functools.cache
def _slopes_at_rest(*, derivatives: bool = False) -> ca.Function:
    """Function from all parameters to the Jacobians of the body dynamics at rest.

    With `derivatives`, to those of their entries, column by column, by the parameters.
    """
    known = fields(SeatedBalanceParameters)
    values, state, inputs = ca.SX.sym("p", len(known)), ca.SX.sym("x", 4), ca.SX.sym("u", 2)
    named = {each.name: values[place] for place, each in enumerate(known)}
    rate = _body_rate(SimpleNamespace(**named), state, inputs)
    slopes = ca.jacobian(rate, ca.vertcat(state, inputs))
    at_rest = ca.densify(ca.substitute(slopes, ca.vertcat(state, inputs), ca.DM.zeros(6)))
    both = [at_rest[:, :4], at_rest[:, 4:]]
    if derivatives:
        both = [ca.densify(ca.jacobian(ca.vec(part), values)) for part in both]
    return ca.Function("slopes", [values], both)


def nonlinear_dynamics(
    parameters: SeatedBalanceParameters | None = None, delay_order: int = 5
) -> ca.Function:
    """Return the nonlinear body dynamics with linear delay and muscle.

    Parameters
    ----------
    parameters : SeatedBalanceParameters, optional
        The defaults if omitted.
    delay_order : int
        Order of the Padé approximant of the delay.

    Returns
    -------
    casadi.Function
        (state (5 + delay_order), input (2)) -> state rate; order and units as in the module's
        docstring. `plants.integration.runge_kutta_step` integrates it over a sample.

    Raises
    ------
    ValueError
        If the order is out of range.
    """
    parameters = parameters or SeatedBalanceParameters()
    chain = delayed_muscle(parameters.tau_d, parameters.tau_m, delay_order)
    bodies = body_dynamics(parameters)
    state = ca.SX.sym("state", 4 + len(chain.B))
    inputs = ca.SX.sym("input", 2)
    command, perturbation = inputs[0], inputs[1]
    body, actuation = state[:4], state[4:]
    torque = actuation[-1]
    rate = ca.vertcat(
        bodies(body, ca.vertcat(torque, perturbation)),
        ca.DM(chain.A) @ actuation + ca.DM(chain.B) * command,
    )
    return ca.Function("seated_balance", [state, inputs], [rate], ["state", "input"], ["rate"])


def body_dynamics(parameters: SeatedBalanceParameters | None = None) -> ca.Function:
    """Return the nonlinear dynamics of the two bodies without delay and muscle.

    Parameters
    ----------
    parameters : SeatedBalanceParameters, optional
        The defaults if omitted.

    Returns
    -------
    casadi.Function
        (state (4): angles in rad, then their rates in rad/s; input (2): lumbar torque u,
        perturbation d in N m) -> state rate (4).
    """
    state, inputs = ca.SX.sym("state", 4), ca.SX.sym("input", 2)
    rate = _body_rate(parameters or SeatedBalanceParameters(), state, inputs)
    return ca.Function("bodies", [state, inputs], [rate], ["state", "input"], ["rate"])


def _body_rate(p: Any, state: ca.SX, inputs: ca.SX) -> Any:
    theta1, theta2, rate1, rate2 = ca.vertsplit(state)
    u, d = inputs[0], inputs[1]
    angle = theta1 - theta2
    coupling = p.m2 * p.l12 * p.l2 * ca.sin(angle)
    lumbar = p.k_h * angle + p.c_h * (rate1 - rate2)
    robot = p.k_r * theta1 + p.c_r * rate1
    gravity1 = (p.m1 * p.l1 + p.m2 * p.l12) * p.gravity * ca.sin(theta1)
    gravity2 = p.m2 * p.l2 * p.gravity * ca.sin(theta2)
    moments = ca.vertcat(
        gravity1 - coupling * rate2**2 - robot - lumbar + d - u,
        gravity2 + coupling * rate1**2 + lumbar + u,
    )
    return ca.vertcat(rate1, rate2, ca.solve(_mass(p, angle), moments))


def _mass(p: Any, angle: ca.SX) -> ca.SX:
    lower = p.J1 + p.m1 * p.l1**2 + p.m2 * p.l12**2
    upper = p.J2 + p.m2 * p.l2**2
    shared = p.m2 * p.l12 * p.l2 * ca.cos(angle)
    matrix: ca.SX = ca.vertcat(ca.horzcat(lower, shared), ca.horzcat(shared, upper))
    return matrix


def _named(A: Any, B: Any, sample_time: float, name: str, p: SeatedBalanceParameters) -> Any:
    n = len(A)
    delays: dict[str, tuple[str, ...]] = {
        f"delay_{k}": ("N m", f"neural delay, state {k}") for k in range(1, n - 4)
    }
    names: dict[str, Any] = {"inputs": _INPUTS, "outputs": _BODY[:2], "name": name}
    names["states"] = [*_BODY, *delays, _TORQUE]
    system = control.ss(A, B, np.eye(2, n), np.zeros((2, 2)), dt=sample_time, **names)
    system.gravity = {
        "theta1": p.gravity * (p.m1 * p.l1 + p.m2 * p.l12),
        "theta2": p.gravity * p.m2 * p.l2,
    }
    system.drawing = functools.partial(seated_lines, p)
    return with_signals(system, _SIGNALS | delays)
