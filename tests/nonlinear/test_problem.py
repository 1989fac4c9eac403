"""The problem as a value: accepted arguments, and one-line errors."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from typing import Any

import casadi as ca
import control
import numpy as np
import pytest

from impc.errors import ImpcError, InfeasibleError, InputError, SolverError
from impc.nonlinear.plan import SOLVERS, require_solver
from impc.nonlinear.problem import OptimalControlProblem

TRUTH = {"mass": 1.5, "price": 10.0, "limit": 1.0}
X, U = np.zeros((21, 2)), np.zeros((20, 1))


def made(kind: Any = ca.SX, **changes: Any) -> OptimalControlProblem:
    """A point with limited force, with one argument changed."""
    x, u = kind.sym("x", 2), kind.sym("force")
    p = {name: kind.sym(name) for name in TRUTH}
    given: dict[str, Any] = {
        "states": x, "inputs": u, "parameters": p,
        "next_state": x + 0.1 * ca.vertcat(x[1], u / p["mass"]),
        "stage_cost": p["price"] * ca.sumsqr(x) + u**2,
        "constraints": {"force": ca.vertcat(u - p["limit"], -u - p["limit"])},
        "horizon": 20,
    }  # fmt: skip
    given |= {name: value(x, u, p) if callable(value) else value for name, value in changes.items()}
    return OptimalControlProblem(**given)


def test_names_sizes_and_units() -> None:
    problem = made(units={"mass": "kg"}, signed=["price"], constraints=lambda x, u, p: {
        "force": ca.vertcat(u - p["limit"], -u - p["limit"]), "speed": x[1] - 9})  # fmt: skip
    assert problem.state_names == ("x_0", "x_1")
    assert problem.input_names == ("force",)
    assert problem.rows == ("force[0]", "force[1]", "speed")
    assert problem.positive.tolist() == [True, False, True]
    assert problem.units == {"mass": "kg"}
    assert made(ca.MX).state_names == ("x[0]", "x[1]")
    assert problem.values({"limit": 1, "mass": 2, "price": -3}).tolist() == [2.0, -3.0, 1.0]


def test_expressions_of_MX_give_the_same_plan_and_a_copy_of_a_pickle_too() -> None:
    plan = made().plan(TRUTH, [1, 0])
    for other in (made(ca.MX), pickle.loads(pickle.dumps(made()))):
        np.testing.assert_allclose(other.plan(TRUTH, [1, 0]).u, plan.u, atol=1e-10)


def test_values_take_the_place_of_parameters() -> None:
    whole = made()
    left = whole.with_known({"mass": 1.5, "limit": 1.0})
    assert left.parameter_names == ("price",)
    np.testing.assert_allclose(
        left.plan({"price": 10.0}, [1, 0]).u, whole.plan(TRUTH, [1, 0]).u, atol=1e-12
    )
    for function, given in zip(left.functions, whole.functions, strict=True):
        assert function.name() == given.name()


def test_a_controller_does_not_reckon_with_disturbances() -> None:
    d = ca.SX.sym("d")
    problem = made(disturbances=d, next_state=lambda x, u, p: x + 0.1 * ca.vertcat(
        x[1], (u + d) / p["mass"]))  # fmt: skip
    pushed = problem.closed_loop(TRUTH, [0, 0], 3, d=[[1.0], [0.0], [0.0]])
    assert pushed.u[0] == pytest.approx(0, abs=1e-9)
    assert pushed.x[1, 1] == pytest.approx(0.1 / 1.5)
    assert pushed.u[1] < 0


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "a free symbol": (
        {"stage_cost": lambda x, u, p: ca.sumsqr(x) + u**2 * ca.SX.sym("w") * p["price"]},
        "stage_cost: has the unknown symbol w; make it a state",
    ),
    "a system of python-control": (
        {"next_state": lambda x, u, p: control.nlsys(lambda t, x, u, params: x, states=2)},
        "next_state: is a system of python-control; call its function with the symbols: docs/",
    ),
    "a wrong size": (
        {"next_state": lambda x, u, p: x[0] + u}, r"next_state: has shape \(1, 1\); give \(2, 1\)"
    ),
    "no expression": ({"stage_cost": "u^2"}, "stage_cost: got str; give an expression of SX"),
    "no symbols": ({"states": 3.0}, "states: got float, not symbols"),
    "no inputs": ({"inputs": []}, "inputs: is empty"),
    "two kinds": ({"inputs": ca.MX.sym("u")}, "symbols: mix SX and MX"),
    "a parameter that is in nothing": (
        {"parameters": lambda x, u, p: p | {"colour": ca.SX.sym("colour")}},
        "parameter colour: occurs in no expression; remove it",
    ),
    "a vector as a parameter": (
        {"parameters": lambda x, u, p: p | {"price": ca.SX.sym("w", 2)}},
        "parameter price: is not a scalar symbol",
    ),
    "a terminal cost of an input": (
        {"terminal_cost": lambda x, u, p: u**2}, "terminal_cost: depends on an input"
    ),
    "a horizon of half a sample": ({"horizon": 0.5}, "horizon: got 0.5; give a whole number"),
    "no horizon": ({"horizon": 0}, "horizon: got 0; give a whole number"),
    "a comparison": (
        {"constraints": lambda x, u, p: {"force": ca.vertcat(u, -u) <= p["limit"]}},
        "constraint force: is a comparison; write the expression that must be <= 0: u - 1 for",
    ),
    "constraints without names": (
        {"terminal_constraints": lambda x, u, p: x <= 1}, "give a dictionary"
    ),
    "signed, and not there": ({"signed": ["pace"]}, "parameter pace: is not among the parameters"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_a_problem_that_is_none_is_refused_in_a_line(case: str) -> None:
    changes, words = WRONG[case]
    with pytest.raises(InputError, match=words):
        made(**changes)


@pytest.mark.parametrize(
    ("theta", "words"),
    [
        ({"mass": 1.0, "price": 1.0}, "parameter limit: has no value"),
        (TRUTH | {"colour": 1.0}, "parameter colour: is not known; known: mass, price, limit"),
        (TRUTH | {"mass": -1.0}, "parameter mass: got -1; give a positive one"),
        (TRUTH | {"mass": np.nan}, r"theta\['mass'\]: is NaN; give a number"),
        (TRUTH | {"mass": "heavy"}, r"theta\['mass'\]: got 'heavy'; give a number"),
    ],
)
def test_values_that_are_none_are_refused(theta: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        made().plan(theta, [1, 0])


def test_arguments_are_checked() -> None:
    problem = made()
    refused: list[tuple[Callable[[], object], str]] = [
        (lambda: problem.plan([1, 2], [1, 0]),  # type: ignore[arg-type]
         "theta: got list of 2; give a dictionary"),
        (lambda: problem.plan(TRUTH), "plan: missing a required argument: 'x0'"),  # type: ignore[call-arg]
        (lambda: problem.plan(TRUTH, [1.0]), r"x0: expected shape \(2\), got \(1,\)"),
        (lambda: problem.plan(TRUTH, [1.0, np.nan]), "x0: 1 of 2 entries are NaN"),
        (lambda: problem.plan(TRUTH, "origin"), "x0: expected real numbers"),
        (lambda: problem.plan(TRUTH, [1, 0], solver="snopt"),
         r"solver: got 'snopt'; choose one of ipopt, fatrop"),
        (lambda: problem.plan(TRUTH, [1, 0], mu=0), "mu: got 0; give 1e-12 to 1e"),
        (lambda: problem.closed_loop(TRUTH, [1, 0], 3, d=[[1.0], [0.0]]),
         r"d: expected shape \(3, 0\), got \(2, 1\)"),
        (lambda: problem.closed_loop(TRUTH, [1, 0], 0),
         "steps: got 0; give a whole number of at least 1"),
        (lambda: problem.recorded_plan(X[:-1], U), "states: has 20 samples; give 21"),
        (lambda: problem.recorded_loop(X, U[:-1]), r"inputs: expected shape \(20, 1\), got"),
        (lambda: problem.recorded_plan(X.T, U), "states: expected .*; transpose it: states.T"),
        (lambda: problem.recorded_plan(X, U + np.inf), "inputs: has infinite entries"),
        (lambda: problem.recorded_plan(X * np.nan, U), "x0: 2 of 2 entries are NaN"),
        (lambda: problem.recorded_loop(X[:1]), "states: has 1 samples; give at least 2"),
        (lambda: problem.recorded_plan("x"), "x: expected real numbers"),
        (lambda: problem.recorded_plan(X * np.nan, x0=[0, 0]), "recording: has missing"),
    ]  # fmt: skip
    for make, words in refused:
        with pytest.raises(ImpcError, match=words):
            make()


def test_a_solver_that_the_wheel_lacks_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in SOLVERS:
        require_solver(name)
    monkeypatch.setattr(ca, "has_nlpsol", lambda name: name == "ipopt")
    with pytest.raises(InputError, match="solver: fatrop is not in this CasADi; choose ipopt"):
        require_solver("fatrop")


def test_what_is_not_finite_at_the_start_is_named_with_its_sample() -> None:
    problem = made(stage_cost=lambda x, u, p: p["price"] * ca.log(x[0] - 2) ** 2 + u**2)
    with pytest.raises(InputError, match="stage_cost: is not finite at sample 0 of the start"):
        problem.plan(TRUTH, [1, 0])


def test_an_infeasible_problem_names_the_constraint_and_the_sample() -> None:
    """A force of 1 stops a mass of 1.5 at a speed of 1 within 0.75 m; 0.3 m are allowed.

    The least total excess needs a harder brake at once.
    """
    problem = made(constraints=lambda x, u, p: {
        "force": ca.vertcat(u - p["limit"], -u - p["limit"]), "place": x[0] - 0.3})  # fmt: skip
    with pytest.raises(
        InfeasibleError, match=r"constraint force\[1\]: no plan .* satisfies it at sample 0: the"
    ):
        problem.plan(TRUTH, [0.0, 1.0])
    problem.plan(TRUTH | {"limit": 5.0}, [0.0, 1.0])


def test_a_cost_without_a_minimum_is_told_with_its_sample() -> None:
    problem = made(
        stage_cost=lambda x, u, p: p["price"] * ca.sumsqr(x), constraints=None,
        parameters=lambda x, u, p: {name: p[name] for name in ("mass", "price")},
    )  # fmt: skip
    with pytest.raises(SolverError, match=r"plan: the cost has no minimum in the inputs of sample"):
        problem.plan({"mass": 1.0, "price": 1.0}, [1, 0])
