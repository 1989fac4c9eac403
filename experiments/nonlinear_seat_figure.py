"""Figure of experiments/nonlinear_seat.md: torque by tilt, error of the fitted gain by angle."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.reporting.style import BLUE, VERMILLION, new_figure, page_style, render

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from experiments.nonlinear_seat import Amplitude
    from impc.arrays import Array

__all__ = ["seat_figure"]


def seat_figure(tilts: Array, from_rest: Mapping[str, Array], people: Sequence[Amplitude]) -> bytes:
    """Draw the PNG; `tilts` in degrees, `from_rest` maps posture to `first_torques`."""
    with page_style():
        figure = new_figure(3.5, 4.6)
        above, below = figure.subplots(2, 1)
        marks = (("o", "-", BLUE), ("s", "--", VERMILLION))
        for (name, torques), (marker, line, color) in zip(from_rest.items(), marks, strict=True):
            share = 100 * np.abs(torques[:, 0] / torques[:, 1] - 1)
            above.plot(tilts, share, marker=marker, linestyle=line, color=color, label=name)
        above.set_xlabel("tilt from rest (deg)")
        above.set_ylabel("difference of the\nfirst torque (%)")
        above.set_ylim(0, None)
        above.legend(loc="upper left")
        angles = [np.degrees(one.angle) for one in people]
        errors = [
            ("gain: largest error of four entries", [one.fitted.error for one in people]),
            ("torque by that gain", [one.fitted.torque for one in people]),
        ]
        for (name, values), (marker, line, color) in zip(errors, marks, strict=True):
            below.plot(
                angles,
                100 * np.array(values),
                marker=marker,
                linestyle=line,
                color=color,
                label=name,
            )
        below.set_xlabel("largest angle of the recording (deg)")
        below.set_ylabel("error of the\nusual fit (%)")
        below.set_ylim(0, 140 * max(one.fitted.error for one in people))  # room for the legend
        below.legend(loc="upper left")
        return render(figure, "png")
