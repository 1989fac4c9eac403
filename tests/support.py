"""Random problems for the tests. Each is made from a seed that the test prints or names."""

from __future__ import annotations

import control
import numpy as np

from impc.plant import Plant, as_plant


def random_plant(rng: np.random.Generator, n: int, m: int, radius: float, d: int = 0) -> Plant:
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
    return as_plant(system, names)


def random_weights(rng: np.random.Generator, size: int) -> np.ndarray:
    """A random positive definite matrix of moderate condition."""
    factor = rng.normal(size=(size, size))
    return factor @ factor.T + 0.1 * np.eye(size)
