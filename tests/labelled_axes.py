"""Every axis of every figure says what it is, and in which unit.

`tests/conftest.py` puts `require_labels` in front of `Figure.savefig`, the one way in which this
package writes figures: whatever figure a test draws is looked at.
"""

from __future__ import annotations

import re
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

__all__ = ["require_labels"]

_UNIT = re.compile(r"\([^()]*(\([^()]*\)[^()]*)*\)$")
_NUMBER = re.compile(r"^(\\mathdefault|\\times|[-−+\d.,eE×^{}$ ])*$")


def require_labels(figure: Figure) -> None:
    """Raise where an axis with numbers has no label, or a label does not end in its unit."""
    for ax in figure.axes:
        if not ax.get_visible() or not ax.axison:
            continue
        for which in ("x", "y"):
            label = _label(ax, which)
            if label is None and _has_names(ax, which):
                continue
            assert label, f"an axis {which} of {ax} has no label: {_title(ax)}"
            assert _UNIT.search(label), f"{label!r} does not end in a unit such as (s) or (-)"


def _label(ax: Axes, which: str) -> str | None:
    """The axis' own label, or that of an axis which shares it."""
    shared: Any = getattr(ax, f"get_shared_{which}_axes")()
    for other in [ax, *shared.get_siblings(ax)]:
        text: str = getattr(other, f"get_{which}label")()
        if text:
            return text
    above = which == "y" or _has_names(ax, "y")  # a panel is named above itself
    return _title(ax) or None if above else None


def _has_names(ax: Axes, which: str) -> bool:
    """Whether ticks are words, or there are none."""
    axis = getattr(ax, f"{which}axis")
    words = [tick.get_text() for tick in axis.get_ticklabels() if tick.get_visible()]
    return not any(word and _NUMBER.match(word) for word in words) or not axis.get_visible()


def _title(ax: Axes) -> str:
    return ax.get_title() or ax.get_title(loc="left")
