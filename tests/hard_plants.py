"""Random controllers at and beyond the edge of what they can keep, and a check of what they say.

    python -m tests.hard_plants FIRST COUNT [SAMPLES]

checks the seeds from FIRST on and prints each that is wrong, then how the simulations ended.
"""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import dataclass
from decimal import Decimal

import numpy as np

from impc.control.closed_loop import PreparedLoop, prepare_loop, run_loop, simulate
from impc.control.compiled_dual import solve_dual
from impc.control.constraint_rows import directions
from impc.control.controller import Controller
from impc.control.simulation import Scenario, Simulation, Status, scenario
from impc.errors import SolverError
from impc.model.bounds import Bounds, bound_rows
from impc.model.weights import Weights
from tests.exact_mpc import NOTHING, ExactProgram, exact, first_input
from tests.support import random_plant, random_weights

STEPS = 40
# What a bound may be exceeded by, as a share of it.
_PROMISED = Decimal("1e-9")


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
    cost_weight = 10 ** rng.uniform(-2, 2)
    weights = Weights(random_weights(rng, n), cost_weight * random_weights(rng, m))
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
    prepared = prepare_loop(controller, directions(controller, 0))
    inside, outside = 1e-3, 1e3
    for _ in range(20):
        middle = float(np.sqrt(inside * outside))
        start = scenario(controller.plant, middle * direction, STEPS)
        if run_loop(prepared, start)[0].complete:
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


def cost_weights(prepared: PreparedLoop, x: np.ndarray) -> np.ndarray:
    """Multipliers of the package, in the order of the reference's rows; 1 where only the sign is.

    Those of the rows that are active, or of those that exclude each other.
    """
    controller, rows = prepared.controller, prepared.rows
    plant, horizon = controller.plant, controller.horizon
    bounds = bound_rows(controller.bounds, plant)
    on, m = bounds.on_state, plant.m
    upper, lower = np.zeros((2, horizon, m))
    state = np.zeros((horizon, int(on.sum())))
    last = np.zeros(int(np.sum(rows.stage >= horizon)))
    count, width = rows.M.shape
    room, lam = min(count, width) + 1, np.zeros(count)
    solve_dual(
        rows.W, rows.reach, rows.gram, rows.b - rows.T @ x, rows.limit, 1e-13 * rows.b, lam,
        np.empty(room, dtype=np.int64), np.empty((room, room)), np.zeros((room, width)),
        np.zeros(1, dtype=np.int64), 0,
    )  # fmt: skip
    for r in np.flatnonzero(lam > 0):
        family, k = rows.family[r], rows.stage[r]
        if k >= horizon:
            last[r - (len(lam) - len(last))] = lam[r]
        elif on[family]:
            state[k, family - 2 * m] = lam[r]
        elif family < m:
            upper[k, family] = lam[r]
        else:
            lower[k, family - m] = lam[r]
    return np.concatenate([part.ravel() for part in (upper, lower, state, last)])


def faults(case: HardCase, run: Simulation, samples: int) -> list[str]:
    """What is wrong with a simulation: empty when nothing is.

    Inputs keep their bounds to 1e-9; at up to `samples` samples, the first and the last that a
    program was solved at among them (the last is the one after which the state is out of range,
    where it is), they are those of the reference to 1e-7 of the bound. Where it is said that there
    is none, the reference has none. A program that the rounding of the states before has made
    infeasible (seed 10994, by 1e-11 of a bound) is compared with rows moved by what is promised.
    """
    controller, plant = case.controller, case.controller.plant
    low, high = controller.bounds.u_min, controller.bounds.u_max
    status = Status.FREE if run.complete else Status(int(run.status[run.reached]))
    applied = run.reached + (status == Status.DIVERGED)
    u, found = run.u[:applied], []
    if np.any(u > high * (1 + 1e-9)) or np.any(u < low * (1 + 1e-9)):
        found.append(
            f"an input is {np.max(np.maximum(u / high, u / low)) - 1:.1e} beyond its bound"
        )
    moved = run.x[:applied] @ plant.A.T + u @ plant.B.T
    reached = run.x[1 : run.reached + 1]
    if np.any(abs(moved[: run.reached] - reached) > 1e-12 * (1 + abs(reached))):
        found.append("the states are not those of the plant")
    if status == Status.DIVERGED and not np.max(abs(moved[-1])) > 1e6:
        found.append("called diverged with a state in range")
    program, prepared = reference(case), prepare_loop(controller, directions(controller, 0))
    if status == Status.INFEASIBLE:
        x = run.x[run.reached]
        cost_weight = cost_weights(prepared, x)
        excluded = program.is_excluded(exact(x), exact(cost_weight))
        if not excluded and first_input(program, x, cost_weight > 0, NOTHING) is not None:
            found.append("called infeasible, and there is a plan")
    busy = np.flatnonzero(run.status[:applied] != Status.FREE)
    if not len(busy):
        busy = np.arange(min(applied, 1))
    for t in busy[np.linspace(0, len(busy) - 1, min(samples, len(busy))).astype(int)]:
        active = cost_weights(prepared, run.x[t]) > 0
        true = first_input(program, run.x[t], active)
        if true is None:
            true = first_input(program, run.x[t], active, _PROMISED)
        if true is None:
            found.append(f"sample {t}: an input where there is none")
            continue
        error = np.max(abs(true - run.u[t]) / np.minimum(-low, high))
        if not error <= 1e-7:
            found.append(f"sample {t}: {error:.1e} of the bound from the reference")
    return found


def main(first: int, count: int, samples: int = 4) -> int:
    """Check, and say how many simulations ended how; the number of those that are wrong."""
    ends: Counter[str] = Counter()
    wrong = 0
    for seed in range(first, first + count):
        if seed % 100 == 0:
            print(f"seed {seed}", end="\r", file=sys.stderr, flush=True)
        case = hard_case(seed)
        run = simulate(case.controller, case.drive)
        name = "complete" if run.complete else Status(int(run.status[run.reached])).name.lower()
        if run.complete and np.any(run.status != Status.FREE):
            name += ", at bounds"
        ends[name] += 1
        found = faults(case, run, samples)
        if found or name == "unsolved":
            print(f"seed {seed}: {name}; {'; '.join(found) or 'nothing wrong'}", flush=True)
        wrong += bool(found)
    for name, times in ends.most_common():
        print(f"{times:6d}  {name}")
    print(f"{wrong:6d}  wrong")
    return wrong


if __name__ == "__main__":
    sys.exit(min(1, main(*map(int, sys.argv[1:]))))
