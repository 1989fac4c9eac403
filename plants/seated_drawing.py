"""Lines of a seated person in the frontal plane, seen from behind.

Lengths follow from l12 and l2 of the plant's parameters. Proportions of trunk and head are those of
a man, and the height and breadth of the seat are chosen.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from plants._checks import Array
from plants.seated_parameters import SeatedBalanceParameters

# Seat above its pivot, half its breadth, and size of the mark of the pivot, m.
_SEAT, _BREADTH, _MARK = 0.05, 0.25, 0.06
# Neck, shoulders, half their breadth, and centre and radius of the head, in multiples of l2: trunk
# and head of a man of de Leva 1996 (`plants.anthropometry`).
_NECK, _SHOULDERS, _BROAD, _HEAD, _RADIUS = 1.66, 1.5, 0.75, 2.1, 0.36
_ROUND = np.linspace(0.0, 2.0 * np.pi, 9)


def seated_lines(parameters: SeatedBalanceParameters, state: Array) -> list[Array]:
    """Seat, pivot, lower body, trunk, shoulders and head (points, 2) in m at a `state`.

    The pivot is at (0, 0); x is to the right of the person, y up.
    """
    (joint,) = _turned(state[0], [0.0], [parameters.l12])

    def upper(x: ArrayLike, y: ArrayLike) -> Array:
        return np.asarray(joint + parameters.l2 * _turned(state[1], x, y))

    return [
        _turned(state[0], [-_BREADTH, _BREADTH], [_SEAT, _SEAT]),
        np.array([[-_MARK, -2 * _MARK], [0.0, 0.0], [_MARK, -2 * _MARK]]),
        np.array([[0.0, 0.0], joint]),
        upper([0.0, 0.0], [0.0, _NECK]),
        upper([-_BROAD, _BROAD], [_SHOULDERS, _SHOULDERS]),
        upper(_RADIUS * np.sin(_ROUND), _HEAD + _RADIUS * np.cos(_ROUND)),
    ]


def _turned(angle: float, x: ArrayLike, y: ArrayLike) -> Array:
    """Points (points, 2) after a turn that takes what is up to the right."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.asarray(np.column_stack([x, y]) @ [[cos, -sin], [sin, cos]])
