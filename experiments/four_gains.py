"""Four gains on angles and rates, K = [K_4, 0] of (3.20): do they hold the delayed seat upright.

Searches all of the four-dimensional space of gains for the least spectral radius of A - BK, by
differential evolution from several seeds, with gains of either sign up to ten times the true ones.

    python -m experiments.four_gains
"""

from __future__ import annotations

import numpy as np
import scipy.optimize

import plants
from experiments.benchmarks.workloads import seat
from impc.model.plant import Plant

__all__ = ["least_radius"]


def least_radius(seed: int, reach: float = 10.0) -> tuple[float, list[float]]:
    """Least spectral radius found, and the four gains that have it."""
    plant = Plant(plants.seated_balance_plant(), ["command"])
    truth = np.abs(np.array(seat(1, 1.0).controller.K)[0, :4])

    def radius(scaled: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
        gain = np.zeros((1, plant.n))
        gain[0, :4] = scaled * truth
        return float(np.max(np.abs(np.linalg.eigvals(plant.A - plant.B @ gain))))

    found = scipy.optimize.differential_evolution(
        radius,
        scipy.optimize.Bounds([-reach] * 4, [reach] * 4),
        seed=seed,
        maxiter=600,
        popsize=20,
        tol=1e-8,
    )
    return float(found.fun), [float(value) for value in found.x * truth]


def main() -> None:
    """Print what every seed finds."""
    for seed in range(4):
        radius, gains = least_radius(seed)
        shown = ", ".join(f"{value:.0f}" for value in gains)
        print(f"seed {seed}: least spectral radius {radius:.4f} at K_4 = [{shown}]")


if __name__ == "__main__":
    main()
