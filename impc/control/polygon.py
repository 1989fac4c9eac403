"""A terminal set (docs/theory.md, section 3) as a polygon, and as a `pytope.Polytope`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import HalfspaceIntersection

from impc.errors import InputError
from impc.extras import optional

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.control.terminal_set import TerminalSet


def polygon(terminal: TerminalSet) -> Array:
    """Corners (v, 2) of a bounded set of two states, counter-clockwise, in the units of x."""
    n = terminal.H.shape[1]
    if n != 2:
        raise InputError("terminal set", f"has {n} states", "corners are drawn for two")
    rows = terminal.H / terminal.h[:, None]
    scale = np.max(np.abs(rows), axis=0, initial=0.0)
    rows = rows / np.where(scale > 0, scale, 1.0)
    # Bounded: the normals leave no half plane free, so no gap between neighbours reaches pi.
    angles = np.sort(np.arctan2(rows[:, 1], rows[:, 0]))
    gaps = np.diff(angles, append=angles[:1] + 2 * np.pi)
    if np.max(gaps, initial=0.0 if len(gaps) else np.inf) >= np.pi - 1e-9:
        remedy = "bound the states or inputs that show that direction, from both sides"
        raise InputError("terminal set", "is unbounded and has no polygon", remedy)
    halves = np.column_stack([rows, -np.ones(len(rows))])
    corners = HalfspaceIntersection(halves, np.zeros(2)).intersections
    order = np.argsort(np.arctan2(corners[:, 1], corners[:, 0]))
    return np.asarray(corners[order] / scale)


def as_pytope(terminal: TerminalSet) -> Any:
    """Return the set as a `pytope.Polytope` in half-space form; pytope finds corners when asked."""
    pytope = optional("pytope", "terminal set")
    if not len(terminal.h):
        raise InputError("terminal set", "is the whole space", "give at least one bound")
    # pytope 0.0.4 squeezes the right side to a scalar when there is one row: state it twice.
    twice = slice(None) if len(terminal.h) > 1 else [0, 0]
    return pytope.Polytope(np.array(terminal.H[twice]), np.array(terminal.h[twice]))
