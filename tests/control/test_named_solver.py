"""Named solvers in the closed loop: the same inputs and derivatives, and no output."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import casadi as ca
import control
import numpy as np
import pytest

from impc.checking import replace
from impc.control.closed_loop import simulate, simulate_and_differentiate
from impc.control.constraint_rows import build_rows
from impc.control.controller import Controller
from impc.control.named_solver import (
    COMPILED,
    SOLVERS,
    active_set,
    build_program,
    described,
    require_solver,
)
from impc.control.simulation import Status, scenario
from impc.errors import InputError
from impc.inverse.table31 import inverse_mpc_reduced
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.weights import Weights
from tests.control.test_closed_loop import entries, problem, unit_directions
from tests.support import saturated_problem

ROOT = Path(__file__).parents[2]


def check_against_compiled(solver: str, seed: int, softening: float | None) -> None:
    """Compare trajectory, every derivative, and the status of each sample."""
    controller, drive, _ = problem(seed, softening)
    along = unit_directions(controller, entries(controller))
    ours, derivative = simulate_and_differentiate(controller, drive, along)
    run, found = simulate_and_differentiate(replace(controller, solver=solver), drive, along)
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
    found = [inverse_mpc_reduced(replace(posed, solver=name)) for name in (COMPILED, solver)]
    for fit in found:
        assert fit.explained
        np.testing.assert_allclose(fit.gain, truth.K, atol=1e-6 * np.max(np.abs(truth.K)))
    np.testing.assert_allclose(found[1].gain, found[0].gain, atol=1e-9 * np.max(np.abs(truth.K)))


@pytest.mark.parametrize("solver", SOLVERS)
def test_what_no_input_keeps_is_proved(solver: str, example_plant: Plant) -> None:
    bounds = Bounds(example_plant, u_min=-1, u_max=1)
    controller = Controller(example_plant, Weights(np.eye(2), 1), bounds, 3, solver=solver)
    with pytest.warns(UserWarning, match="no input sequence keeps the bound"):
        run = controller.simulate([30, 1], steps=3)
    assert run.status[0] == Status.INFEASIBLE
    assert run.failed_row >= 0


def test_tight_rows_that_depend_on_each_other_are_told_apart() -> None:
    """One state that sums its inputs: its bound at one stage implies those at others."""
    plant = Plant(control.ss([[1.0]], [[1.0]], [[1.0]], 0, True))
    bounds = Bounds(plant, u_min=-1, u_max=1, x_min=-1, x_max=1)
    controller = Controller(plant, Weights(0.1, 1e-3), bounds, 2, terminal_set=False)
    for start in (-0.5, -0.25, 0.75):
        runs = [
            simulate(replace(controller, solver=name), scenario(plant, [start], 2))
            for name in (COMPILED, *SOLVERS)
        ]
        for run in runs[1:]:
            np.testing.assert_allclose(run.u, runs[0].u, atol=1e-12)


def test_a_wrong_answer_is_not_believed(
    example_plant: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A solver that stops too early: its multipliers and its input do not match."""
    bounds = Bounds(example_plant, u_min=-1, u_max=1)
    controller = Controller(example_plant, Weights(np.eye(2), 1), bounds, 3, solver="daqp")
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
    assert run.status[0] == Status.UNSOLVED


def test_a_solver_that_casadi_lacks_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ca, "has_conic", lambda name: name != "daqp")
    with pytest.raises(InputError, match="'daqp' is not part of the installed CasADi"):
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
    done = subprocess.run(
        [sys.executable, "-c", _EVERY_SOLVER], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout == "done\n"
    assert done.stderr == ""
