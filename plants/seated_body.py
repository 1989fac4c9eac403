"""One sample of the seated body by its full equations, with the way of the command solved exactly.

Delay and muscle are linear and nothing acts on them but the command, which is held: the torque at
the nodes of a Runge-Kutta step is known in closed form, and only the two bodies are integrated:
the step need not follow the fast states of the delay. Equations (3.18) to (3.20) of the
dissertation; the step is that of Hairer, Nørsett and Wanner 1993, section II.1.
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
    """Return one sample of the nonlinear plant, its inputs held.

    Parameters
    ----------
    parameters : SeatedBalanceParameters, optional
        The defaults if omitted.
    sample_time : float
        s.
    delay_order : int
        Order of the Padé approximant of the delay.
    substeps : int
        Runge-Kutta steps in the sample.

    Returns
    -------
    casadi.Function
        (state (5 + delay_order), input (2): command and perturbation in Nm) -> next state; order
        and units as in `plants.seated_balance`.

    Raises
    ------
    ValueError
        When an argument is out of range.
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
    # exp(generator t) has the chain's state after t in its first n rows, the last is the torque.
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
