"""Stabilise the delayed seat by feedback of angles and rates only, K = [K_4, 0] of Eq. (3.20).

Differential evolution from several seeds minimises the spectral radius of A - BK over four gains of
either sign, up to ten times the true ones. Results: experiments/coverage.md.

    python -m experiments.four_gains
"""

from __future__ import annotations

import numpy as np
import scipy.optimize

from experiments.benchmarks.workloads import seat
from impc.arrays import Array


def main() -> None:
    """Print the smallest spectral radius and its gains for each seed."""
    law = seat(1, 1.0).controller
    plant, truth = law.plant, np.abs(np.array(law.K)[0, :4])

    def radius(scaled: Array) -> float:
        gain = np.append(scaled * truth, np.zeros(plant.n - 4))[None]
        return float(np.max(np.abs(np.linalg.eigvals(plant.A - plant.B @ gain))))

    for seed in range(4):
        bounds = scipy.optimize.Bounds([-10] * 4, [10] * 4)
        found = scipy.optimize.differential_evolution(
            radius, bounds, seed=seed, maxiter=600, popsize=20, tol=1e-8
        )
        gains = ", ".join(f"{value:.0f}" for value in found.x * truth)
        print(f"seed {seed}: smallest spectral radius {found.fun:.4f} at K_4 = [{gains}]")


if __name__ == "__main__":
    main()
