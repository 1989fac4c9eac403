"""Figures of a reliability study."""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from impc.reporting import style
from impc.reporting.document import Draw
from impc.reporting.rendering import sentence_case
from impc.studies.reliability.analysis import Reliability, Trials
from impc.studies.reliability.verdict import BANDS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LINES = ((style.BLUE, "-"), (style.VERMILLION, "--"), (style.GREEN, ":"), (style.INK, "-."))


def reliability_figures(trials: Trials, result: Reliability) -> dict[str, Draw]:
    """Functions that draw the figures, by name; some are written to files only."""
    person, visit, condition = result.subjects[0], result.visits[0], result.conditions[0]
    visits = {f"visit {one}": (person, one, condition) for one in result.visits}
    people = {f"subject {one}": (one, visit, condition) for one in result.subjects}
    found: dict[str, Draw] = {
        "trial": partial(_trial, trials, result),
        "transfer-visits": partial(_responses, trials, result, visits),
        "transfer-subjects": partial(_responses, trials, result, people),
    }
    if result.known:
        found["icc"] = partial(_icc, result)
        found["bland-altman"] = partial(_bland_altman, result)
    return found


def _icc(result: Reliability) -> Figure:
    """All ICCs with their intervals over the bands from poor to excellent."""
    items = result.known
    figure = style.new_figure(style.HALF, 0.9 + 0.29 * len(items))
    ax, labels, name = figure.subplots(), [], ""
    least = -0.5 if min(item.icc.low for item in items) < 0 else 0.0
    ends = [least, *(most for most, _ in BANDS[:-1]), 1.0]
    for place, (low, high) in enumerate(pairwise(ends)):
        if place % 2 == 0:
            ax.axvspan(low, high, color=style.RULE, alpha=0.55, linewidth=0, zorder=0)
        ax.text((max(low, 0.0) + high) / 2, -0.9, BANDS[place][1], ha="center", color=style.MUTED,
                fontsize=10)  # fmt: skip
    for at, item in enumerate(items):
        color, marker = (style.BLUE, "o") if item.measure == "rms" else (style.MUTED, "s")
        value, low, high = np.clip(item.icc[:3], least, 1.0)
        ax.plot([low, high], [at, at], color=color, linewidth=1.8)
        ax.plot(value, at, marker, color=color)
        before, name = name, item.name
        labels.append(item.condition if name == before else f"{name}, {item.condition}".strip(", "))
    ax.set_yticks(range(len(labels)), labels)
    ax.set(ylim=(len(items) - 0.4, -1.3), xlim=(least, 1.0))
    ax.set_xlabel("ICC between visits, with its 95 % interval (0 to 1)", loc="left")
    ax.xaxis.set_label_position("top")
    ax.tick_params(axis="y", length=0)
    return figure


def _bland_altman(result: Reliability) -> Figure:
    """Difference of last and first visit over their mean, one dot per person."""
    items = [item for item in result.known if item.measure == "rms"]
    columns = max(len(result.conditions), 2)
    rows = -(-len(items) // columns)
    figure = style.new_figure(style.WIDE, 0.5 + 1.7 * rows)
    axes = np.ravel(figure.subplots(rows, columns, squeeze=False, sharey="row"))
    for ax in axes[len(items) :]:
        ax.set_visible(False)
    for ax, item in zip(axes, items, strict=False):
        first, last = item.scores[:, 0], item.scores[:, -1]
        mean, reach = float(np.nanmean(last - first)), 1.96 * np.nanstd(last - first, ddof=1)
        style.strip(ax, f"{item.name}, {item.condition} ({item.unit})")
        ax.axhspan(mean - reach, mean + reach, color=style.RULE, alpha=0.6, linewidth=0, zorder=0)
        ax.axhline(mean, color=style.INK, linewidth=1.0)
        ax.plot((first + last) / 2, last - first, "o", color=style.BLUE, markersize=4)
        ax.set_xlabel(f"Mean of both visits ({item.unit})")
    return figure


def _trial(trials: Trials, result: Reliability) -> Figure:
    """Perturbation and outputs of one trial over time, and their power spectra."""
    torque, outputs = next(iter(trials.cells.values()))[0]
    signals = [("perturbation torque", torque, "N m")]
    for name, values in zip(trials.outputs.values(), outputs.T, strict=True):
        signals.append((name, values, trials.unit))
    figure = style.new_figure(style.WIDE, 0.5 + 1.5 * len(signals))
    axes = figure.subplots(len(signals), 2, squeeze=False, sharex="col")
    time = np.arange(len(torque)) / trials.rate
    for (left, right), (name, values, unit) in zip(axes, signals, strict=True):
        style.strip(left, f"{sentence_case(name)} ({unit})")
        left.plot(time, values, color=style.BLUE, linewidth=1.0)
        frequency, power = scipy.signal.periodogram(values, trials.rate, detrend=False)
        inside = result.band.excited[result.band.excited < len(power)]
        right.set_title(f"Power of {name} (({unit})²/Hz)")
        band = result.band
        right.axvspan(band.low, band.high, color=style.FORBIDDEN, linewidth=0, zorder=0)
        right.loglog(frequency[inside], power[inside], ".-", color=style.BLUE, linewidth=0.6)
        style.plain_log(right.xaxis, right.yaxis)
    axes[-1, -1].set_xlabel("Frequency (Hz)")
    axes[-1, 0].set_xlabel("Time (s)")
    return figure


def _responses(
    trials: Trials, result: Reliability, cells: dict[str, tuple[str, str, str]]
) -> Figure:
    """Magnitude and phase of the averaged responses of up to four cells."""
    outputs = list(trials.outputs.values())
    figure = style.new_figure(style.WIDE, 3.4)
    axes = figure.subplots(2, len(outputs), sharex=True, squeeze=False)
    for (color, line), (label, key) in zip(_LINES, cells.items(), strict=False):
        found = result.responses.get(key)
        if found is None:
            continue
        look: Any = {"color": color, "linestyle": line, "label": label}
        for index, (above, below) in enumerate(axes.T):
            response, seen = found.response[:, index], found.coherence[:, index]
            # Phase only above the coherence that chance alone reaches in 5 %.
            clear = seen >= 1 - 0.05 ** (1 / max(len(trials.cells[key]) - 1, 1e-9))
            phase = np.full(len(response), np.nan)
            phase[clear] = np.degrees(np.unwrap(np.angle(response[clear])))
            above.loglog(found.frequency, np.abs(response), **look)
            below.semilogx(found.frequency, phase, **look)
    for (above, below), name in zip(axes.T, outputs, strict=True):
        style.plain_log(above.xaxis, above.yaxis)
        above.set_title(f"{sentence_case(name)}, magnitude ({trials.unit}/(N m))")
        below.set_title("Phase (°)")
        below.set_xlabel("Frequency (Hz)")
    axes[0, 0].legend(loc="lower left")
    return figure
