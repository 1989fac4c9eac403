"""Coverage of the 95 % gain intervals that a fit prints.

One, two or three carts on a falling track, each with its own force and coupled by springs, are
pushed at random for 80 s. Every force is at its limit in some percent of the samples. The positions
are recorded with noise, white or first-order, with which the truth has a VAF of 90 or 70 %. Each
recording is fitted as `impc fit` does. The intervals of the individually identified entries of K
and of the identified directions are compared with the truth. Results: experiments/coverage.md.

    python -m experiments.printed_intervals --recordings 200
    python -m experiments.printed_intervals --recordings 200 --random
"""

from __future__ import annotations

import argparse
import functools
import itertools
from typing import NamedTuple

import control
import numpy as np

from experiments.driver import each, with_noise
from experiments.summary import markdown
from impc.arrays import Array
from impc.assess.covariance import TWO_SIDED
from impc.assess.printed_gain import gain_estimate
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.simulation import scenario
from impc.inverse.estimates import Estimate
from impc.inverse.noisy_fit import fit_controller
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.weights import Weights
from impc.studies.fit.asked import fit_problem
from impc.studies.fit.settings import FitSettings

__all__ = [
    "Scores",
    "carts",
    "fit",
    "noisy_recording",
    "random_recording",
    "regulator",
    "score",
    "score_carts",
    "shares",
]

_HORIZON, _SAMPLES, _HOLD = 8, 800, 10


class Scores(NamedTuple):
    """Errors of one fit over the printed standard errors; NaN if not identified."""

    entries: Array  # Of the entries of K (m * n,)
    directions: Array  # Along the directions of the gain (m * n,), best first
    bias: Array  # Relative error of each entry of K (m * n,)


def carts(count: int, dt: float = 0.1) -> Plant:
    """`count` carts in a row on a falling track: positions, then speeds."""
    n = 2 * count
    A, force, push = np.zeros((n, n)), np.zeros((n, count)), np.zeros((n, count))
    for i in range(count):
        mine = count + i
        A[i, mine], A[mine, i], A[mine, mine] = 1.0, 0.3, -0.3
        for other in (i - 1, i + 1):
            if 0 <= other < count:
                A[mine, i] -= 0.4
                A[mine, other] += 0.4
        force[mine, i], push[mine, i] = 1 + 0.2 * i, 1.0
    forces = [f"force{i + 1}" for i in range(count)]
    system = control.ss(
        A,
        np.hstack([force, push]),
        np.eye(count, n),
        0,
        inputs=[*forces, *(f"push{i + 1}" for i in range(count))],
        outputs=[f"position{i + 1}" for i in range(count)],
    )
    return Plant(control.c2d(system, dt), forces)


def regulator(plant: Plant) -> Controller:
    """Q: 4, 5, ... on positions and 1 on speeds; R: 1 on the diagonal, 0.3 elsewhere."""
    m = plant.m
    Q = np.diag(np.concatenate([4.0 + np.arange(m), np.ones(plant.n - m)]))
    weights = Weights(Q, 0.7 * np.eye(m) + 0.3)
    bounds = Bounds(plant, u_min=-1, u_max=1)
    return Controller(plant, weights, bounds, _HORIZON, terminal_set=False)


def noisy_recording(controller: Controller, seed: int, vaf: float, root: float) -> Recording:
    """One recording of 80 s; with noise of coefficient `root` the truth has a VAF of `vaf` %."""
    rng = np.random.default_rng(seed)
    count = controller.plant.E.shape[1]
    push = np.repeat(rng.choice([-0.8, 0.0, 0.8], (_SAMPLES // _HOLD, count)), _HOLD, axis=0)
    return with_noise(controller, push, rng, vaf, root)


def random_recording(seed: int, inputs: int, vaf: float) -> tuple[Controller, Recording]:
    """A random plant of up to five states and random weights; 400 samples, white noise.

    The unbounded command exceeds each limit in a twentieth of the samples.
    """
    rng = np.random.default_rng([seed, inputs])
    n = int(rng.integers(max(2, inputs), 6))
    outputs, pushes = int(rng.integers(1, n + 1)), int(rng.integers(1, inputs + 1))
    A = rng.standard_normal((n, n))
    A *= rng.uniform(0.7, 1.05) / np.max(np.abs(np.linalg.eigvals(A)))
    B, E = rng.standard_normal((n, inputs)), rng.standard_normal((n, pushes))
    C = rng.standard_normal((outputs, n))
    system = control.ss(A, np.hstack([B, E]), C, 0, 0.1)
    plant = Plant(system, system.input_labels[:inputs])
    L = rng.standard_normal((n, n))
    Q = L @ L.T + 0.1 * np.eye(n)
    L = rng.standard_normal((inputs, inputs))
    R = (L @ L.T + 0.3 * np.eye(inputs)) * 10 ** rng.uniform(-1, 1)
    push = np.repeat(rng.choice([-1.0, 0.0, 1.0], (80, pushes)), 5, axis=0)
    drive = scenario(plant, np.zeros(n), disturbance=push)

    def controller(limit: Array) -> Controller:
        bounds = Bounds(plant, u_min=-limit, u_max=limit)
        return Controller(plant, Weights(Q, R), bounds, 6, terminal_set=False)

    unlimited = np.abs(simulate(controller(np.full(inputs, 1e6)), drive).u)
    truth = controller(np.quantile(unlimited, 0.95, axis=0))
    noise = np.random.default_rng([seed, inputs, round(vaf), 0])
    return truth, with_noise(truth, push, noise, vaf, 0.0)


def fit(controller: Controller, trial: Recording) -> Estimate:
    """Fit a recording as `impc fit` does, under the true limit."""
    settings = FitSettings(horizon=controller.horizon, u_max=list(controller.bounds.u_max))
    return fit_controller(fit_problem(controller.plant, [trial], settings))


def score(controller: Controller, trial: Recording) -> Scores:
    """Fit a recording and compare the printed gain with the truth."""
    estimate = gain_estimate(fit(controller, trial))
    found, error = estimate.covariance, estimate.K - controller.K
    return Scores(
        np.where(np.ravel(found.individually_identified), np.ravel(error / found.entries), np.nan),
        np.where(found.identified, found.along(error) / found.deviations, np.nan),
        np.ravel(error / controller.K),
    )


def score_carts(seed: int, inputs: int, vaf: float, root: float) -> Scores:
    """`score` of one recording of `inputs` carts."""
    controller = regulator(carts(inputs))
    return score(controller, noisy_recording(controller, seed, vaf, root))


def _score_random(seed: int, inputs: int, vaf: float, root: float) -> Scores:
    """`score` of one random plant, whose noise is white."""
    assert root == 0
    return score(*random_recording(seed, inputs, vaf))


def shares(scores: Array) -> Array:
    """Coverage of the 95 % intervals of each column; NaN is left out."""
    inside = np.where(np.isnan(scores), np.nan, np.abs(scores) <= TWO_SIDED)
    return np.asarray(np.nanmean(inside, axis=0))


def _range(scores: Array) -> str:
    """Smallest, largest and mean share of columns identified in a quarter of the recordings."""
    often = np.mean(np.isfinite(scores), axis=0) >= 0.25
    if not np.any(often):
        return "none identified"
    percent = 100 * shares(scores[:, often])
    return f"{np.min(percent):.1f} to {np.max(percent):.1f}, mean {np.mean(percent):.1f}"


def main() -> None:
    """Print a row for each number of inputs, VAF and noise coefficient."""
    parser = argparse.ArgumentParser(description="Coverage of the intervals that a fit prints.")
    parser.add_argument("--recordings", type=int, default=200)
    parser.add_argument("--inputs", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--vaf", type=float, nargs="+", default=[90.0, 70.0])
    parser.add_argument("--random", action="store_true", help="random plants, white noise")
    parser.add_argument("--roots", type=float, nargs="+", default=[0.0, 0.8])
    given = parser.parse_args()
    one, roots = (_score_random, [0.0]) if given.random else (score_carts, given.roots)
    rows = []
    for inputs, vaf, root in itertools.product(given.inputs, given.vaf, roots):
        study = functools.partial(one, inputs=inputs, vaf=vaf, root=root)
        found = each(study, range(given.recordings))
        if given.random:  # Plants of several sizes have one column together
            entries, directions, bias = (
                np.concatenate(a)[:, None] for a in zip(*found, strict=True)
            )
        else:
            entries, directions, bias = (np.array(a) for a in zip(*found, strict=True))
        identified = 100 * np.mean(np.isfinite(directions))
        cells = [_range(entries), _range(directions), f"{identified:.0f}"]
        first = "" if given.random else f"{100 * np.median(bias[:, 0]):+.1f}"
        rows.append([f"{inputs}", f"{vaf:g}", f"{root:g}", *cells, first])
        print(*rows[-1], sep=" | ", flush=True)
    head = "inputs,VAF %,root,entries of K %,directions %,identified %,bias of K11 %"
    print(markdown(head.split(","), rows))


if __name__ == "__main__":
    main()
