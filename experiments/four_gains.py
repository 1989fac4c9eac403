"""Stabilise the delayed seat by feedback of angles and rates only, K = [K_4, 0] of Eq. (3.20).

Differential evolution from several seeds minimises the spectral radius of A - BK over four gains of
either sign, up to ten times the true ones. Results: experiments/coverage.md.

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
    """Smallest spectral radius found, and its four gains."""
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
    """Print the result of each seed."""
    for seed in range(4):
        radius, gains = least_radius(seed)
        shown = ", ".join(f"{value:.0f}" for value in gains)
        print(f"seed {seed}: smallest spectral radius {radius:.4f} at K_4 = [{shown}]")


if __name__ == "__main__":
    main()
