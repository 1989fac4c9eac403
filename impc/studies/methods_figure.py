"""Figure that compares methods: unexplained variance and largest command."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array
from impc.assess.assessments import ASSESSMENTS, MethodFit
from impc.reporting import style
from impc.reporting.shown_units import shown_unit, signal_name
from impc.studies.methods_table import method_label

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Smallest unexplained variance that is drawn, %.
_ROUNDING = 1e-6
_MARKERS = ("o", "s", "^", "D", "v")


def explained(fit: MethodFit) -> Array:
    """VAF of each output in left-out trials, or in all trials if none was left out (p,), %."""
    return ASSESSMENTS["held_out_vaf"].find(fit) if len(fit.held_out) else fit.vaf


def unexplained(fit: MethodFit) -> float:
    """Unexplained variance, mean over the outputs, %."""
    return max(100.0 - float(np.mean(explained(fit))), 1e-9)


def first_fall(fit: MethodFit) -> float:
    """Earliest time in s at which a simulation stops; NaN if none does."""
    return float(ASSESSMENTS["first_fall"].find(fit)[0])


def by_score(fits: Sequence[MethodFit]) -> list[MethodFit]:
    """Methods with a gain, highest VAF first; methods whose simulations stop early are last."""

    def rank(fit: MethodFit) -> tuple[bool, float, bool]:
        left = float(np.mean(100 - explained(fit)))
        return np.isnan(left), round(left, 2), fit.name != "inverse_mpc"

    return sorted((fit for fit in fits if fit.estimate.K is not None), key=rank)


def largest_commands(fit: MethodFit) -> tuple[float, float, str]:
    """Largest command, its limit (or infinity) and axis label; several inputs: % of limits."""
    plant, bounds = fit.estimate.problem.plant, fit.bounds
    limits = np.maximum(np.abs(bounds.u_min), np.abs(bounds.u_max))
    limited = np.isfinite(limits)
    if plant.m > 1 and np.any(limited):
        share = float(np.max(100 * fit.largest_input[limited] / limits[limited]))
        return share, 100.0, "Largest command (% of its limit)"
    factor, unit = shown_unit(plant, plant.controls[0])
    label = f"Largest command ({unit})"
    return factor * float(fit.largest_input[0]), factor * float(limits[0]), label


def methods_figure(fits: Sequence[MethodFit]) -> Figure:
    """Unexplained variance of each output (dots, log axis) and largest command (bars)."""
    shown = by_score(fits)
    figure = style.new_figure(style.HALF, 0.9 + 0.42 * len(shown))
    left, right = figure.subplots(1, 2, width_ratios=(1.1, 1))
    left.set_yticks(range(len(shown)), [method_label(fit.name) for fit in shown])
    right.set_yticks([])
    for ax in (left, right):
        ax.set_ylim(len(shown) - 0.4, -0.6)
        ax.tick_params(axis="y", length=0, labelcolor=style.INK)
    _unexplained(left, shown)
    _commands(right, shown)
    if len(shown[0].estimate.problem.plant.outputs) > 1:
        figure.legend(*left.get_legend_handles_labels(), loc="outside lower left", ncols=4)
    return figure


def _colour(fit: MethodFit) -> str:
    return style.BLUE if fit.keeps_bounds else style.MUTED


def _unexplained(ax: Axes, fits: Sequence[MethodFit]) -> None:
    plant = fits[0].estimate.problem.plant
    left = np.array([np.maximum(100 - explained(fit), _ROUNDING) for fit in fits])
    ax.set_xscale("log")
    ax.hlines(range(len(fits)), left.min(axis=1), left.max(axis=1), color=style.RULE, zorder=0)
    for place, (name, marker) in enumerate(zip(plant.outputs, itertools.cycle(_MARKERS))):
        for row, fit in enumerate(fits):
            ax.plot(left[row, place], row, marker, color=_colour(fit), markersize=7)
        ax.plot([], [], marker, color=style.MUTED, label=signal_name(plant, name))
    for row, fit in enumerate(fits):
        fell = first_fall(fit)
        missing = "no prediction" if np.any(np.isnan(left[row])) else ""
        text = missing if np.isnan(fell) else f"stops at {fell:.1f} s"
        ax.text(0.02, row, text, transform=ax.get_yaxis_transform(), va="center", color=style.MUTED)
    style.plain_log(ax.xaxis)
    ax.set_title("Variance not explained (%)", pad=18)


def _commands(ax: Axes, fits: Sequence[MethodFit]) -> None:
    rows = [largest_commands(fit) for fit in fits]
    limit, label = rows[0][1:]
    sizes = {k: row[0] for k, row in enumerate(rows) if np.isnan(first_fall(fits[k]))}
    end = 1.3 * max([*sizes.values(), limit if np.isfinite(limit) else 0.0, 1e-12])
    if np.isfinite(limit):
        ax.axvspan(limit, end, color=style.FORBIDDEN, linewidth=0, zorder=0)
        ax.axvline(limit, color=style.VERMILLION, linewidth=1, linestyle="--")
        side = "left" if limit < end / 2 else "right"
        ax.text(limit if side == "left" else end, -0.55, " beyond the limit", ha=side,
                color=style.VERMILLION, va="bottom", fontsize=10)  # fmt: skip
    for row, size in sizes.items():
        ax.barh(row, size, 0.42, color=_colour(fits[row]), linewidth=0)
        ax.annotate(f"{size:.3g}", (size, row), (5, 0), textcoords="offset points", va="center")
    ax.set_xlim(0, end)
    ax.locator_params(axis="x", nbins=4)
    ax.set_title(label, pad=18)
