"""The terminal set against closed forms, simulation, plain linear programs and pytope."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import control
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog

import impc
from experiments.certificates import invariance_violation, maximality_violation
from impc.arrays import Array
from impc.control.halfspaces import supports
from impc.model.bounds import bound_rows
from plants.seated_balance import seated_balance_plant
from tests.support import draws, plant_of

Case = tuple[impc.Plant, Any, impc.Bounds]


def regulator(plant: impc.Plant) -> Array:
    return impc.solve_lqr(plant, impc.Weights(np.eye(plant.n), np.eye(plant.m))).K


def example() -> Case:
    """Primary example with an input bound only."""
    plant = plant_of([[2, -1], [1, 0.2]], [[1], [0]])
    return plant, regulator(plant), impc.Bounds(plant, u_min=-1, u_max=1)


def cannon(upper: float = 10.0) -> Case:
    plant = plant_of([[1.1, 2], [0, 0.95]], [[0], [0.0787]])
    bounds = impc.Bounds(plant, u_min=-1, u_max=1, x_min=-10, x_max=upper)
    return plant, regulator(plant), bounds


def slow_rotations() -> Case:
    """Ten states, five slow oscillations, all states bounded: hundreds of rows."""
    radii, angles = np.linspace(0.94, 0.99, 5), np.linspace(0.1, 1.0, 5)
    turns = [
        r * np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
        for r, a in zip(radii, angles, strict=True)
    ]
    T = np.random.default_rng(0).standard_normal((10, 10))
    plant = plant_of(T @ scipy.linalg.block_diag(*turns) @ np.linalg.inv(T), np.ones((10, 1)))
    return plant, np.zeros((1, 10)), impc.Bounds(plant, x_min=-1, x_max=1)


def seat() -> Case:
    """Seated balance, ten states; bounds on the command, both angles and both rates."""
    plant = impc.Plant(seated_balance_plant(), controls=["command"])
    intent = np.array([0.70, 0.65, 0.22, 0.20])
    Q = 1e-2 * np.eye(10)
    Q[:4, :4] = 6e5 * np.outer(intent, intent) + np.diag([2e4, 2e4, 500, 500])
    limit = np.full(10, np.inf)
    limit[:4] = [np.deg2rad(12), np.deg2rad(15), 1.5, 1.5]
    bounds = impc.Bounds(plant, u_min=-6, u_max=6, x_min=-limit, x_max=limit)
    return plant, impc.solve_lqr(plant, impc.Weights(Q, 1.0)).K, bounds


def plain_support(direction: Array, H: Array, h: Array) -> float:
    """Support by the primal program, unscaled, one at a time; at most 1e3.

    The cap keeps the program bounded: HiGHS may call an unbounded one infeasible.
    """
    capped, limits = np.vstack([H, direction]), np.append(h, 1e3)
    answer = linprog(-direction, A_ub=capped, b_ub=limits, bounds=(None, None), method="highs")
    assert answer.status == 0
    return -float(answer.fun or 0.0)


def worst_excess(terminal: impc.TerminalSet, x: Array, steps: int) -> float:
    """Largest bound violation along the closed loop from x, relative to the bounds, by rollout."""
    rows, worst = terminal.rows, -np.inf
    for _ in range(steps):
        stage = rows.E @ x - rows.F @ (terminal.gain @ x)
        worst = max(worst, float(np.max(stage / rows.b)) - 1)
        x = terminal.F @ x
    return worst


def area(corners: Array) -> float:
    x, y = corners.T
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2)


def pairs(terminal: impc.TerminalSet) -> list[tuple[int, int]]:
    return list(zip(terminal.step.tolist(), terminal.family.tolist(), strict=True))


def assert_certified(terminal: impc.TerminalSet) -> None:
    assert invariance_violation(terminal) <= 1e-8
    assert maximality_violation(terminal) <= 1e-8


# Known answers


def test_a_set_of_fewer_rows_than_states_has_supports_and_no_corner() -> None:
    """Regression: with six states and four rows the warm start had the wrong size."""
    Z = np.eye(4, 6)
    targets = np.array([[0.5, -0.25, 0, 0, 0, 0], [1, 0, 0, 1, 0, 0], [0, 0, 0, 0, 0, 0.1]])
    mirrored = np.concatenate([Z, -Z])
    for rows, expected in ((Z, [2, 2, 2]), (mirrored, [0.75, 2, 2])):
        values, bases = supports(rows, targets)
        np.testing.assert_allclose(values, expected, atol=1e-12)
        assert bases.shape == targets.shape
        again, _ = supports(rows, targets, hints=bases)
        np.testing.assert_allclose(again, values, atol=1e-12)


def test_the_tighter_of_two_bounds_stays_and_of_equal_ones_the_first() -> None:
    plant = plant_of([[1.2]], [[1.0]])
    tight = impc.maximal_invariant_set(plant, [[0.9]], impc.Bounds(plant, u_min=-0.45, u_max=0.45))
    both = impc.maximal_invariant_set(
        plant, [[0.9]], impc.Bounds(plant, u_min=-0.45, u_max=0.45, x_min=-1, x_max=1)
    )
    assert pairs(both) == pairs(tight) == [(0, 0), (0, 1)]
    equal = impc.Bounds(plant_of([[0.5]], [[1.0]]), u_min=-1, u_max=1, x_min=-1, x_max=1)
    assert pairs(impc.maximal_invariant_set(plant, [[1.0]], equal)) == [(0, 0), (0, 1)]


def test_deadbeat_double_integrator_has_the_parallelogram_of_two_steps() -> None:
    # K = (1, 3/2) gives F^2 = 0: |x1 + 3/2 x2| <= 1 and, a step later, |x1 + x2 / 2| <= 1.
    plant = plant_of([[1, 1], [0, 1]], [[0.5], [1]])
    terminal = impc.maximal_invariant_set(plant, [[1, 1.5]], impc.Bounds(plant, u_min=-1, u_max=1))
    corners = terminal.vertices()
    start = int(np.argmin(np.abs(corners - [1, 0]).sum(axis=1)))
    expected = [[1, 0], [-2, 2], [-1, 0], [2, -2]]
    np.testing.assert_allclose(np.roll(corners, -start, axis=0), expected, atol=1e-12)
    assert area(corners) == pytest.approx(4)
    assert terminal.determinedness == 1


# 160 rows, 162 with a balanced delay: the weight 1e-2 of its states depends on their scaling.
@pytest.mark.parametrize(
    ("case", "rows", "steps"), [(example, 4, 1), (cannon, 10, 4), (seat, 160, 19)]
)
def test_known_sets_have_their_rows_and_steps(
    case: Callable[[], Case], rows: int, steps: int
) -> None:
    terminal = impc.maximal_invariant_set(*case())
    assert (len(terminal.h), terminal.determinedness) == (rows, steps)
    assert_certified(terminal)


def test_ten_slow_states_are_certified() -> None:
    terminal = impc.maximal_invariant_set(*slow_rotations())
    assert len(terminal.h) > 300
    assert_certified(terminal)


def test_rows_are_the_pairs_they_say() -> None:
    plant, K, bounds = cannon(upper=7.0)
    terminal = impc.maximal_invariant_set(plant, K, bounds)
    rows, F = bound_rows(bounds, plant), plant.A - plant.B @ K
    for i, (c, k) in enumerate(zip(terminal.family, terminal.step, strict=True)):
        expected = ((rows.E - rows.F @ K) @ np.linalg.matrix_power(F, int(k)))[c]
        np.testing.assert_allclose(terminal.H[i], expected, rtol=1e-11, atol=1e-13)
        assert terminal.h[i] == rows.b[c]


# Properties on random plants


@st.composite
def cases(draw: st.DrawFn) -> Case:
    """Random plants of 2 to 4 states and 1 to 2 inputs, some bounds missing, most not symmetric."""
    n, m = draw(st.integers(2, 4)), draw(st.integers(1, 2))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    A = rng.standard_normal((n, n))
    A *= draw(st.floats(0.3, 1.4)) / np.max(np.abs(np.linalg.eigvals(A)))
    plant = plant_of(A, rng.standard_normal((n, m)))
    upper, lower = np.exp(rng.uniform(-1, 2, n)), -np.exp(rng.uniform(-1, 2, n))
    if draw(st.booleans()):
        lower = -upper
    missing = rng.random(n) < draw(st.sampled_from([0.0, 0.5, 1.0]))
    upper[missing], lower[missing] = np.inf, -np.inf
    bounds = impc.Bounds(plant, u_min=-1, u_max=1, x_min=lower, x_max=upper)
    return plant, regulator(plant), bounds


few = draws(25)


@pytest.mark.full
@few
@given(cases(), st.integers(0, 2**32 - 1))
def test_inside_stays_inside_and_outside_leaves(case: Case, seed: int) -> None:
    terminal = impc.maximal_invariant_set(*case)
    directions = np.random.default_rng(seed).standard_normal((20, case[0].n))
    reach = np.max((terminal.H @ directions.T) / terminal.h[:, None], axis=0)
    for direction, gauge in zip(directions, reach, strict=True):
        if gauge > 1e-6:  # else unbounded that way
            edge = direction / gauge
            assert terminal.contains(0.999 * edge)
            assert not terminal.contains(1.001 * edge)
            assert worst_excess(terminal, 0.999 * edge, 300) <= 0
            assert worst_excess(terminal, 1.001 * edge, 300) > 5e-4


@pytest.mark.full
@few
@given(cases())
def test_rows_are_the_needed_ones_of_a_long_horizon(case: Case) -> None:
    terminal = impc.maximal_invariant_set(*case)
    H, h = terminal.H, terminal.h
    for i in range(len(h)):
        rest = np.arange(len(h)) != i
        assert plain_support(H[i], H[rest], h[rest]) > h[i] * (1 + 1e-9)
    rows = terminal.rows
    for k in range(terminal.determinedness + 4):
        power = np.linalg.matrix_power(terminal.F, k)
        for c, direction in enumerate((rows.E - rows.F @ terminal.gain) @ power):
            assert plain_support(direction, H, h) <= rows.b[c] * (1 + 1e-7)
    assert_certified(terminal)


@few
@given(cases(), st.floats(1e-6, 0.1), st.integers(0, 2**32 - 1))
def test_a_near_set_changes_nothing(case: Case, change: float, seed: int) -> None:
    plant, K, bounds = case
    start = impc.maximal_invariant_set(plant, K, bounds)
    moved = K * (1 + change * np.random.default_rng(seed).uniform(-1, 1, K.shape))
    if np.max(np.abs(np.linalg.eigvals(plant.A - plant.B @ moved))) < 0.99:
        cold = impc.maximal_invariant_set(plant, moved, bounds)
        warm = impc.maximal_invariant_set(plant, moved, bounds, near=start)
        assert pairs(warm) == pairs(cold)
        assert warm.determinedness == cold.determinedness
        np.testing.assert_array_equal(warm.H, cold.H)


def test_a_near_set_of_the_same_gain_needs_no_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    start = impc.maximal_invariant_set(*cannon())

    def refuse(*_: object, **__: object) -> None:
        pytest.fail("a linear program was solved")

    monkeypatch.setattr("impc.control.halfspaces.linprog", refuse)
    assert pairs(impc.maximal_invariant_set(*cannon(), near=start)) == pairs(start)


# Shape of the answer


def test_units_of_the_states_do_not_matter() -> None:
    plant, K, bounds = cannon(upper=7.0)
    scale = np.array([1e-6, 1e6])
    other = impc.replace(plant, A=plant.A * scale[:, None] / scale, B=plant.B * scale[:, None])
    scaled = impc.Bounds(
        other, u_min=-1, u_max=1, x_min=bounds.x_min * scale, x_max=bounds.x_max * scale
    )
    first = impc.maximal_invariant_set(plant, K, bounds)
    second = impc.maximal_invariant_set(other, K / scale, scaled)
    assert pairs(first) == pairs(second)
    assert_certified(second)


def test_a_direction_that_no_bound_sees_is_free() -> None:
    T = np.array([[1.0, 2.0, 0.5], [-1.0, 1.0, 0.0], [0.3, 0.2, 1.0]])
    loop = np.array([[0.9, 0.4, 0.0], [-0.4, 0.9, 0.0], [0.0, 0.0, 0.95]])
    plant = plant_of(T @ loop @ np.linalg.inv(T), T @ [[1.0], [0.0], [0.0]])
    K = np.array([[0.5, 0.2, 0.0]]) @ np.linalg.inv(T)
    terminal = impc.maximal_invariant_set(plant, K, impc.Bounds(plant, u_min=-1, u_max=1))
    assert len(terminal.h) > 2
    np.testing.assert_allclose(terminal.H @ T[:, 2], 0, atol=1e-12)
    assert terminal.contains(1e4 * T[:, 2])
    assert_certified(terminal)
    plane = plant_of([[0.9, 0.4], [-0.4, 0.9]], [[1.0], [0.0]])
    same = impc.maximal_invariant_set(plane, [[0.5, 0.2]], impc.Bounds(plane, u_min=-1, u_max=1))
    assert pairs(same) == pairs(terminal)


def test_no_bounds_no_rows() -> None:
    plant, K, _ = example()
    terminal = impc.maximal_invariant_set(plant, K, impc.Bounds(plant))
    assert terminal.H.shape == (0, 2)
    assert terminal.contains([1e9, -1e9])
    assert invariance_violation(terminal) == maximality_violation(terminal) == 0
    still = plant_of([[0.5]], [[1.0]])
    unused = impc.maximal_invariant_set(still, [[0.0]], impc.Bounds(still, u_min=-1, u_max=1))
    assert unused.H.shape == (0, 1)
    with pytest.raises(impc.InputError, match="whole space"):
        terminal.to_pytope()


def test_certificates_notice_a_wrong_set() -> None:
    terminal = impc.maximal_invariant_set(*cannon())
    loose = impc.replace(
        terminal, **{n: getattr(terminal, n)[2:] for n in ("H", "h", "family", "step")}
    )
    assert max(invariance_violation(loose), maximality_violation(loose)) > 1e-3
    assert maximality_violation(impc.replace(terminal, h=0.9 * terminal.h)) > 0.05
    assert maximality_violation(impc.replace(terminal, H=1.1 * terminal.H)) > 0.05
    early = terminal.step < terminal.determinedness
    short = {n: getattr(terminal, n)[early] for n in ("H", "h", "family", "step")}
    cut = impc.replace(terminal, determinedness=terminal.determinedness - 1, **short)
    assert maximality_violation(cut) <= 1e-9
    assert invariance_violation(cut) > 1e-3


# Pytope and polygons


@pytest.mark.parametrize("case", [example(), cannon(), cannon(upper=7.0)])
def test_pytope_agrees_in_the_plane(case: Case) -> None:
    pytope = pytest.importorskip("pytope", reason="the extra polytope is not installed")
    terminal = impc.maximal_invariant_set(*case)
    rows, count = terminal.rows, terminal.determinedness + 4
    normal = rows.E - rows.F @ terminal.gain
    powers = [np.linalg.matrix_power(terminal.F, k) for k in range(count)]
    every = pytope.Polytope(np.vstack([normal @ power for power in powers]), np.tile(rows.b, count))
    corners = terminal.vertices()
    for other in (every, terminal.to_pytope()):
        assert len(other.V) == len(corners) == len(terminal.h)
        gaps = np.linalg.norm(other.V[:, None] - corners, axis=2)
        assert np.max(np.min(gaps, axis=1)) <= 1e-9 * np.max(np.abs(corners))
    centre = np.mean(corners, axis=0)
    order = np.argsort(np.arctan2(*(every.V - centre).T[::-1]))
    assert area(corners) == pytest.approx(area(every.V[order]), rel=1e-9)
    assert area(corners) > 0
    low, high = 1.2 * corners.min(axis=0), 1.2 * corners.max(axis=0)
    for x in np.random.default_rng(3).uniform(low, high, (60, 2)):
        assert terminal.contains(x) == bool(np.all(every.A @ x <= every.b[:, 0]))


def test_pytope_takes_one_row_and_ten_states_without_corners() -> None:
    pytest.importorskip("pytope", reason="the extra polytope is not installed")
    plant = plant_of([[0.5]], [[1.0]])
    half_line = impc.maximal_invariant_set(plant, [[0.0]], impc.Bounds(plant, x_max=1))
    assert np.all(half_line.to_pytope().A == 1)
    assert not impc.maximal_invariant_set(*seat()).to_pytope().in_V_rep


def test_pytope_absent_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pytope", None)
    with pytest.raises(impc.ImpcError, match=r"impc\[polytope\]"):
        impc.maximal_invariant_set(*example()).to_pytope()


def test_corners_and_shadow_of_three_states_support_what_linear_programs_do() -> None:
    rng = np.random.default_rng(4)
    A = 0.8 * np.array([[1.0, 0.3, 0.0], [0.0, 0.9, 0.4], [0.1, 0.0, 0.8]])
    plant = plant_of(A, [[0.0], [0.0], [1.0]])
    bounds = impc.Bounds(plant, u_min=-1, u_max=1, x_min=[-2, -1, -3], x_max=[1, 2, 3])
    terminal = impc.maximal_invariant_set(plant, [[0.1, 0.1, 0.2]], bounds)
    corners, shadow = terminal.vertices(), terminal.project(0, 2)
    assert all(terminal.contains(corner) for corner in corners)
    for direction in rng.standard_normal((20, 3)):
        for points, along in ((corners, direction), (shadow, direction[[0, 2]])):
            whole = direction if points is corners else direction * [1, 0, 1]
            most = -float(linprog(-whole, terminal.H, terminal.h, bounds=(None, None)).fun or 0)
            assert np.max(points @ along) == pytest.approx(most, rel=1e-9)


def test_polygon_refuses_what_it_cannot_draw() -> None:
    plant = plant_of(np.diag([0.5, 0.8]), [[1.0], [0.0]])
    strip = impc.maximal_invariant_set(plant, [[0.3, 0.0]], impc.Bounds(plant, u_min=-1, u_max=1))
    cone = impc.maximal_invariant_set(plant, [[0.0, 0.0]], impc.Bounds(plant, x_max=1))
    none = impc.maximal_invariant_set(plant, [[0.0, 0.0]], impc.Bounds(plant))
    for terminal in (strip, cone, none):
        with pytest.raises(impc.InputError, match="unbounded"):
            terminal.vertices()
    with pytest.raises(impc.InputError, match="10 states"):
        impc.maximal_invariant_set(*slow_rotations()).vertices()


# Errors


def test_errors_say_what_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    plant, K, bounds = example()
    with pytest.raises(impc.InputError, match=r"spectral radius of A - BK is 1\.18"):
        impc.maximal_invariant_set(plant, 0 * K, bounds)
    with pytest.raises(impc.SolverError, match="max_steps = 3"):
        impc.maximal_invariant_set(*cannon(), max_steps=3)
    assert impc.maximal_invariant_set(*cannon(), max_steps=4).determinedness == 4
    continuous = impc.Plant(control.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]]))
    with pytest.raises(impc.PlantError, match="continuous"):
        impc.maximal_invariant_set(continuous, [[0.0]], impc.Bounds(continuous, u_max=1))
    with pytest.raises(impc.DataError, match="x: expected shape"):
        impc.maximal_invariant_set(plant, K, bounds).contains([1.0])

    def fail(*arguments: Any, **options: Any) -> Any:
        return linprog(*arguments, **{**options, "options": {"maxiter": 0, "presolve": False}})

    monkeypatch.setattr("impc.control.halfspaces.linprog", fail)
    with pytest.raises(impc.SolverError, match="HiGHS failed"):
        impc.maximal_invariant_set(plant, K, bounds)
