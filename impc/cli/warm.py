"""`impc warm`: compile the numba code of simulations and fits (docs/howto/speed.md).

A cart is simulated in each way that has its own compiled code: with derivatives, along the
trajectory of a nonlinear body, and with sensory noise.
"""

from __future__ import annotations

import casadi as ca
import click
import numpy as np

from impc.control.body_steps import body_tape, next_state, slopes_along
from impc.control.closed_loop import simulate_and_differentiate
from impc.control.compiled_body import states_from
from impc.control.constraint_rows import directions
from impc.control.controller import Controller
from impc.control.simulation import Scenario, scenario
from impc.jit import say_when_compiling
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording

_LIMIT, _STEPS = 0.8, 40


def run_warm(sensory_noise: bool) -> None:
    """Compile the inner loops, and say what is done."""
    say_when_compiling(lambda _: None)  # this command prints its own lines
    compile_loop()
    click.echo("compiled: the constrained controller and its closed loop")
    compile_bodies()
    click.echo("compiled: nonlinear bodies")
    if sensory_noise:
        compile_filter()
        click.echo("compiled: the filter of sensory noise")


def compile_loop() -> None:
    """Compile the constrained controller and its closed loop."""
    law, drive = _cart()
    simulate_and_differentiate(law, drive, directions(law, 2, x0=np.eye(2)))


def compile_bodies() -> None:
    """Compile the loop with a nonlinear body."""
    x, w = ca.SX.sym("x", 2), ca.SX.sym("w", 2)
    moved = ca.vertcat(x[0] + 0.1 * ca.sin(x[1]), x[1] + 0.1 * (w[0] + w[1]))
    law, drive = _cart(ca.Function("body", [x, w], [moved]))
    run, _ = simulate_and_differentiate(law, drive, directions(law, 2, x0=np.eye(2)))
    given = run.x[:-1], run.u, drive.disturbance
    next_state(law.plant, *(part[0] for part in given))
    slopes_along(law.plant, *given)
    if law.plant.body is not None:
        tape = body_tape(law.plant.body, law.plant.n, 4, moving=False)
        states_from(tape, np.array(run.u), np.array(drive.disturbance), np.array(run.x))


def compile_filter() -> None:
    """Compile the simulation and the likelihood of subjects with sensory noise."""
    from impc.output_feedback import likelihood as filtering  # noqa: PLC0415  # optional
    from impc.output_feedback.observer import Observer  # noqa: PLC0415
    from impc.output_feedback.simulation import simulate_person  # noqa: PLC0415

    law, drive = _cart()
    plant, recorder = law.plant, np.array([0.02])
    person = Observer(plant, ["x", "v"], motor=0.3, sensory=[0.1, 0.2])
    trial = simulate_person(law, person, drive.disturbance, recorder=0.02, seed=1)
    levels = np.zeros((len(person.levels) + 1, 2))
    noise = filtering.NoiseDirections(levels, 0)
    along = directions(law, 2, x0=np.eye(2))
    prepared = filtering.prepare_filter(law, person, recorder, along, noise)
    recording = Recording(plant, trial.outputs, drive.disturbance, [0.5, 0.0])
    filtering.joint_likelihoods(prepared, [recording])


def _cart(body: ca.Function | None = None) -> tuple[Controller, Scenario]:
    """A controlled cart, and a scenario in which its command reaches the limit."""
    import control  # noqa: PLC0415  # takes a second

    system = control.ss(
        [[1, 0.1], [0, 1]],
        [[0, 0], [0.1, 0.1]],
        [[1, 0]],
        0,
        0.1,
        states=["x", "v"],
        inputs=["u", "d"],
        outputs=["y"],
    )
    plant = Plant(system, ["u"], body=body)
    bounds = Bounds(plant, u_min=-_LIMIT, u_max=_LIMIT)
    law = Controller.from_gain(plant, [[8.0, 4.0]], bounds, 5, terminal_set=False)
    return law, scenario(plant, [0.5, 0.0], disturbance=np.full((_STEPS, 1), 0.1))
