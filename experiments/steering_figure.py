"""Frequency response and figure of `experiments.steering`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.reporting.style import BLUE, GREEN, INK, MUTED, VERMILLION, new_figure, page_style, render

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from experiments.steering_page import Case
    from impc.arrays import Array

RATE, PERIOD = 60.0, 1200
#: Least amplitude of a driven frequency relative to the largest.
_DRIVEN = 0.01
_LEGEND = {
    "delayed": "delayed PI, PID",
    "offset-free": "offset-free inverse MPC",
    "output": "output feedback",
}


def spectra(signals: list[Array]) -> NDArray[np.complex128]:
    """Fourier coefficients of each of the last two periods of each trial (pieces, frequencies)."""
    pieces = [part for one in signals for part in np.split(one[-2 * PERIOD :], 2)]
    found = np.fft.rfft(np.array(pieces), axis=1) * 2 / PERIOD
    return np.asarray(found, dtype=np.complex128)


def response(case: Case) -> str:
    """Response of the slider to the disturbance at the sines: recorded and modelled."""
    push = spectra([one[:, 3] for one in case.test])
    power = np.sum(np.abs(push) ** 2, axis=0)
    at = np.flatnonzero(power > _DRIVEN**2 * power.max())
    at = at[at > 0]
    push, power = push[:, at], power[at]
    labels = ["offset-free", "delayed"]
    shown = [one for one in map(case.named, labels) if not one.reason]
    hands = [[one[:, 2] for one in case.test]] + [
        [run[:, 1] for run in one.simulated] for one in shown
    ]
    found: list[NDArray[np.complex128]] = []
    coherence = np.zeros(len(at))
    for hand in hands:
        own = spectra(hand)[:, at]
        across = np.sum(np.conj(push) * own, axis=0)
        if not found:
            coherence = np.abs(across) ** 2 / (power * np.sum(np.abs(own) ** 2, axis=0))
        found.append(-across / power)  # Against the disturbance, so that 1 and 0 degrees are ideal
    head = "".join(f" {one.label}, gain | phase |" for one in shown)
    rows = [
        f"| Hz | recorded, gain | phase | coherence |{head}",
        "|---" * (4 + 2 * len(shown)) + "|",
    ]
    for k, index in enumerate(at):
        cells = [f"{abs(one[k]):.2f} | {np.degrees(np.angle(one[k])):.0f}" for one in found]
        cells.insert(1, f"{coherence[k]:.2f}")
        rows.append(f"| {index * RATE / PERIOD:.2f} | {' | '.join(cells)} |")
    return "\n".join([f"**{case.title}**", "", *rows])


def figure(cases: list[Case]) -> bytes:
    """Held-out VAF of each method per person and plant, with the ceiling."""
    styles = (("delayed", "s", VERMILLION), ("inverse LQR", "x", MUTED), ("inverse MPC", "o", INK))
    more = (("offset-free", "D", BLUE), ("output", "^", GREEN))
    with page_style():
        drawing = new_figure(7.2, 3.8)
        axes = drawing.add_subplot()
        for k, case in enumerate(cases):
            if case.ceiling is not None:
                top, label = case.ceiling[0, 0], "ceiling" if k == 0 else None
                axes.plot([k - 0.4, k + 0.4], [top, top], color=INK, linewidth=1.5, label=label)
            for j, (start, marker, colour) in enumerate((*styles, *more)):
                one, place = case.named(start), k + 0.14 * (j - 2)
                label = _LEGEND.get(start, start) if k == 0 else None
                shown = np.zeros(0) if one.reason else np.clip(one.test[:, 0], 0, 100)
                axes.plot(place + 0 * shown, shown, ".", color=colour, markersize=3, alpha=0.5)
                mean = [np.nan if one.reason else max(one.mean, 0.0)]
                axes.plot([place], mean, marker, color=colour, linestyle="none", label=label)
        axes.set_xticks(range(len(cases)), [case.title for case in cases])
        axes.set_ylabel("held-out VAF of the cursor (%)")
        axes.set_ylim(-3, 100)
        axes.legend(ncols=3, loc="upper center", bbox_to_anchor=(0.5, 1.25))
        return render(drawing, "svg")
