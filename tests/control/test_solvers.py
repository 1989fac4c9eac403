"""Problems with active bounds, solved at every sample by several solvers.

The compiled loop against qpOASES, DAQP and IPOPT in the package's formulation, and against Clarabel
in a dense program in u with (Q, R, P), condensed with the plant itself.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import control
import numpy as np
import pytest

from experiments.benchmarks.workloads import seat
from experiments.reference_mpc import simulate_mpc
from impc.control.casadi_controller import build_mpc
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.simulation import Scenario, Simulation, Status, scenario
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.weights import Weights
from tests.independent_mpc import first_input
from tests.support import random_plant, random_weights

# IPOPT is an interior-point method, and its default tolerance is 1e-8 of its own scale.
TOLERANCES = {"qpoases": 1e-9, "daqp": 1e-9, "ipopt": 1e-6}
PROBLEMS = (*(f"random {seed}" for seed in range(8)), "example", "soft", "seat")
# A penalty of 1e3 on the rows: the others find its answer to 1e-6. 3000 programs by IPOPT: minutes.
OTHER_TOLERANCE = {"soft": 1e-6}
LEFT_OUT = {("seat", "ipopt")}


@dataclass(frozen=True)
class Case:
    """A loop with its weights and its compiled simulation."""

    controller: Controller
    weights: Weights
    drive: Scenario
    fast: Simulation


@functools.cache
def case(name: str) -> Case:
    if name == "seat":
        work = seat()
        drive = work.drives[0]
        return Case(work.controller, work.weights, drive, simulate(work.controller, drive))
    if name == "example":
        plant = Plant(control.ss([[2, -1], [1, 0.2]], [[1], [0]], np.eye(2), 0, True))
        weights = Weights(np.eye(2), 1)
        controller = Controller(plant, weights, Bounds(plant, u_min=-1, u_max=1), 3)
        drive = scenario(plant, [1, 3], 20)
        return Case(controller, weights, drive, simulate(controller, drive))
    return soft() if name == "soft" else random_case(int(name.split()[1]))


def soft() -> Case:
    """State bounds that a disturbance violates."""
    rng = np.random.default_rng(5)
    plant = random_plant(rng, 3, 1, 1.1, d=1)
    weights = Weights(np.eye(3), 1)
    bounds = Bounds(plant, u_min=-1, u_max=1, x_min=-0.5, x_max=0.5)
    drive = scenario(plant, 0.2 * np.ones(3), disturbance=rng.normal(size=40) * 0.8)
    assert not simulate(Controller(plant, weights, bounds, 6), drive).complete
    controller = Controller(plant, weights, bounds, 6, softening=1e3)
    return Case(controller, weights, drive, simulate(controller, drive))


def random_case(seed: int) -> Case:
    """Random stabilisable plants, 1 or 2 inputs, 2 to 6 states, half of them unstable."""
    rng = np.random.default_rng(seed)
    n, m = 2 + seed % 5, 1 + seed % 2
    plant = random_plant(rng, n, m, 1.15 if seed % 4 < 2 else 0.9)
    weights = Weights(random_weights(rng, n), random_weights(rng, m))
    x_max = 6.0 if seed % 3 == 0 else np.inf
    bounds = Bounds(plant, u_min=-0.5, u_max=0.5, x_min=-x_max, x_max=x_max)
    controller = Controller(plant, weights, bounds, 5)
    assert controller.terminal is not None
    # As far from the origin as is feasible, so that bounds are active.
    for size in 30.0 * 0.8 ** np.arange(30):
        drive = scenario(plant, size * np.ones(n) / np.sqrt(n), 12)
        fast = simulate(controller, drive)
        if fast.complete and Status.ACTIVE in fast.status:
            return Case(controller, weights, drive, fast)
    raise AssertionError(f"seed {seed} has no active bound")


@pytest.mark.parametrize("name", PROBLEMS)
def test_a_bound_is_at_work(name: str) -> None:
    found = case(name).fast
    assert found.complete
    assert (Status.SOFTENED if name == "soft" else Status.ACTIVE) in found.status


@pytest.mark.parametrize(
    ("name", "solver"),
    [(name, s) for name in PROBLEMS for s in TOLERANCES if (name, s) not in LEFT_OUT],
)
def test_a_program_at_every_sample_is_the_compiled_kernel(name: str, solver: str) -> None:
    one, tolerance = case(name), OTHER_TOLERANCE.get(name, TOLERANCES[solver])
    slow = simulate_mpc(build_mpc(one.controller, solver), one.drive)
    assert slow.complete, slow.status
    np.testing.assert_allclose(slow.x, one.fast.x, atol=tolerance)
    if tolerance <= 1e-9:
        largest = float(np.max(one.controller.bounds.u_max))
        np.testing.assert_allclose(slow.u, one.fast.u, atol=tolerance * max(largest, 1.0))


@pytest.mark.parametrize("name", [name for name in PROBLEMS if name != "soft"])
def test_inputs_are_those_of_an_independent_program(name: str) -> None:
    """At every sample; for the seat's 3000 at every tenth saturated one, and every hundredth."""
    one = case(name)
    plant, bounds, terminal = one.controller.plant, one.controller.bounds, one.controller.terminal
    samples = np.arange(len(one.fast.u))
    if len(samples) > 100:
        samples = np.concatenate(
            [np.flatnonzero(one.fast.status == Status.ACTIVE)[::10], samples[::100]]
        )
    u_max, x_max = float(bounds.u_max[0]), float(bounds.x_max[0])
    rows = None if terminal is None else (terminal.H, terminal.h)
    for sample in samples:
        other = first_input(
            plant.A, plant.B, one.weights.Q, one.weights.R, one.controller.horizon,
            one.fast.x[sample], u_max, x_max, rows,
        )  # fmt: skip
        np.testing.assert_allclose(one.fast.u[sample], other, atol=1e-8 * max(u_max, 1.0))


REFERENCE_INPUTS = {
    (1, 3): [1, 1, 1, 0.30451, -0.25464, -0.24685, -0.11827, -0.02918, 0.00543, 0.01026],
    (2, 3): [-0.1554, 1, 1, 0.5971, 0.1049],
    (2, 1): [-1, -1, 0.9549, 0.9633, 0.4701],
}


@pytest.mark.parametrize(("x0", "inputs"), REFERENCE_INPUTS.items())
def test_example_inputs_are_those_of_the_reference(
    x0: tuple[int, int], inputs: list[float]
) -> None:
    controller = case("example").controller
    run = simulate(controller, scenario(controller.plant, x0, 20))
    assert run.complete
    np.testing.assert_allclose(run.u[: len(inputs), 0], inputs, atol=1e-4)
