"""Systems of python-control as dynamics: against scipy's integration, and what is refused."""

from __future__ import annotations

import math
from typing import Any

import casadi as ca
import control
import numpy as np
import pytest
import scipy.integrate

from impc.errors import InputError
from impc.nonlinear.problem import OptimalControlProblem

TRUTH = {"drag": 0.3, "price": 5.0}


def pendulum(t: float, x: Any, u: Any, params: dict[str, Any]) -> Any:
    """With numpy's functions, as users of python-control write it."""
    return np.array([x[1], -params["g"] * np.sin(x[0]) - params["drag"] * x[1] + u[0] + u[1]])


def system(update: Any = pendulum, **changes: Any) -> Any:
    given: dict[str, Any] = {
        "inputs": ["torque", "push"], "states": ["angle", "rate"],
        "params": {"g": 9.81, "drag": 0.1},
    }  # fmt: skip
    return control.nlsys(update, None, **given | changes)


def problem(
    dynamics: Any, kind: Any = ca.SX, names: tuple[str, str] = ("angle", "rate"), **changes: Any
) -> OptimalControlProblem:
    x = [kind.sym(name) for name in names]
    torque, push = kind.sym("torque"), kind.sym("push")
    theta = {name: kind.sym(name) for name in TRUTH}
    return OptimalControlProblem(
        x, torque, theta, dynamics, theta["price"] * (x[0] ** 2 + x[1] ** 2) + torque**2, 10,
        disturbances=push, **{"dt": 0.05} | changes,
    )  # fmt: skip


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
def test_a_continuous_system_is_stepped_over_the_sample_time(kind: Any) -> None:
    """What Runge and Kutta's method leaves of a step falls with its fifth power."""
    x, u, push = np.array([0.4, -0.3]), 0.7, 0.2
    left = []
    for dt in (0.05, 0.025):
        made = problem(system(), kind, dt=dt)
        found = made.functions[0](x, u, push, made.values(TRUTH)).full().ravel()
        exact = scipy.integrate.solve_ivp(
            lambda t, x: system().updfcn(t, x, [u, push], {"g": 9.81, "drag": 0.3}),
            (0, dt), x, rtol=1e-13, atol=1e-13,
        ).y[:, -1]  # fmt: skip
        left.append(np.max(np.abs(found - exact)))
    assert left[0] < 1e-6  # 5.8e-7
    assert left[0] / left[1] == pytest.approx(32, rel=0.1)


def test_names_say_which_symbol_is_which_and_else_the_order_does() -> None:
    x, theta = np.array([0.4, -0.3]), [0.3, 5.0]
    plain = problem(system()).functions[0](x, 0.7, 0.2, theta).full().ravel()
    turned = problem(system(), names=("rate", "angle")).functions[0](x[::-1], 0.7, 0.2, theta)
    np.testing.assert_array_equal(turned.full().ravel()[::-1], plain)
    other = problem(system(), names=("q", "dq")).functions[0](x, 0.7, 0.2, theta)
    np.testing.assert_array_equal(other.full().ravel(), plain)


def test_a_discrete_system_steps_itself() -> None:
    euler = system(lambda t, x, u, params: x + 0.1 * pendulum(t, x, u, params), dt=0.1)
    found = problem(euler, dt=None).functions[0]([0.4, -0.3], 0.7, 0.2, [0.3, 5.0])
    expected = [0.4 - 0.03, -0.3 + 0.1 * (-9.81 * math.sin(0.4) + 0.09 + 0.9)]
    np.testing.assert_allclose(found.full().ravel(), expected, rtol=1e-14)


def test_a_linear_system_is_its_matrices() -> None:
    A, B = np.array([[1, 0.05], [0, 0.9]]), np.array([[0, 0], [0.05, 0.1]])
    plant = control.ss(A, B, np.eye(2), 0, 0.05, states=["angle", "rate"],
                       inputs=["torque", "push"])  # fmt: skip
    x = [ca.SX.sym(name) for name in ("angle", "rate")]
    u, d, price = ca.SX.sym("torque"), ca.SX.sym("push"), ca.SX.sym("price")
    made = OptimalControlProblem(
        x, u, {"price": price}, plant, price * x[0] ** 2 + u**2, 5, disturbances=d
    )
    found = made.functions[0]([0.4, -0.3], 0.7, 0.2, [1.0]).full().ravel()
    np.testing.assert_allclose(found, A @ [0.4, -0.3] + B @ [0.7, 0.2], rtol=1e-14)


def branching(t: float, x: Any, u: Any, params: dict[str, Any]) -> Any:
    return pendulum(t, x, u, params) if x[0] > 0 else [x[1], 0.0]


def by_math(t: float, x: Any, u: Any, params: dict[str, Any]) -> Any:
    return [x[1], -params["drag"] * math.sin(x[0])]


def by_time(t: float, x: Any, u: Any, params: dict[str, Any]) -> Any:
    return [x[1], -params["drag"] * x[1] + t * u[0]]


def too_short(t: float, x: Any, u: Any, params: dict[str, Any]) -> Any:
    return [-params["drag"] * x[1]]


WRONG: dict[str, tuple[Any, dict[str, Any], str]] = {
    "a branch": (
        lambda: system(branching), {}, r"next_state: is a system whose function takes no symbols \("
    ),
    "math": (
        lambda: system(by_math), {}, "function is another on symbols than on numbers; write it with"
    ),
    "time": (lambda: system(by_time), {}, "is a system that depends on time; make what changes"),
    "too short": (lambda: system(too_short), {}, "function gives 1 numbers; give 2, one a state"),
    "no sample time": (system, {"dt": None}, "next_state: is a continuous system; give dt, in s"),
    "another sample time": (
        lambda: system(dt=0.1), {}, "dt: got 0.05, and the system has 0.1; leave it out"
    ),
    "another size": (
        lambda: system(states=["angle", "rate", "lag"]), {},
        "system with the states angle, rate, lag; give 3 symbols, and not 2",
    ),
    "a transfer function": (
        lambda: control.tf([1], [1, 1]), {},
        "got TransferFunction, without equations; give a control.nlsys",
    ),
    "a sample time of nothing": (system, {"dt": 0.0}, "dt: got 0.0; give a sample time above 0, s"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_a_system_that_cannot_be_written_down_is_refused_in_a_line(case: str) -> None:
    make, changes, words = WRONG[case]
    with pytest.raises(InputError, match=words):
        problem(make(), **changes)
