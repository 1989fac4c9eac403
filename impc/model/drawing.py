"""Lines that a plant draws of its body."""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.arrays import Array, finite_array
from impc.errors import PlantError, one_line

if TYPE_CHECKING:
    from collections.abc import Callable

_MOST = 200  # points


def lines_at(draw: Callable[[Array], Any], states: Array) -> tuple[Array, ...]:
    """Lines (samples, points, 2) of a user's function at `states` (samples, n), checked."""
    try:
        each = [
            [finite_array("a line", one, (None, 2)) for one in islice(draw(state), _MOST + 1)]
            for state in states
        ]
        lines = tuple(map(np.stack, zip(*each, strict=True)))
        if not 0 < sum(line.shape[1] for line in lines) <= _MOST:
            raise ValueError(f"it needs 1 to {_MOST} points")
    except Exception as error:  # the function may raise anything
        remedy = "return lines (points, 2), the same points in every state"
        raise PlantError("plant.drawing", f"fails: {one_line(error)}", remedy) from None
    return lines
