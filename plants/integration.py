"""Fixed-step integration of a plant as a CasADi function.

Source: Hairer, Nørsett and Wanner 1993, section II.1.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca

from plants._checks import Array, finite_number, whole_number


def runge_kutta_step(dynamics: ca.Function, step: float, substeps: int = 1) -> ca.Function:
    """Return the function of one sample by the classical fourth-order Runge-Kutta method.

    Parameters
    ----------
    dynamics : casadi.Function
        (state (n), input (m)) -> state rate (n), in units per s.
    step : float
        Sample time in s, over which the input is held.
    substeps : int
        Number of Runge-Kutta steps per sample.

    Returns
    -------
    casadi.Function
        (state (n), input (m)) -> state at the end of the sample (n).

    Raises
    ------
    ValueError
        If the step is not positive or the substeps are not a whole number from 1 to 10000.
    """
    step = finite_number("step", step, "give it in seconds", above=0.0)
    substeps = whole_number("substeps", substeps, "1 is usual", least=1, most=10_000)
    start = state = ca.MX.sym("state", *dynamics.size_in(0))
    held = ca.MX.sym("input", *dynamics.size_in(1))
    for _ in range(substeps):
        state = one_step(lambda at, _: dynamics(at, held), state, step / substeps)
    return ca.Function("runge_kutta_step", [start, held], [state], ["state", "input"], ["next"])


def one_step(rate: Callable[[Any, float], Any], state: Any, h: float) -> Any:
    """State after a Runge-Kutta step of `h` s; `rate` takes the state and the share of the step."""
    k1 = rate(state, 0.0)
    k2 = rate(state + h / 2 * k1, 0.5)
    k3 = rate(state + h / 2 * k2, 0.5)
    k4 = rate(state + h * k3, 1.0)
    return state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def with_linear_part(step: ca.Function, A: Array, B: Array) -> ca.Function:
    """Correct a sample so that its linearisation at rest is exactly x+ = A x + B u.

    This removes most of the integration error, which is in the linear part.

    Parameters
    ----------
    step : casadi.Function
        (state (n), input (m)) -> next state (n), with a linearisation close to A and B.
    A, B : Array
        Matrices of the sampled linear plant, (n, n) and (n, m).
    """
    state, inputs = ca.SX.sym("state", *step.size_in(0)), ca.SX.sym("input", *step.size_in(1))
    ahead = step(state, inputs)
    slopes = ca.Function(
        "slopes", [state, inputs], [ca.jacobian(ahead, state), ca.jacobian(ahead, inputs)]
    )
    at_rest = slopes(0, 0)
    wrong = [ca.DM(exact) - ca.densify(found) for exact, found in zip((A, B), at_rest, strict=True)]
    by_state, by_input = (ca.sparsify(part, 1e-15) for part in wrong)
    corrected = ahead + by_state @ state + by_input @ inputs
    return ca.Function(
        "step", [state, inputs], [corrected], ["state", "input"], ["next"], {"cse": True}
    )
