"""Seated-balance plant of a person from the arguments in a configuration file.

Body: `plants.anthropometry`, after de Leva 1996. Plant: `plants.seated_balance`.
"""

from __future__ import annotations

import functools
from dataclasses import asdict, fields, replace
from typing import Any

import casadi as ca
import numpy as np
import scipy.linalg

from plants._units import with_uncertainty
from plants.actuation import delayed_muscle
from plants.anthropometry import DE_LEVA, Sex, from_anthropometry
from plants.integration import one_step, runge_kutta_step, with_linear_part
from plants.seated_balance import (
    body_dynamics,
    nonlinear_dynamics,
    seated_balance_plant,
    seated_balance_slopes,
)
from plants.seated_parameters import SeatedBalanceParameters

_ARGUMENTS = {
    "mass": ("body mass", "kg"),
    "height": ("body height", "m"),
    "sex": ("sex (for the shares of body segments)", "", *DE_LEVA),
    "sample_time": ("sample time", "s"),
    "delay_order": ("order of the approximation of the delay", ""),
    **{
        each.name: (each.metadata["words"], each.metadata["unit"])
        for each in fields(SeatedBalanceParameters)
    },
}


def seated_parameters_for(
    mass: float = 79.7, height: float = 1.66, sex: Sex = "male", **parameters: float
) -> SeatedBalanceParameters:
    """Parameters from body mass (kg), height (m) and sex, except the given `parameters`.

    Raises
    ------
    ValueError
        If an argument is out of range or a name is unknown.
    """
    known = [item.name for item in fields(SeatedBalanceParameters)]
    unknown = [name for name in parameters if name not in known]
    if unknown:
        raise ValueError(f"{unknown[0]}: is not a parameter of the seat; use {', '.join(known)}")
    return replace(from_anthropometry(mass, height, sex), **parameters)


def seated_balance_for(
    mass: float = 79.7,
    height: float = 1.66,
    sex: Sex = "male",
    sample_time: float = 0.01,
    delay_order: int = 5,
    **parameters: float,
) -> Any:
    """Return the plant of a person as a discrete control.StateSpace, with its nonlinear body.

    Parameters and their standard deviations are those of `SeatedBalanceParameters`.

    Parameters
    ----------
    mass, height : float
        Body mass in kg and height in m.
    sex : {"male", "female"}
        Sample of body segments.
    sample_time : float
        Sample time in s.
    delay_order : int
        Order of the Padé approximant.
    **parameters : float
        Fields of `SeatedBalanceParameters` that replace the regressed values.

    Raises
    ------
    ValueError
        See `seated_parameters_for` and `seated_balance_plant`.
    """
    found = seated_parameters_for(mass, height, sex, **parameters)
    system = seated_balance_plant(found, sample_time, delay_order)

    def body() -> ca.Function:
        return with_linear_part(_body(found, sample_time, delay_order), system.A, system.B)

    system.body = body  # made only on demand: takes 0.05 s
    system.slopes = functools.partial(seated_balance_slopes, found, sample_time, delay_order)
    return with_uncertainty(system, asdict(found), found.uncertainty, _ARGUMENTS)


def seated_balance_step_for(
    mass: float = 79.7,
    height: float = 1.66,
    sex: Sex = "male",
    sample_time: float = 0.001,
    delay_order: int = 5,
    **parameters: float,
) -> ca.Function:
    """Return the function of one Runge-Kutta sample of the nonlinear plant of a person.

    Parameters
    ----------
    mass, height, sex, sample_time, delay_order, **parameters
        See `seated_balance_for`. The default sample time is 1 ms.

    Returns
    -------
    casadi.Function
        (state (5 + delay_order), input (2): command and perturbation in N m) -> next state.

    Raises
    ------
    ValueError
        See `seated_parameters_for` and `nonlinear_dynamics`.
    """
    found = seated_parameters_for(mass, height, sex, **parameters)
    return runge_kutta_step(nonlinear_dynamics(found, delay_order), sample_time)


def _body(parameters: SeatedBalanceParameters, sample_time: float, delay_order: int) -> ca.Function:
    """Function of one sample of the nonlinear plant, with delay and muscle solved exactly.

    Both are linear and driven only by the held command, so the torque at the nodes of a Runge-Kutta
    step has a closed form. Only the two bodies are integrated, and the step need not resolve the
    fast delay states.
    """
    chain = delayed_muscle(parameters.tau_d, parameters.tau_m, delay_order)
    bodies, n = body_dynamics(parameters), len(chain.B)
    state, inputs = ca.SX.sym("state", 4 + n), ca.SX.sym("input", 2)
    generator = np.block([[chain.A, chain.B[:, None]], [np.zeros((1, n + 1))]]) * sample_time
    held = ca.vertcat(state[4:], inputs[0])

    def after(share: float) -> ca.SX:
        """Delay and muscle after a share of the sample; the last entry is the torque."""
        return ca.DM(scipy.linalg.expm(generator * share)[:n]) @ held

    def rate(body: ca.SX, share: float) -> ca.SX:
        return bodies(body, ca.vertcat(after(share)[n - 1], inputs[1]))

    ahead = ca.vertcat(one_step(rate, state[:4], sample_time), after(1.0))
    names = ["state", "input"], ["next"]
    return ca.Function("seated_balance_body", [state, inputs], [ahead], *names, {"cse": True})
