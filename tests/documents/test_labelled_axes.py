"""The check of labels sees what is missing."""

from __future__ import annotations

import pytest

from impc.reporting.style import new_figure
from tests.labelled_axes import require_labels


def test_units_are_asked_for() -> None:
    figure = new_figure(3.0, 2.0)
    ax = figure.subplots()
    ax.plot([0, 1], [0, 1])
    with pytest.raises(AssertionError, match="no label"):
        require_labels(figure)
    ax.set_xlabel("time (s)")
    ax.set_ylabel("angle")
    with pytest.raises(AssertionError, match="'angle' does not end in a unit"):
        require_labels(figure)
    ax.set_ylabel("angle (deg)")
    require_labels(figure)


def test_names_need_no_unit() -> None:
    figure = new_figure(3.0, 2.0)
    ax = figure.subplots()
    ax.plot([0, 1], [0, 1])
    ax.set_xticks([0, 1], ["first", "second"])
    ax.set_ylabel("VAF (%)")
    require_labels(figure)
