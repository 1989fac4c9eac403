"""Coverage of gain intervals with white and with autocorrelated residuals.

A cart on a falling track, |force| <= 1 and at its limit in 7 % of the samples, is pushed at random
for 75 s. Its position is recorded with noise of a fifth of its size, white or first-order (0.9).
Each recording gives two intervals of the gain: for white residuals (Cramér-Rao), and for the
estimated autocorrelation (sandwich). Results: experiments/coverage.md.

    python -m experiments.coverage --recordings 400
"""

from __future__ import annotations

import argparse
import functools
from concurrent.futures import ProcessPoolExecutor

import control
import numpy as np
import scipy.signal
from tqdm import tqdm

from impc.arrays import Array
from impc.assess.covariance import gain_covariance
from impc.assess.long_run_covariance import residual_noise, white_noise
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.feasibility import require_complete
from impc.control.simulation import scenario
from impc.inverse.search import fit_gain
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.weights import Weights
from impc.studies.fit.asked import fit_problem
from impc.studies.fit.settings import FitSettings

__all__ = ["cart", "covered", "true_controller"]

_SAMPLES = 1500
_NOISE = 0.2
_HORIZON = 10
_SETTINGS = FitSettings(horizon=_HORIZON, u_max=1.0)


def cart(dt: float = 0.05) -> Plant:
    """Cart on a falling track: states position and speed, command force, disturbance push."""
    A, B = [[0.0, 1.0], [0.5, -0.3]], [[0.0, 0.0], [1.0, 1.0]]
    system = control.ss(A, B, [[1.0, 0.0]], 0, inputs=["force", "push"], outputs=["position"])
    return Plant(control.c2d(system, dt), ["force"])


def true_controller() -> Controller:
    """True controller, with Q = diag(4, 1) and R = 1."""
    plant = cart()
    bounds = Bounds(plant, u_min=-1, u_max=1)
    weights = Weights(np.diag([4.0, 1.0]), 1)
    return Controller(plant, weights, bounds, _HORIZON, terminal_set=False)


def noisy_trial(seed: int, root: float) -> Recording:
    """One recording with first-order noise of coefficient `root` and the same size for each."""
    rng, controller = np.random.default_rng(seed), true_controller()
    push = np.repeat(rng.choice([-0.85, 0.0, 0.85], _SAMPLES // 10), 10)
    drive = scenario(controller.plant, np.zeros(2), disturbance=push)
    run = require_complete(controller, simulate(controller, drive))
    clean = (run.x @ controller.plant.C.T)[:_SAMPLES]
    white = rng.standard_normal((_SAMPLES + 500, 1))
    noise = scipy.signal.lfilter([np.sqrt(1 - root**2)], [1.0, -root], white, axis=0)[500:]
    size = _NOISE * np.sqrt(np.mean(clean**2))
    return Recording(controller.plant, clean + size * noise, push)


def covered(seed: int, root: float) -> Array:
    """Error over standard error, shape (2, n): Cramér-Rao, then sandwich."""
    problem = fit_problem(cart(), [noisy_trial(seed, root)], _SETTINGS)
    fit = fit_gain(problem)
    error = fit.K - true_controller().K
    rows = [
        np.ravel(error / gain_covariance(fit.problem, fit.K, fit.S, colour).entries)
        for colour in (white_noise, residual_noise)
    ]
    return np.array(rows)


def main() -> None:
    """Print the share of recordings whose interval covers the true entry."""
    parser = argparse.ArgumentParser(description="Coverage of 95 % intervals of the gain.")
    parser.add_argument("--recordings", type=int, default=400)
    count = parser.parse_args().recordings
    for root in (0.0, 0.9):
        with ProcessPoolExecutor(2) as pool:
            found = pool.map(functools.partial(covered, root=root), range(count), chunksize=8)
            scores = np.array(list(tqdm(found, total=count, desc=f"root {root:g}", disable=None)))
        print(f"\nnoise of root {root:g}, {count} recordings (seeds 0 to {count - 1})")
        for row, name in enumerate(("Cramér-Rao", "sandwich")):
            shares = 100 * np.mean(np.abs(scores[:, row]) <= 1.96, axis=0)
            shown = "  ".join(f"K{i + 1}: {share:5.1f} %" for i, share in enumerate(shares))
            print(f"  {name:<12} {shown}")


if __name__ == "__main__":
    main()
