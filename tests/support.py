"""Random problems for the tests. Each is made from a seed that the test prints or names."""

from __future__ import annotations

import functools
import io
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any, TypeVar

import control
import numpy as np
import pytest
import scipy.optimize
from hypothesis import settings
from matplotlib.figure import Figure

import impc
from impc.control.closed_loop import simulate
from impc.inverse.problem import controller_for
from impc.inverse.residuals import linearise
from impc.studies.cache import Steps
from impc.studies.example.cases import CASES
from impc.studies.pool import Answer, Task, answered

ROOT = Path(__file__).parents[1]
Given = TypeVar("Given")
#: How many times the examples of `make test` are drawn: 1, or what `make search` asks for.
SEARCH = int(os.environ.get("IMPC_SEARCH", "1"))


def draws(count: int) -> settings:
    """So many examples of hypothesis, always the same; times SEARCH new ones in `make search`."""
    return settings(max_examples=count * SEARCH)


def leave_blank(patch: pytest.MonkeyPatch) -> None:
    """Files of figures with no picture: drawing takes most of some commands' time."""

    def blank(_figure: Figure, stream: io.BytesIO, **_: Any) -> None:
        stream.write(b'<svg viewBox="0 0 1 1"></svg>')

    patch.setattr(Figure, "savefig", blank)
    patch.setattr(Figure, "draw_without_rendering", lambda _: None)
    patch.setattr("impc.reporting.style._set_literally", lambda _: None)


def new_python(code: str, *options: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """What a fresh Python prints that runs a program in the folder of the checkout."""
    words = [sys.executable, *options, "-c", code]
    return subprocess.run(
        words, cwd=ROOT, env=os.environ | environment, capture_output=True, text=True, check=False
    )


def present(value: Given | None) -> Given:
    """The value, which is there."""
    assert value is not None
    return value


def nelder_mead(objective: Callable[[Any], float], start: np.ndarray, budget: int) -> float:
    """The least value that a derivative-free search finds: an oracle for the others."""
    options: Any = {"maxfev": budget, "xatol": 1e-9, "fatol": 1e-12}
    minimize: Any = scipy.optimize.minimize  # its stubs do not know the options of each method
    return float(minimize(objective, start, method="Nelder-Mead", options=options).fun)


def extrapolated_slope(function: Callable[[float], Any], first: float = 1e-2) -> np.ndarray:
    """Derivative of an array of a number at 0, by central differences at halved steps (Ridders).

    One step alone must weigh truncation against rounding, which grow where the other falls: at
    1e-5 a gain of 256 with a P of condition 1e5 is off by 2e-4. Neville's table takes both away
    and says its own error, by which the estimate is chosen.
    """
    table: list[np.ndarray] = []
    best, least = np.zeros(0), np.inf
    for power in range(8):
        step = first / 2**power
        row = [np.asarray((function(step) - function(-step)) / (2 * step))]
        for order, earlier in enumerate(table, 1):
            row.append(row[-1] + (row[-1] - earlier) / (4.0**order - 1))
            error = max(np.max(np.abs(row[-1] - row[-2])), np.max(np.abs(row[-1] - earlier)))
            if error < least:
                best, least = row[-1], float(error)
        table = row
    return best


def extrapolated_jacobian(
    function: Callable[[Any], Any], at: np.ndarray, first: float = 1e-2
) -> np.ndarray:
    """Derivative (r, q) of an array at `at` (q,), one `extrapolated_slope` a column."""
    columns = [
        extrapolated_slope(lambda t, unit=unit: function(at + t * unit), first)  # type: ignore[misc]
        for unit in np.eye(len(at))
    ]
    return np.array([column.ravel() for column in columns]).T


def differences(function: Callable[[Any], Any], at: Any, step: float = 1e-6) -> np.ndarray:
    """Derivative (r, q) of an array at `at` of any shape, by central differences."""
    at = np.asarray(at, dtype=float)
    columns = []
    for unit in step * np.eye(at.size):
        move = unit.reshape(at.shape)
        columns.append(np.ravel((function(at + move) - function(at - move)) / (2 * step)))
    return np.array(columns).T


def slopes(problem: impc.Problem, K: np.ndarray, S: np.ndarray) -> tuple[np.ndarray, ...]:
    """Residual (r,), and its derivatives by entries of K, parameters and those of the trial."""
    law = {"K": np.eye(K.size, K.size + len(problem.logarithms)).reshape(*K.shape, -1)}
    found = linearise(problem, controller_for(problem, K, S), law)
    return found.residual, *found.parts(problem)


def plant_of(A: Any, B: Any, C: Any = None, dt: float = 1.0) -> impc.Plant:
    """A plant without disturbances; all states are outputs unless C is given."""
    return impc.Plant(control.ss(A, B, np.eye(len(np.asarray(A))) if C is None else C, 0, dt))


def named_plant(
    A: Any, B: Any, C: Any, dt: float, states: str, inputs: str, outputs: str, **more: Any
) -> impc.Plant:
    """A plant with names of its signals, each a word; the first input is the control."""
    names: Any = {"states": states.split(), "inputs": inputs.split(), "outputs": outputs.split()}
    return impc.Plant(control.ss(A, B, C, 0, dt, **names), names["inputs"][:1], **more)


def regulator(
    plant: impc.Plant, Q: Any, limit: Any, horizon: int, R: Any = 1, *, terminal_set: bool = False
) -> impc.Controller:
    """The controller of weights Q and R, and |u| <= limit."""
    bounds = impc.Bounds(plant, u_min=-limit, u_max=limit)
    return impc.Controller(plant, impc.Weights(Q, R), bounds, horizon, terminal_set=terminal_set)


def posed(law: impc.Controller, *trials: impc.Recording, **given: Any) -> impc.Problem:
    """The inverse problem of recordings of a controller."""
    return impc.Problem(law.plant, law.bounds, law.horizon, trials, **given)


@functools.cache
def example_plant() -> impc.Plant:
    """The example of section 3.4: unstable, two states, one input."""
    return impc.Plant(control.ss([[2, -1], [1, 0.2]], [[1], [0]], np.eye(2), 0, True))


@functools.cache
def example_problem(case: str, scale: float = 1.0) -> impc.Problem:
    """The example recorded under Q = I and R = 1; all numbers `scale` times as large."""
    plant = example_plant()
    law = regulator(plant, np.eye(2), scale, 3, terminal_set=True)
    run = simulate(law, impc.scenario(plant, x0=scale * np.array(CASES[case]), steps=20))
    return posed(law, impc.Recording(plant, run.x))


def random_plant(rng: np.random.Generator, n: int, m: int, radius: float, d: int = 0) -> impc.Plant:
    """A random discrete plant with the given spectral radius and d disturbances."""
    A = rng.normal(size=(n, n))
    A *= radius / np.max(np.abs(np.linalg.eigvals(A)))
    names = [f"u{i}" for i in range(m)]
    system = control.ss(
        A,
        rng.normal(size=(n, m + d)),
        np.eye(n),
        0,
        True,
        inputs=[*names, *(f"d{i}" for i in range(d))],
    )
    return impc.Plant(system, names)


def random_weights(rng: np.random.Generator, size: int) -> np.ndarray:
    """A random positive definite matrix of moderate condition."""
    factor = rng.normal(size=(size, size))
    return factor @ factor.T + 0.1 * np.eye(size)


def easier_seat(configuration: str) -> str:
    """The seat's TOML with six states for ten, a horizon of 4 for 20, and a body that is known.

    A fit of it takes a tenth of the time.
    """
    known = "[plant]\ndelay_order = 1\nuncertainty = { all = 0 }"
    fewer = configuration.replace("[plant]", known)
    return fewer.replace("horizon = 20", "horizon = 4")


def saturated_problem(
    rng: np.random.Generator, n: int, m: int
) -> tuple[impc.Weights, impc.Controller, impc.Problem]:
    """An exact recording of n states and m inputs, 2 to 30 % of which stand at their bounds."""
    while True:
        plant = random_plant(rng, n, m, rng.uniform(0.8, 1.1), d=1)
        weights = impc.Weights(random_weights(rng, n), random_weights(rng, m))
        bounds = impc.Bounds(plant, u_min=-1, u_max=1)
        controller = impc.Controller(plant, weights, bounds, 5, terminal_set=False)
        push = rng.choice([-1.0, 0.0, 1.0], size=40).repeat(5)
        for size in 10 * 0.8 ** np.arange(40):
            run = simulate(controller, impc.scenario(plant, np.zeros(n), disturbance=size * push))
            saturated = np.mean(np.abs(np.abs(run.u) - 1) < 1e-9)
            if run.complete and 0.02 < saturated < 0.3:
                trial = impc.Recording(plant, run.x, np.append(size * push, 0))
                problem = impc.Problem(plant, bounds, 5, (trial,), terminal_set=False)
                return weights, controller, problem


@functools.cache
def random_problem(seed: int, m: int) -> tuple[impc.Controller, impc.Problem]:
    """`saturated_problem` of 2 to 6 states and m inputs."""
    return saturated_problem(np.random.default_rng([14, m, seed]), 2 + seed % 5, m)[1:]


def kept_names(steps: Steps) -> set[str]:
    """Names of the results that a folder keeps for these steps."""
    found = set()
    for path in steps.cache.folder.rglob("*.json"):
        name = re.search(rb'"name": ("[^"]*")}$', path.read_bytes().strip())
        if name and steps.cache.find(json.loads(name[1]), steps.digest) is not None:
            found.add(json.loads(name[1]))
    return found


class ThisProcess:
    """One task after the other, in this process."""

    threads = 1

    def submit(self, task: Task) -> Future[Answer]:
        """As `Pool.submit`."""
        future: Future[Answer] = Future()
        future.set_result(answered(task))
        return future
