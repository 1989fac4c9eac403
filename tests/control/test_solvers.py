"""Problems with active bounds, solved at every sample by several solvers.

The compiled loop against qpOASES, DAQP and IPOPT in the package's formulation, and against Clarabel
in a dense program in u with (Q, R, P), condensed with the plant itself.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import control
import numpy as np
import pytest

import impc
from experiments.benchmarks.workloads import seat
from experiments.reference_mpc import simulate_mpc
from impc.control.casadi_controller import build_mpc
from impc.control.closed_loop import simulate
from impc.control.constraint_rows import build_rows
from impc.control.named_solver import (
    COMPILED,
    SOLVERS,
    active_set,
    build_program,
    described,
    require_solver,
)
from impc.control.simulation import Scenario
from impc.inverse.table31 import inverse_mpc_reduced
from tests.control import test_body_steps
from tests.control.hanging_body import pendulum
from tests.control.test_closed_loop import entries, problem, unit_directions
from tests.control.test_terminal_ingredients import own_loop
from tests.independent_mpc import first_input
from tests.model import test_rates
from tests.support import new_python, random_plant, random_weights, saturated_problem

# IPOPT is an interior-point method, and its default tolerance is 1e-8 of its own scale.
TOLERANCES = {"qpoases": 1e-9, "daqp": 1e-9, "ipopt": 1e-6}
PROBLEMS = (*(f"random {seed}" for seed in range(8)), "example", "soft", "seat")
# A penalty of 1e3 on the rows: the others find its answer to 1e-6. 3000 programs by IPOPT: minutes.
OTHER_TOLERANCE = {"soft": 1e-6}
LEFT_OUT = {("seat", "ipopt")}


@dataclass(frozen=True)
class Case:
    """A loop with its weights and its compiled simulation."""

    controller: impc.Controller
    weights: impc.Weights
    drive: Scenario
    fast: impc.Simulation


@functools.cache
def case(name: str) -> Case:
    if name == "seat":
        work = seat()
        drive = work.drives[0]
        return Case(work.controller, work.weights, drive, simulate(work.controller, drive))
    if name == "example":
        plant = impc.Plant(control.ss([[2, -1], [1, 0.2]], [[1], [0]], np.eye(2), 0, True))
        weights = impc.Weights(np.eye(2), 1)
        controller = impc.Controller(plant, weights, impc.Bounds(plant, u_min=-1, u_max=1), 3)
        drive = impc.scenario(plant, [1, 3], 20)
        return Case(controller, weights, drive, simulate(controller, drive))
    return soft() if name == "soft" else random_case(int(name.split()[1]))


def soft() -> Case:
    """State bounds that a disturbance violates."""
    rng = np.random.default_rng(5)
    plant = random_plant(rng, 3, 1, 1.1, d=1)
    weights = impc.Weights(np.eye(3), 1)
    bounds = impc.Bounds(plant, u_min=-1, u_max=1, x_min=-0.5, x_max=0.5)
    drive = impc.scenario(plant, 0.2 * np.ones(3), disturbance=rng.normal(size=40) * 0.8)
    assert not simulate(impc.Controller(plant, weights, bounds, 6), drive).complete
    controller = impc.Controller(plant, weights, bounds, 6, softening=1e3)
    return Case(controller, weights, drive, simulate(controller, drive))


def random_case(seed: int) -> Case:
    """Random stabilisable plants, 1 or 2 inputs, 2 to 6 states, half of them unstable."""
    rng = np.random.default_rng(seed)
    n, m = 2 + seed % 5, 1 + seed % 2
    plant = random_plant(rng, n, m, 1.15 if seed % 4 < 2 else 0.9)
    weights = impc.Weights(random_weights(rng, n), random_weights(rng, m))
    x_max = 6.0 if seed % 3 == 0 else np.inf
    bounds = impc.Bounds(plant, u_min=-0.5, u_max=0.5, x_min=-x_max, x_max=x_max)
    controller = impc.Controller(plant, weights, bounds, 5)
    assert controller.terminal is not None
    # As far from the origin as is feasible, so that bounds are active.
    for size in 30.0 * 0.8 ** np.arange(30):
        drive = impc.scenario(plant, size * np.ones(n) / np.sqrt(n), 12)
        fast = simulate(controller, drive)
        if fast.complete and impc.Status.ACTIVE in fast.status:
            return Case(controller, weights, drive, fast)
    raise AssertionError(f"seed {seed} has no active bound")


@pytest.mark.parametrize("name", PROBLEMS)
def test_a_bound_is_at_work(name: str) -> None:
    found = case(name).fast
    assert found.complete
    assert (impc.Status.SOFTENED if name == "soft" else impc.Status.ACTIVE) in found.status


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
            [np.flatnonzero(one.fast.status == impc.Status.ACTIVE)[::10], samples[::100]]
        )
    u_max, x_max = float(bounds.u_max[0]), float(bounds.x_max[0])
    rows = None if terminal is None else (terminal.H, terminal.h)
    for sample in samples:
        other = first_input(
            plant.A, plant.B, one.weights.Q, one.weights.R, one.controller.horizon,
            one.fast.x[sample], u_max, x_max, rows,
        )  # fmt: skip
        np.testing.assert_allclose(one.fast.u[sample], other, atol=1e-8 * max(u_max, 1.0))


Loop = tuple[impc.Controller, Scenario, impc.Simulation]


def on_a_body() -> Loop:
    controller = test_body_steps.law(pendulum())
    drive = test_body_steps.drive(controller.plant)
    return controller, drive, simulate(controller, drive)


def in_changes(inputs: int) -> Loop:
    law = test_rates.controller_of(inputs)
    return law, *test_rates.driven(law, 0)


OTHERS: dict[str, Callable[[], Loop]] = {
    "own terminal weight and set": lambda: own_loop(2, "weight and set", None)[:3],
    "own terminal weight and soft set": lambda: own_loop(2, "weight and set", 20.0)[:3],
    "changes of a command": lambda: in_changes(1),
    "changes of two commands": lambda: in_changes(2),
    "nonlinear body": on_a_body,
}


@pytest.mark.parametrize("name", OTHERS)
def test_other_solvers_have_the_same_inputs(name: str) -> None:
    """A named solver, a program at every sample, and one step as a CasADi function."""
    law, drive, run = OTHERS[name]()
    named = simulate(impc.replace(law, solver="daqp"), drive)
    np.testing.assert_allclose(named.x, run.x, rtol=0, atol=1e-8)
    other = simulate_mpc(build_mpc(law, "qpoases"), drive)
    np.testing.assert_allclose(other.x, run.x, rtol=0, atol=1e-6)
    step = impc.mpc_function(law)
    np.testing.assert_allclose(step(run.x[2]).full().ravel(), run.u[2], rtol=0, atol=1e-6)


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
    run = simulate(controller, impc.scenario(controller.plant, x0, 20))
    assert run.complete
    np.testing.assert_allclose(run.u[: len(inputs), 0], inputs, atol=1e-4)


def check_against_compiled(solver: str, seed: int, softening: float | None) -> None:
    """Compare trajectory, every derivative, and the status of each sample."""
    controller, drive, _ = problem(seed, softening)
    along = unit_directions(controller, entries(controller))
    ours, derivative = impc.simulate_and_differentiate(controller, drive, along)
    named = impc.replace(controller, solver=solver)
    run, found = impc.simulate_and_differentiate(named, drive, along)
    np.testing.assert_array_equal(run.status, ours.status)
    assert run.weakly_active == ours.weakly_active
    # Measured: 7e-12 of the states, 1e-13 of the derivatives; with a penalty of 1e6, whose
    # multipliers have lost as many digits, 9e-9 and 3e-9.
    tolerance = 1e-7 if softening == 1e6 else 1e-10
    assert np.max(np.abs(run.x - ours.x)) <= tolerance * np.max(np.abs(ours.x))
    for one, other in ((found.x, derivative.x), (found.u, derivative.u)):
        assert np.max(np.abs(one - other)) <= tolerance * np.max(np.abs(derivative.x))


# Input bounds always, terminal sets, one to three inputs; odd seeds have state bounds too.
@pytest.mark.parametrize("softening", [None, 50.0, 1e6])
@pytest.mark.parametrize("solver", ["daqp", "qpoases"])
def test_loops_are_those_of_the_compiled_method(solver: str, softening: float | None) -> None:
    # At seed 50 qpOASES, as it begins by default, divides by zero.
    for seed in (1, 3, 10, 17, 50):
        check_against_compiled(solver, seed, softening)


@pytest.mark.parametrize("softening", [None, 50.0])
def test_loops_of_ipopt_are_those_of_the_compiled_method(softening: float | None) -> None:
    check_against_compiled("ipopt", 5, softening)


@pytest.mark.parametrize("solver", ["daqp", pytest.param("qpoases", marks=pytest.mark.slow)])
def test_fits_with_other_solvers_end_at_the_same_gain(solver: str) -> None:
    """Noise-free recordings of two inputs at their bounds; W2 is compared in the benchmarks."""
    _, truth, posed = saturated_problem(np.random.default_rng(3), 2, 2)
    found = [inverse_mpc_reduced(impc.replace(posed, solver=name)) for name in (COMPILED, solver)]
    for fit in found:
        assert fit.explained
        np.testing.assert_allclose(fit.gain, truth.K, atol=1e-6 * np.max(np.abs(truth.K)))
    np.testing.assert_allclose(found[1].gain, found[0].gain, atol=1e-9 * np.max(np.abs(truth.K)))


def test_tight_rows_that_depend_on_each_other_are_told_apart() -> None:
    """One state that sums its inputs: its bound at one stage implies those at others."""
    plant = impc.Plant(control.ss([[1.0]], [[1.0]], [[1.0]], 0, True))
    bounds = impc.Bounds(plant, u_min=-1, u_max=1, x_min=-1, x_max=1)
    controller = impc.Controller(plant, impc.Weights(0.1, 1e-3), bounds, 2, terminal_set=False)
    for start in (-0.5, -0.25, 0.75):
        runs = [
            simulate(impc.replace(controller, solver=name), impc.scenario(plant, [start], 2))
            for name in (COMPILED, *SOLVERS)
        ]
        for run in runs[1:]:
            np.testing.assert_allclose(run.u, runs[0].u, atol=1e-12)


def test_a_wrong_answer_is_not_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A solver that stops too early: its multipliers and its input do not match."""
    controller = impc.replace(case("example").controller, solver="daqp")
    rows = build_rows(controller)
    d = rows.b - rows.T @ np.array([1.0, 3.0])
    assert active_set(build_program("daqp", rows), d) is not None

    def early(*shapes: object) -> object:
        def solve(**given: object) -> dict[str, ca.DM]:
            return {"x": ca.DM.zeros(3), "lam_a": ca.DM.zeros(len(d))}

        return solve

    monkeypatch.setattr("impc.control.named_solver._function", early)
    assert active_set(build_program("daqp", rows), d) is None
    with pytest.warns(UserWarning, match="cannot be determined"):
        run = controller.simulate([1, 3], steps=3)
    assert run.status[0] == impc.Status.UNSOLVED


def test_a_solver_that_casadi_lacks_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ca, "has_conic", lambda name: name != "daqp")
    with pytest.raises(impc.InputError, match="'daqp' is not part of the installed CasADi"):
        require_solver("daqp")
    assert require_solver("qpoases") == "qpoases"
    assert described(COMPILED) == "the package's own"
    assert described("daqp") == "daqp, of CasADi"


_EVERY_SOLVER = """
import warnings, numpy as np, plants
from impc.control.casadi_controller import build_mpc
from experiments.reference_mpc import solve_mpc
from impc.control.controller import Controller
from impc.control.named_solver import SOLVERS
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.weights import Weights
warnings.simplefilter("ignore")
plant = Plant(plants.yalmip_example())
bounds = Bounds(plant, u_min=-1, u_max=1, x_min=-4, x_max=4)
for solver in SOLVERS:
    for softening in (None, 1e6):
        given = {"softening": softening, "solver": solver}
        law = Controller(plant, Weights(np.eye(2), 1), bounds, 3, **given)
        for start in ([1, 3], [3, 1], [30, 1]):
            law.simulate(start, steps=5)
            solve_mpc(build_mpc(law, solver), start)
print("done")
"""


def test_solvers_are_silent() -> None:
    """In a separate process: C libraries write past Python's standard output."""
    done = new_python(_EVERY_SOLVER)
    assert (done.stdout, done.stderr) == ("done\n", "")
