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

import control
import numpy as np

from experiments.driver import each, with_noise
from experiments.summary import markdown
from impc.arrays import Array
from impc.assess.covariance import gain_covariance
from impc.assess.long_run_covariance import residual_noise, white_noise
from impc.control.controller import Controller
from impc.inverse.search import fit_gain
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.weights import Weights
from impc.studies.fit.asked import fit_problem
from impc.studies.fit.settings import FitSettings

__all__ = ["cart", "covered", "true_controller"]

_SAMPLES, _HORIZON = 1500, 10
# The noise has a fifth of the size of the position.
_VAF = 100 / (1 + 0.2**2)


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
    rng = np.random.default_rng(seed)
    push = np.repeat(rng.choice([-0.85, 0.0, 0.85], _SAMPLES // 10), 10)
    return with_noise(true_controller(), push, rng, _VAF, root)


def covered(seed: int, root: float) -> Array:
    """Error over standard error, shape (2, n): Cramér-Rao, then sandwich."""
    settings = FitSettings(horizon=_HORIZON, u_max=1.0)
    fit = fit_gain(fit_problem(cart(), [noisy_trial(seed, root)], settings))
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
    count, rows = parser.parse_args().recordings, []
    for root in (0.0, 0.9):
        scores = np.array(each(functools.partial(covered, root=root), range(count)))
        shares = 100 * np.mean(np.abs(scores) <= 1.96, axis=0)
        for name, row in zip(("Cramér-Rao", "sandwich"), shares, strict=True):
            rows.append([f"{root:g}", name, *(f"{share:.1f}" for share in row)])
    print(markdown(["root of the noise", "standard errors", "K1, %", "K2, %"], rows))


if __name__ == "__main__":
    main()
