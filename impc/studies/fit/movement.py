"""Recorded and modelled body of one trial over time, as the plant draws it (`Plant.drawing`).

start, step   time of the first frame, and between frames, s
frames        SVG paths of the recorded and of the modelled body; empty if it is unknown
limit         whether the command is at its limit, for every frame
"""

from __future__ import annotations

import numpy as np

from impc.arrays import Array
from impc.assess.variance_accounted_for import at_limit
from impc.errors import PlantError
from impc.model.plant import Plant
from impc.reporting.document import Quiet, Section
from impc.reporting.finding import Moving
from impc.reporting.rendering import sentence_case
from impc.reporting.shown_units import signal_name
from impc.studies.fit.figures import shown_window
from impc.studies.fit.result import FitResult, shown_trials, trial_name
from impc.studies.methods_table import until_its_end

# Longest part in s, most frames per second, and most numbers on a page: 27,000 are 0.12 MB.
_LONGEST, _RATE, _MOST = 30.0, 25.0, 27_000
# A movement below this share of the body's size is drawn so many times as large.
_SMALL, _TIMES = 0.15, 3


def movement_section(result: FitResult) -> list[Section]:
    """The section with the moving body; none if the plant has no drawing."""
    try:
        block = _moving(result)
    except PlantError as error:  # in a state that the model reaches
        block = Quiet(f"Not available: {error}.")
    return [Section("Recorded and modelled movement", [block], "Movement")] if block else []


def _moving(result: FitResult) -> Moving | Quiet | None:
    fit, index, plant = result.inverse_mpc, shown_trials(result)[0], result.given.plant
    problem, run, dt = fit.estimate.problem, fit.runs[index], plant.dt
    size = sum(line.shape[1] for line in plant.drawing(np.zeros((1, plant.n))))
    if not size:
        return None
    y, bounds = problem.recordings[index].corrected, problem.bounds
    count = min(round(_LONGEST / dt), len(y))
    first = min(shown_window(fit, index).start, len(y) - count)
    stride = max(round(1 / (_RATE * dt)), -(-4 * size * count // _MOST), 1)
    at = np.arange(first, first + count, stride)
    # The recorded body has the recorded outputs, and is otherwise at rest.
    states = np.vstack([np.zeros(plant.n), y[at] @ np.linalg.pinv(plant.C).T, run.x[at]])
    (_, *paths), box, times = _paths(plant, states)
    limit = at_limit(until_its_end(plant, run)[1][at], bounds.u_min, bounds.u_max).tolist()
    instants = {0: "Start", int(np.argmax(np.nansum(y[at] ** 2, axis=1))): "Largest movement"}
    if any(limit):
        instants[limit.index(True)] = "Command at its limit"
    name, positive = signal_name(plant, plant.outputs[0]), plant.direction(plant.outputs[0])
    caption = (
        f"{trial_name(result, index)}, {first * dt:.4g} to {at[-1] * dt:.4g} s. Grey: recorded; "
        f"blue: model{'; orange: at the limit' if any(limit) else ''}."
        f"{f' All movements are drawn {times} times as large.' if times > 1 else ''}"
        f"{f' {sentence_case(name)} is positive {positive}.' if positive else ''}"
    )
    frames = [paths[: len(at)], paths[len(at) :]]
    stills = [(f"{words}, {at[k] * dt:.2f} s", k) for k, words in sorted(instants.items())]
    data = {"start": first * dt, "step": stride * dt, "frames": frames, "limit": limit}
    return Moving(data, box, stills, caption)


def _paths(plant: Plant, states: Array) -> tuple[list[str], str, int]:
    """SVG paths at `states` (frames, n), the first at rest; view box; exaggeration."""
    known, paths, times = np.all(np.isfinite(states), axis=1), [""] * len(states), 1
    points = np.concatenate(lines := plant.drawing(states[known]), axis=1)
    if np.max(np.abs(points - points[0])) < _SMALL * np.ptp(points[0]):
        times = _TIMES
        points = np.concatenate(lines := plant.drawing(times * states[known]), axis=1)
    low, high = np.min(points, axis=(0, 1)), np.max(points, axis=(0, 1))
    scale = 1000 / (np.max(high - low) or 1.0)
    drawn = [np.rint(scale * (line - [low[0], high[1]]) * [1, -1]).astype(int) for line in lines]
    for k, place in enumerate(np.flatnonzero(known)):
        paths[place] = " ".join(f"M {' '.join(map(str, line[k].ravel()))}" for line in drawn)
    width, height = scale * (high - low) + 40
    return paths, f"-20 -20 {width:.0f} {height:.0f}", times
