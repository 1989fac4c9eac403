"""The example that most tests share."""

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
