"""Random controllers at and beyond the edge of what they can keep, and a check of what they say."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import linprog

from impc.control.closed_loop import Scenario, Simulation, Status, prepare_loop, scenario, simulate
from impc.control.compiled_loop import solve_dual
from impc.control.constraint_rows import build_rows, directions
from impc.control.controller import Controller
from impc.control.saturated import solve_saturated
from impc.errors import SolverError
from impc.model.bounds import Bounds, bound_rows
from impc.model.weights import Weights
from tests.exact_mpc import ExactProgram, exact
from tests.support import random_plant, random_weights

STEPS = 40


@dataclass(frozen=True)
class HardCase:
    """A controller and where it starts."""

    weights: Weights
    controller: Controller
    drive: Scenario


def hard_case(seed: int, largest: int = 60) -> HardCase:
    """1-3 inputs, 2-8 states, poles to 2, horizons to `largest`, with and without state rows."""
    rng = np.random.default_rng([14, seed])
    n = int(rng.integers(2, 9))
    m = int(rng.integers(1, min(n, 3) + 1))
    horizon = int(rng.integers(1, largest + 1))
    plant = random_plant(rng, n, m, rng.uniform(0.7, 2.0))
    price = 10 ** rng.uniform(-2, 2)
    weights = Weights(random_weights(rng, n), price * random_weights(rng, m))
    x_max = rng.uniform(1, 4) if rng.random() < 0.4 else np.inf
    low, high = -rng.uniform(0.3, 3, size=m), rng.uniform(0.3, 3, size=m)
    bounds = Bounds(plant, u_min=low, u_max=high, x_min=-x_max, x_max=x_max)
    with_set = bool(rng.random() < 0.5)
    try:
        controller = Controller(plant, weights, bounds, horizon, terminal_set=with_set)
    except SolverError:  # a terminal set of too many steps: without one
        controller = Controller(plant, weights, bounds, horizon, terminal_set=False)
    direction = rng.normal(size=n)
    size = 10 ** rng.uniform(-1, 2)
    if rng.random() < 0.5:
        size = _edge(controller, direction) * (1 + rng.choice([-1, 1]) * 10 ** rng.uniform(-12, -1))
    return HardCase(weights, controller, scenario(plant, size * direction, STEPS))


def _edge(controller: Controller, direction: np.ndarray) -> float:
    """The size of a start between those that end well and those that do not."""
    inside, outside = 1e-3, 1e3
    for _ in range(20):
        middle = float(np.sqrt(inside * outside))
        if simulate(controller, scenario(controller.plant, middle * direction, STEPS)).complete:
            inside = middle
        else:
            outside = middle
    return inside


def reference(case: HardCase) -> ExactProgram:
    """The program of the case, from its weights."""
    controller, plant = case.controller, case.controller.plant
    bounds = bound_rows(controller.bounds, plant)
    on = bounds.on_state
    terminal = controller.terminal
    return ExactProgram(
        plant.A,
        plant.B,
        case.weights.Q,
        case.weights.R,
        controller.horizon,
        controller.bounds.u_min,
        controller.bounds.u_max,
        (bounds.E[on], bounds.b[on]) if np.any(on) else None,
        (terminal.H, terminal.h) if terminal is not None else None,
    )


def guess(controller: Controller, x: np.ndarray) -> np.ndarray:
    """The rows that the package takes to be active, in the order of the reference."""
    plant, horizon = controller.plant, controller.horizon
    bounds, rows = bound_rows(controller.bounds, plant), build_rows(controller)
    on, m = bounds.on_state, plant.m
    upper, lower = np.zeros((2, horizon, m), dtype=bool)
    state = np.zeros((horizon, int(on.sum())), dtype=bool)
    last = np.zeros(int(np.sum(rows.stage >= horizon)), dtype=bool)
    if not np.any(on) and not len(last):
        sides = np.array(controller.bounds.u_min), np.array(controller.bounds.u_max)
        loop = prepare_loop(controller, directions(controller, 0)).matrices
        plan = solve_saturated(loop, np.array(controller.S), *sides, horizon, x)
        upper, lower = plan.at > 0, plan.at < 0
    else:
        count, width = rows.M.shape
        room, lam = min(count, width) + 1, np.zeros(count)
        solve_dual(
            rows.W, rows.gram, rows.b - rows.T @ x, rows.limit, 1e-13 * rows.b, lam,
            np.empty(room, dtype=np.int64), np.empty((room, room)), np.empty((room, width)),
        )  # fmt: skip
        for r in np.flatnonzero(lam > 0):
            family, k = rows.family[r], rows.stage[r]
            if k >= horizon:
                last[r - (len(lam) - len(last))] = True
            elif on[family]:
                state[k, family - 2 * m] = True
            elif family < m:
                upper[k, family] = True
            else:
                lower[k, family - m] = True
    return np.concatenate([part.ravel() for part in (upper, lower, state, last)])


def faults(case: HardCase, run: Simulation, samples: int) -> list[str]:
    """What is wrong with a simulation: empty when nothing is.

    Inputs keep their bounds to 1e-9; at up to `samples` samples, the first and the last that a
    program was solved at among them, they are those of the reference to 1e-7 of the bound; the
    sample that ends it has the status that linear programming and the plant tell.
    """
    controller, plant = case.controller, case.controller.plant
    low, high = controller.bounds.u_min, controller.bounds.u_max
    u, found = run.u[: run.reached], []
    if np.any(u > high * (1 + 1e-9)) or np.any(u < low * (1 + 1e-9)):
        found.append(
            f"an input is {np.max(np.maximum(u / high, u / low)) - 1:.1e} beyond its bound"
        )
    moved = run.x[: run.reached] @ plant.A.T + u @ plant.B.T
    if np.any(
        abs(moved - run.x[1 : run.reached + 1]) > 1e-12 * (1 + abs(run.x[1 : run.reached + 1]))
    ):
        found.append("the states are not those of the plant")
    status = Status.FREE if run.complete else Status(int(run.status[run.reached]))
    if status == Status.INFEASIBLE and not _is_infeasible(case, run.x[run.reached]):
        found.append("called infeasible, and linear programming finds a plan")
    busy = np.flatnonzero(run.status[: run.reached] != Status.FREE)
    chosen = (
        sorted({int(t) for t in busy[np.linspace(0, len(busy) - 1, samples).astype(int)]})
        if len(busy)
        else [0]
    )
    program = reference(case)
    for t in chosen[: run.reached]:
        true = program.first_input(run.x[t], guess(controller, run.x[t]))
        if true is None:
            found.append(f"sample {t}: no reference")
            continue
        error = np.max(abs(true - run.u[t]) / np.minimum(-low, high))
        if not error <= 1e-7:
            found.append(f"sample {t}: {error:.1e} of the bound from the reference")
    return found


def _is_infeasible(case: HardCase, x: np.ndarray) -> bool:
    """Whether HiGHS finds no plan that keeps the rows of the program in u with some room.

    Each row is divided by its largest number; HiGHS's own tolerance is 1e-7 of that.
    """
    program, controller = reference(case), case.controller
    width = len(program.H)
    G, room = program.G[2 * width :], (program.b - program.F @ exact(x))[2 * width :]
    scale = np.maximum(abs(G).max(axis=1), abs(room))
    count = len(scale)
    sides = zip(controller.bounds.u_min, controller.bounds.u_max, strict=True)
    answer: Any = linprog(
        np.r_[np.zeros(width), -1.0],
        A_ub=np.column_stack([(G / scale[:, None]).astype(float), np.ones(count)]),
        b_ub=(room / scale).astype(float),
        bounds=[*(list(sides) * controller.horizon), (None, 1.0)],
        method="highs",
    )
    return answer.status == 2 or float(answer.x[-1]) <= 1e-7
