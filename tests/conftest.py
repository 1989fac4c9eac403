"""Shared plants and random problems. Every random problem is made from a printed seed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import control
import numpy as np
import pytest

from impc.bounds import box_bounds
from impc.plant import as_plant

if TYPE_CHECKING:
    from impc.bounds import Bounds
    from impc.plant import Plant


@pytest.fixture
def example_plant() -> Plant:
    """The example of section 3.4: unstable, two states, one input."""
    return as_plant(control.ss([[2, -1], [1, 0.2]], [[1], [0]], np.eye(2), 0, True))


@pytest.fixture
def example_bounds(example_plant: Plant) -> Bounds:
    """|u| <= 1."""
    return box_bounds(example_plant, u_min=-1, u_max=1)


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
