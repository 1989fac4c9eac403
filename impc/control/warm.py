"""Compile the numba code of simulations and fits in advance (docs/howto/speed.md).

A cart is simulated in each way that has its own compiled code: with and without derivatives, with
a named solver, and with a nonlinear body.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import casadi as ca
import control
import numpy as np

from impc.checking import replace
from impc.control.closed_loop import simulate, simulate_and_differentiate
from impc.control.constraint_rows import directions
from impc.control.controller import Controller
from impc.control.simulation import scenario
from impc.model.bounds import Bounds
from impc.model.plant import Plant

if TYPE_CHECKING:
    from collections.abc import Iterator

    from impc.control.simulation import Scenario

_LIMIT, _STEPS = 0.8, 40


def _system() -> control.StateSpace:
    return control.ss(
        [[1, 0.1], [0, 1]],
        [[0, 0], [0.1, 0.1]],
        [[1, 0]],
        0,
        0.1,
        states=["x", "v"],
        inputs=["u", "d"],
        outputs=["y"],
    )


def cart() -> tuple[Controller, Scenario]:
    """A controlled cart and a scenario."""
    plant = Plant(_system(), ["u"])
    bounds = Bounds(plant, u_min=-_LIMIT, u_max=_LIMIT)
    law = Controller.from_gain(plant, [[8.0, 4.0]], bounds, 5, terminal_set=False)
    return law, scenario(plant, [0.5, 0.0], disturbance=np.full((_STEPS, 1), 0.1))


def compiled_parts() -> Iterator[str]:
    """Compile one part after the other and yield its description."""
    law, drive = cart()
    simulate_and_differentiate(law, drive, directions(law, 2, x0=np.eye(2)))
    simulate(replace(law, solver="daqp"), drive)
    yield "the constrained controller and its closed loop"

    x, w = ca.SX.sym("x", 2), ca.SX.sym("w", 2)
    moved = ca.vertcat(x[0] + 0.1 * ca.sin(x[1]), x[1] + 0.1 * (w[0] + w[1]))
    bent = Plant(_system(), ["u"], body=ca.Function("body", [x, w], [moved]))
    bent_law = replace(law, plant=bent, bounds=Bounds(bent, u_min=-_LIMIT, u_max=_LIMIT))
    simulate_and_differentiate(bent_law, drive, directions(bent_law, 2, x0=np.eye(2)))
    yield "nonlinear bodies"
