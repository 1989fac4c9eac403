"""Random problems for the tests. Each is made from a seed that the test prints or names."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import control
import numpy as np
import scipy.optimize

from impc.plant import Plant, as_plant

if TYPE_CHECKING:
    from collections.abc import Callable


def nelder_mead(objective: Callable[[Any], float], start: np.ndarray, budget: int) -> float:
    """The least value that a derivative-free search finds: an oracle for the others."""
    options: Any = {"maxfev": budget, "xatol": 1e-9, "fatol": 1e-12}
    minimize: Any = scipy.optimize.minimize  # its stubs do not know the options of each method
    return float(minimize(objective, start, method="Nelder-Mead", options=options).fun)


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


def easier_seat(configuration: str) -> str:
    """The seat's TOML with six states for ten and a horizon of 4 for 20: a fit in a tenth."""
    fewer = configuration.replace("[plant]", "[plant]\ndelay_order = 1")
    return fewer.replace("horizon = 20", "horizon = 4")
