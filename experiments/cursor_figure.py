"""Figure of the cursor experiment: trials, and VAF, gain and cost weight by blur."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from experiments.cursor_data import ARCMIN_A_PIXEL, RATE
from impc.reporting.style import (
    BLUE,
    GREEN,
    HALF,
    INK,
    VERMILLION,
    new_figure,
    page_style,
    render,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes

    from experiments.cursor_tracking import ConditionResult

__all__ = ["cursor_figure"]


def cursor_figure(results: Sequence[ConditionResult]) -> dict[str, bytes]:
    """Draw ``cursor-tracking.png`` and ``.pdf``."""
    with page_style():
        figure = new_figure(HALF, 5.6)
        axes = figure.subplot_mosaic([["A", "A"], ["B", "B"], ["C", "D"]])
        for letter, item in (("A", results[0]), ("B", results[-1])):
            _trial(axes[letter], item, letter)
        axes["A"].legend(ncols=3, loc="upper left", bbox_to_anchor=(0, 1.32))
        _vaf(axes["C"], results)
        _cost_weights(axes["D"], results)
        return {f"cursor-tracking.{kind}": render(figure, kind) for kind in ("png", "pdf")}


def _trial(axes: Axes, item: ConditionResult, letter: str) -> None:
    time = np.arange(len(item.recorded)) / RATE
    axes.plot(time, item.target, color="#9A9A9A", linewidth=0.9, label="target")
    axes.plot(time, item.recorded, color=INK, linewidth=1.0, label="cursor, recorded")
    axes.plot(
        time,
        item.simulated,
        color=VERMILLION,
        linestyle="--",
        linewidth=1.2,
        label="cursor, simulated from the target (held-out trial)",
    )
    blur = item.blur * ARCMIN_A_PIXEL
    axes.set_title(f"({letter}) blur {item.blur:.0f} px ({blur:.0f} arcmin)", loc="right")
    axes.set_xlabel("time (s)")
    axes.set_ylabel("position (px)")
    axes.set_xlim(0, time[-1])


def _vaf(axes: Axes, results: Sequence[ConditionResult]) -> None:
    blur = [item.blur for item in results]
    for item in results:
        axes.plot([item.blur] * item.trials, item.vaf_out, ".", color="#BBBBBB", markersize=3)
    axes.plot(
        blur,
        [np.mean(item.vaf_out) for item in results],
        "o-",
        color=BLUE,
        label="inverse MPC, held-out trials",
    )
    axes.plot(
        blur,
        [np.mean(item.baseline_out) for item in results],
        "s--",
        color=INK,
        markerfacecolor="white",
        label="delayed feedback, held-out trials",
    )
    axes.set_ylim(0, 100)
    axes.set_xlabel("blur (px)")
    axes.set_ylabel("VAF (%)")
    axes.set_title("(C)", loc="left")
    axes.legend(loc="lower left")


def _cost_weights(axes: Axes, results: Sequence[ConditionResult]) -> None:
    """Gain and cost weight; all weights with the gain have the same one, so it has no band."""
    blur = [item.blur for item in results]
    axes.plot(
        blur,
        [item.weight_of_error for item in results],
        "D:",
        color=GREEN,
        markerfacecolor="white",
        label="cost weight of the error (s$^{-4}$), R = 1",
    )
    axes.plot(
        blur,
        [item.gain[0] for item in results],
        "o-",
        color=BLUE,
        label="gain of the error (s$^{-2}$)",
    )
    axes.set_yscale("log")
    axes.set_ylim(1, 1e9)
    axes.set_xlabel("blur (px)")
    axes.set_ylabel("gain, cost weight (-)")
    axes.set_title("(D)", loc="left")
    axes.legend(loc="upper right")
