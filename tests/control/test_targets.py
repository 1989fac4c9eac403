"""Targets, preview and lasting disturbances, against independent programs and differences."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.optimize

import impc
from impc.arrays import Array
from impc.checking import replace
from impc.control.constraint_rows import directions
from impc.errors import DataError, InputError, PlantError
from impc.model.plant import Plant
from tests.independent_mpc import first_input
from tests.support import random_plant, random_weights

STEPS = 25


def a_loop(seed: int, *, ahead: int = 0, rate: float = 0.0) -> tuple[Any, ...]:
    """A random plant with changing targets, its weights, and its controller with limits."""
    rng = np.random.default_rng(seed)
    n, m = 2 + seed % 3, 1 + seed % 2
    plant = random_plant(rng, n, m, 1.05, d=1)
    Q, R = random_weights(rng, n), random_weights(rng, m)
    signals = plant.states[:m]
    x = np.cumsum((rng.random((STEPS + 1, m)) < 0.2) * rng.normal(size=(STEPS + 1, m)), axis=0)
    target = {name: 0.07 * column for name, column in zip(signals, x.T, strict=True)}
    push = 0.05 * rng.normal() + 0.01 * rng.normal(size=STEPS)
    known = impc.with_observer(plant, rate) if rate else plant
    known = impc.with_preview(known, signals, ahead) if ahead else known
    whole = np.zeros((known.n, known.n))
    whole[:n, :n] = Q
    return plant, (Q, R), known, impc.Weights(whole + 1e-13 * np.eye(known.n), R), target, push


def rest_of(plant: Plant, values: Array, push: float, limit: float) -> tuple[Array, Array]:
    """Steady state nearest to targets of the first states, by a general solver within bounds."""
    n, m, q = plant.n, plant.m, len(values)
    still, moved = np.hstack([plant.A - np.eye(n), plant.B]), -plant.E[:, 0] * push
    z = np.linalg.lstsq(np.vstack([still, np.eye(n + m)[:q]]), np.r_[moved, values])[0]
    if np.any(np.abs(z[n:]) > limit):
        minimize: Any = scipy.optimize.minimize
        z = minimize(
            lambda z: np.sum((z[:q] - values) ** 2),
            np.zeros(n + m),
            jac=lambda z: np.r_[2 * (z[:q] - values), np.zeros(n + m - q)],
            method="SLSQP",
            bounds=[(None, None)] * n + [(-limit, limit)] * m,
            constraints={"type": "eq", "fun": lambda z: still @ z - moved, "jac": lambda _: still},
            options={"ftol": 1e-16, "maxiter": 500},
        ).x
    return z[:n], z[n:]


@pytest.mark.parametrize("ahead", [0, 4])
@pytest.mark.parametrize("rate", [0.0, 0.5, np.inf])
@pytest.mark.parametrize("seed", range(6))
def test_inputs_are_those_of_a_program_about_the_target(seed: int, ahead: int, rate: float) -> None:
    """The target stays or is known in advance; a disturbance stays at its estimate."""
    plant, (Q, R), known, weights, target, push = a_loop(seed, ahead=ahead, rate=rate)
    horizon, limit = 5, 0.6
    bounds = impc.Bounds(known, u_min=-limit, u_max=limit)
    law = impc.Controller(known, weights, bounds, horizon, terminal_set=False)
    x0 = np.random.default_rng(seed).normal(size=plant.n)
    run = law.simulate(x0, disturbance=push, target=target)
    values, believed, checked = np.array(list(target.values())).T, 0.0, 0
    for t in range(STEPS):
        expected = push[t] if np.isinf(rate) else believed
        rests = [
            rest_of(plant, values[min(t + min(k, ahead), STEPS)], expected, limit)
            for k in range(horizon + 1)
        ]
        believed += (1 - np.exp(-rate * plant.dt)) * (push[t] - believed) if rate else 0.0
        clipped = any(np.any(np.abs(u) > limit * (1 - 1e-6)) for _, u in rests)
        if clipped and ahead:  # Coming targets are planned for as if no bound were reached.
            continue
        X, U = (np.array(part) for part in zip(*rests, strict=True))
        drift = plant.E[:, 0] * expected if rate else np.zeros(plant.n)
        wanted = first_input(
            *(plant.A, plant.B, Q, R, horizon, run.x[t, : plant.n], limit),
            targets=(X, U[:-1]),
            drift=drift,
        )
        checked += 1
        assert run.u[t] == pytest.approx(wanted, abs=1e-6 if clipped else 1e-8)
    assert checked >= 5
    assert np.count_nonzero(run.status == 1) > 0


@pytest.mark.parametrize("named", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_slopes_of_targets_are_differences(seed: int, named: bool) -> None:
    """Along plant, gain and observer rate, with saturated samples; also without target signals.

    Then the steady state has minimum norm, and its null space depends on the plant.
    """
    plant, _, known, weights, target, push = a_loop(seed, rate=0.7)
    target = target if named else {}
    bounds = impc.Bounds(known, u_min=-0.3, u_max=0.3)
    law = impc.Controller(known, weights, bounds, 4, terminal_set=False)
    drive = impc.scenario(known, np.ones(plant.n), disturbance=push, target=target)
    rng = np.random.default_rng(seed)
    parts = {
        "A": rng.normal(size=plant.A.shape),
        "B": rng.normal(size=plant.B.shape),
        "E": rng.normal(size=plant.E.shape),
        "observer": rng.normal(size=1),
        "K": rng.normal(size=law.K.shape),
    }

    def at(step: float) -> Array:
        moved = {
            name: np.array(getattr(known, name)) + step * parts[name]
            for name in parts
            if name != "K"
        }
        plant = replace(known, **moved)
        there = replace(law, plant=plant, K=np.array(law.K) + step * parts["K"])
        run, _ = impc.simulate_and_differentiate(there, drive, directions(there, 0))
        return np.hstack([run.x[:-1], run.u])

    _, slope = impc.simulate_and_differentiate(
        law,
        drive,
        impc.directions(law, 1, **{name: part[..., None] for name, part in parts.items()}),
    )
    found = np.hstack([slope.x[:-1, :, 0], slope.u[..., 0]])
    h = 1e-6
    wanted = (at(h) - at(-h)) / (2 * h)
    assert found == pytest.approx(wanted, abs=2e-6 * np.max(np.abs(wanted)))
    assert impc.simulate_and_differentiate(law, drive, directions(law, 0))[0].status.max() == 1


@pytest.mark.parametrize("seed", range(2))
def test_slopes_where_every_target_is_beyond_reach(seed: int) -> None:
    """Along the plant's B, at steady states with all commands at their bounds."""
    plant, _, _, weights, target, _ = a_loop(seed)
    bounds = impc.Bounds(plant, u_min=-1e-3, u_max=1e-3)
    law = impc.Controller(plant, weights, bounds, 4, terminal_set=False)
    drive = impc.scenario(plant, np.zeros(plant.n), 5, target=dict.fromkeys(target, 1.0))
    _, slope = impc.simulate_and_differentiate(law, drive, impc.directions(law, 1, B=plant.B))

    def at(step: float) -> Array:
        there = replace(law, plant=replace(plant, B=plant.B * (1 + step)))
        return np.array(impc.simulate_and_differentiate(there, drive, directions(there, 0))[0].x)

    wanted = (at(1e-6) - at(-1e-6)) / 2e-6
    assert np.max(np.abs(wanted)) > 0
    assert slope.x[..., 0] == pytest.approx(wanted, abs=1e-6 * np.max(np.abs(wanted)))


@pytest.mark.parametrize("seed", range(4))
def test_preview_identifies_more_of_q(seed: int) -> None:
    """Gains on coming changes, and the rank of all gains in Q: docs/why/theory.md, section 7."""
    rng = np.random.default_rng(seed)
    plant = random_plant(rng, 3, 1, 1.05)
    Q = random_weights(rng, 3)

    def gain(Q: Array, ahead: int) -> Array:
        known = impc.with_preview(plant, plant.states[:1], ahead) if ahead else plant
        whole = np.zeros((known.n, known.n))
        whole[:3, :3] = Q
        return np.asarray(impc.solve_lqr(known, impc.Weights(whole, 1)).K)

    alone = impc.solve_lqr(plant, impc.Weights(Q, 1))
    F, M = plant.A - plant.B @ alone.K, impc.steady_state(plant, {plant.states[0]: 1.0})[0]
    ahead = [
        np.linalg.solve(alone.S, plant.B.T @ np.linalg.matrix_power(F.T, j) @ alone.P @ M)
        for j in range(4)
    ]
    assert gain(Q, 4)[0] == pytest.approx(np.r_[alone.K[0], -np.ravel(ahead)], rel=1e-8)
    for samples, rank in ((0, 3), (1, 3), (2, 4), (3, 5), (5, 5)):
        slopes = []
        for i, j in zip(*np.triu_indices(3), strict=True):
            step = 1e-4 * (np.eye(3)[[i]].T @ np.eye(3)[[j]] + np.eye(3)[[j]].T @ np.eye(3)[[i]])
            slopes.append(np.ravel(gain(Q + step, samples) - gain(Q - step, samples)) / 2e-4)
        sizes = np.linalg.svd(np.array(slopes), compute_uv=False)
        assert np.count_nonzero(sizes > 1e-6 * sizes[0]) == rank


def test_a_rest_is_one_and_reaches_its_target() -> None:
    plant, _, _, _, _, _ = a_loop(3)
    x, u = impc.steady_state(plant, {plant.states[0]: 0.4}, disturbance=[0.2])
    assert plant.A @ x + plant.B @ u + plant.E[:, 0] * 0.2 == pytest.approx(x)
    assert x[0] == pytest.approx(0.4)
    bounds = impc.Bounds(plant, u_min=-0.01, u_max=0.01)
    nearer, least = impc.steady_state(plant, {plant.states[0]: 0.4}, bounds=bounds)
    assert np.max(np.abs(least)) == pytest.approx(0.01)
    assert abs(nearer[0] - 0.4) < 0.4


def test_what_has_no_target_is_refused() -> None:
    plant, _, known, weights, target, push = a_loop(0, ahead=2)
    law = impc.Controller(known, weights, impc.Bounds(known), 3, terminal_set=False)
    with pytest.raises(DataError, match="no signal 'elsewhere'"):
        law.simulate(np.zeros(plant.n), disturbance=push, target={"elsewhere": 1.0})
    with pytest.raises(PlantError, match="lacks"):
        law.simulate(np.zeros(plant.n), disturbance=push)
    with pytest.raises(DataError, match="give one number, or 26"):
        law.simulate(np.zeros(plant.n), disturbance=push, target={plant.states[0]: [1.0, 2.0]})
    ended = impc.Controller(
        plant, impc.Weights(np.eye(plant.n), 1), impc.Bounds(plant, u_min=-1, u_max=1), 3
    )
    with pytest.raises(InputError, match="terminal set"):
        ended.simulate(np.zeros(plant.n), disturbance=push, target=target)
