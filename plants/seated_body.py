"""One sample of the nonlinear seated body, with delay and muscle solved exactly.

Delay and muscle are linear and driven only by the held command, so the torque at the nodes of a
Runge-Kutta step has a closed form. Only the two bodies are integrated, and the step size need not
resolve the fast delay states. Equations (3.18) to (3.20) of the dissertation; Runge-Kutta step of
Hairer, Nørsett and Wanner 1993, section II.1.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
import scipy.linalg

from plants._checks import finite_number, whole_number
from plants.actuation import delayed_muscle
from plants.seated_balance import body_dynamics
from plants.seated_parameters import SeatedBalanceParameters

__all__ = ["seated_balance_body"]


def seated_balance_body(
    parameters: SeatedBalanceParameters | None = None,
    sample_time: float = 0.01,
    delay_order: int = 5,
    substeps: int = 1,
) -> ca.Function:
    """Return the function of one sample of the nonlinear plant with held inputs.

    Parameters
    ----------
    parameters : SeatedBalanceParameters, optional
        The defaults if omitted.
    sample_time : float
        Sample time in s.
    delay_order : int
        Order of the Padé approximant of the delay.
    substeps : int
        Number of Runge-Kutta steps per sample.

    Returns
    -------
    casadi.Function
        (state (5 + delay_order), input (2): command and perturbation in N m) -> next state; order
        and units as in `plants.seated_balance`.

    Raises
    ------
    ValueError
        If an argument is out of range.
    """
    parameters = parameters or SeatedBalanceParameters()
    sample_time = finite_number("sample_time", sample_time, "give it in seconds", above=0.0)
    substeps = whole_number("substeps", substeps, "1 is usual", least=1, most=10_000)
    chain = delayed_muscle(parameters.tau_d, parameters.tau_m, delay_order)
    bodies = body_dynamics(parameters)
    n, h = len(chain.B), sample_time / substeps
    state, inputs = ca.SX.sym("state", 4 + n), ca.SX.sym("input", 2)
    command, perturbation = inputs[0], inputs[1]
    generator = np.block([[chain.A, chain.B[:, None]], [np.zeros((1, n + 1))]])
    # The first n rows of exp(generator t) give the chain's state after t; row n is the torque.
    held = ca.vertcat(state[4:], command)

    def rate(body: ca.SX, half_steps: int) -> ca.SX:
        torque = ca.DM(scipy.linalg.expm(generator * h / 2 * half_steps)[n - 1 : n]) @ held
        return bodies(body, ca.vertcat(torque, perturbation))

    body = state[:4]
    for k in range(substeps):
        k1 = rate(body, 2 * k)
        k2 = rate(body + h / 2 * k1, 2 * k + 1)
        k3 = rate(body + h / 2 * k2, 2 * k + 1)
        k4 = rate(body + h * k3, 2 * k + 2)
        body = body + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    ahead = ca.DM(scipy.linalg.expm(generator * sample_time)[:n]) @ held
    return ca.Function(
        "seated_balance_body",
        [state, inputs],
        [ca.vertcat(body, ahead)],
        ["state", "input"],
        ["next"],
        {"cse": True},
    )
