"""Coverage of 95 % gain intervals with targets, lasting pushes, recorded commands and gaps.

    python -m experiments.tracking_coverage [recordings]

A cart on a weak spring (mass 1 kg, 0.1 s) follows a drifting target for 30 s, with recording noise
of 5 % of the positions' size. Half of the carts reach their limit. Every recording has its own
weights, target and noise. Results: experiments/coverage.md.
"""

from __future__ import annotations

import itertools
import sys
from typing import Any

import control
import numpy as np
import scipy.signal

import impc
from experiments.driver import each
from experiments.summary import counted

STEPS, HORIZON = 300, 8

KINDS = (
    "target",
    "target known 3 samples ahead",
    "lasting push, learned at 1 1/s",
    "change of the command",
    "commands recorded with noise",
    "offset, and a third missing",
)


def cart() -> impc.Plant:
    """Cart with states position and velocity, command push, and disturbance wind."""
    system = control.ss(
        [[1, 0.1], [-0.02, 0.97]], [[0, 0], [0.1, 0.1]], [[1, 0]], 0, 0.1,
        states=["x", "v"], inputs=["push", "wind"], outputs=["x"],
    )  # fmt: skip
    return impc.Plant(system, controls=["push"])


def covered(task: tuple[str, int]) -> tuple[int, int, int]:
    """Identified entries of one recording, covered ones, and samples at a limit."""
    kind, seed = task
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    limit = 0.25 if seed % 2 else 9.0
    plant = cart()
    limits: dict[str, Any] = {"u_min": -limit, "u_max": limit}
    more: dict[str, Any] = {}
    if kind == "target known 3 samples ahead":
        plant = impc.with_preview(plant, ["x"], 3)
    elif kind.startswith("lasting"):
        plant = impc.with_observer(plant, 1.0)
    elif kind.startswith("change"):
        plant = impc.with_rates(plant)
        limits = {"x_min": {"push": -limit}, "x_max": {"push": limit}}
    Q = np.zeros((plant.n, plant.n))
    Q[:2, :2] = np.diag(10 ** rng.uniform(-0.5, 1, 2))
    if kind.startswith("change"):
        Q[2, 2] = 0.5
    bounds = impc.Bounds(plant, **limits)
    weights = impc.Weights(Q + 1e-9 * np.eye(plant.n), 1)
    law = impc.Controller(plant, weights, bounds, HORIZON, terminal_set=False)
    walk = scipy.signal.lfilter([1], [1, -0.95], rng.normal(size=STEPS + 1))
    target = {"x": 0.1 * walk}
    wind = 0.2 * np.cumsum((rng.random(STEPS) < 0.03) * rng.normal(size=STEPS))
    if kind != "lasting push, learned at 1 1/s":
        wind = 0.1 * rng.normal(size=STEPS)
    start = np.zeros(2 if plant.ahead else plant.n)
    run = law.simulate(start, disturbance=wind, target=target)
    y = run.x @ plant.C.T
    y = y + 0.05 * np.std(y) * rng.normal(size=y.shape)
    if kind.startswith("commands"):
        more["commands"] = run.u + 0.1 * np.std(run.u) * rng.normal(size=run.u.shape)
    if kind.startswith("offset"):
        y = y + 0.2
        y[rng.random(len(y)) < 1 / 3] = np.nan
    trial = impc.Recording(plant, y, wind, target=target, **more)
    offsets = ["x"] if kind.startswith("offset") else []
    found = impc.fit(impc.Problem(plant, bounds, HORIZON, [trial], offsets=offsets))
    table = found.intervals()
    true = np.ravel(law.K)
    inside = (table["low"] <= true) & (true <= table["high"])
    known = table["determined"].to_numpy(dtype=bool)
    return int(known.sum()), int((inside & known).sum()), int(np.count_nonzero(run.status))


def main(recordings: int) -> None:
    """Print the coverage of all kinds."""
    tasks = list(itertools.product(KINDS, range(recordings)))
    found = np.array(each(covered, tasks)).reshape(len(KINDS), recordings, 3)
    for kind, rows in zip(KINDS, found, strict=True):
        known, inside, _ = rows.sum(axis=0)
        at_limit = np.count_nonzero(rows[:, 2])
        print(f"{kind}: {counted(int(inside), int(known))}; {at_limit} recordings at a limit")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 60)
