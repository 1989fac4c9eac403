"""Columns with clocks of their own, interpolated to the fastest clock over the common span.

The clock of a column is a rising column named as one: in the same struct or group ("tilt.Time" of
"tilt.Data"), with the column's name ("push_time"), or the nearest to the left.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np
import scipy

from impc.arrays import Array, BoolArray
from impc.errors import DataError

_WORDS = {
    *("time", "t", "zeit", "temps", "tiempo", "tempo", "tijd", "tid", "uhrzeit", "timestamp"),
    *("clock", "seconds", "sec", "ms", "msec", "millis", "micros", "us", "elapsed"),
}
_SECONDS = ("s", "sec", "ms", "us")
# Clocks are equal if they differ by less than this part of a step; a value is taken without
# interpolation below the second; an interval of more than the third many steps is a gap.
_SAME, _EXACT, GAP = 1e-2, 1e-3, 1.5
# Longest clock in any unit; least part of its steps that are within half of the usual one.
_LONGEST, _EVEN = 1e30, 0.9
_LOST, _TURN = 3.0, 10.0  # longest step of a counter that wraps, and least number between wraps
_COMMON, _COVERED = 0.1, 0.5  # least part of the longest clock: common, and of a clock that counts
# Noise beside the pulse relative to its height, and longest pulse relative to the recording.
_FLAT, _PULSE = 0.1, 0.5


def named_clock(name: str, unit: str = "") -> bool:
    """Whether a column's unit is a time, or a word of the last part of its name a clock."""
    last = re.split(r"[./]", name)[-1]
    words = re.findall(r"[A-Z]?[^\W\d_A-Z]+|[A-Z]+", last)
    return (
        unit in _SECONDS
        or last.startswith("X_Value")
        or not _WORDS.isdisjoint(map(str.lower, words))
    )


def rising(values: Array) -> Array:
    """`values` (samples,) without the empty or equal ones at the end, if they rise evenly.

    Otherwise empty. Shorter columns of a file are padded with nothing, zeros or their last value.
    """
    time = values[: int(np.isfinite(values).sum())]
    if len(time) > 2 and time[-1] == time[-2]:
        time = time[: 1 + np.max(np.flatnonzero(time != time[-1]), initial=-1)]
    with np.errstate(all="ignore"):  # steps of numbers beyond any clock
        steps = np.diff(time)
        if len(time) < 2 or not (steps > 0).all() or not 1 / _LONGEST < np.ptp(time) < _LONGEST:
            return time[:0]
        even = np.abs(steps - np.median(steps)) < 0.5 * np.median(steps)
    return time if even.mean() > _EVEN else time[:0]


def unwrapped(values: Array, moduli: Sequence[float]) -> tuple[Array, float]:
    """`values` (samples,) continued where they fall by one of the `moduli`, and that modulus or 0.

    Every fall must be that modulus less at most three of the usual steps, which are far shorter.
    """
    known = np.flatnonzero(np.isfinite(values))
    with np.errstate(all="ignore"):
        steps = np.diff(values[known])
        fell = steps < 0
        usual = float(np.median(steps[~fell])) if fell.any() and not fell.all() else 0.0
        low, high = (steps[fell].min(), steps[fell].max()) if usual > 0 else (0.0, 0.0)
        for modulus in moduli if usual > 0 else ():
            close = low + modulus > 0 and high + modulus <= _LOST * usual
            if modulus >= _TURN * usual and close and not _repeats(values[known], fell):
                made = values.copy()
                made[known[1:]] += modulus * np.cumsum(fell)
                return made, modulus
    return values, 0.0


def _repeats(values: Array, fell: BoolArray) -> bool:
    """Whether `values` run through the same numbers after each fall, as the clocks of trials do."""
    first, last = values[1:][fell], values[:-1][fell]
    return bool((first == values[0]).all() and (last == values[-1]).all())


def own_clocks(
    columns: Mapping[str, Array], units: Mapping[str, str], paths: Mapping[str, str] | None = None
) -> dict[str, tuple[str, Array]]:
    """Name and times of the clock of each column; `paths` are full names where they differ."""
    named = [name for name in columns if named_clock(name, units.get(name, ""))]
    times = {name: time for name in named if len(time := rising(columns[name]))}
    full = {name: (paths or {}).get(name, name) for name in columns}
    parents = {name: re.sub(r"[^./]*$", "", full[name]) for name in times}
    places = {name: place for place, name in enumerate(columns)}
    owners: dict[str, str] = {}
    for name in columns if len(times) > 1 else ():
        near = [one for one in times if full[name].startswith(parents[one])]
        near = [one for one in near if len(columns[one]) == len(columns[name])]
        depth = max((len(parents[one]) for one in near), default=0)
        near = [one for one in near if len(parents[one]) == depth]
        alike = [one for one in near if len(name) > 2 and name.lower() in one.lower()]
        left = [one for one in near if places[one] <= places[name]]
        found = [name] if name in near else [*alike[:1], *left[-1:], *near]
        owners |= {name: found[0]} if found else {}
    used = {clock for name, clock in owners.items() if not len(rising(columns[name]))}
    return {name: (clock, times[clock]) for name, clock in owners.items() if clock in used}


@np.errstate(all="ignore")  # starts and values beyond anything measured, refused here or later
def aligned(
    source: str, columns: Mapping[str, Array], clocks: Mapping[str, tuple[str, Array]]
) -> tuple[dict[str, Array], tuple[str, ...]]:
    """Columns at the instants of the fastest of their `clocks` (name, times), and a note.

    A series of another length that covers less than half of the longest one is left as it is.
    """
    times = dict(clocks.values())
    most = max(times.values(), key=np.ptp, default=np.arange(2.0))
    times = {
        name: time
        for name, time in times.items()
        if len(time) == len(most) or np.ptp(time) > _COVERED * np.ptp(most)
    }
    close = _SAME * usual_step(most)
    if all(len(t) == len(most) and np.abs(t - most).max() <= close for t in times.values()):
        return dict(columns), ()
    fastest = min(times, key=lambda name: usual_step(times[name]))
    first = max(float(time[0]) for time in times.values())
    last = min(float(time[-1]) for time in times.values())
    spans = ", ".join(
        f"{name} ({time[0]:g} to {time[-1]:g} by {usual_step(time):.4g})"
        for name, time in times.items()
    )
    if not last - first >= _COMMON * np.ptp(most):
        raise DataError(
            source,
            f"has clocks without a common span: {spans}",
            "save the columns of each in a file of their own, or remove a clock that is not used",
        )
    instants, slack = times[fastest], _EXACT * usual_step(times[fastest])
    instants = instants[(instants >= first - slack) & (instants <= last + slack)]
    made = dict(columns)
    for name, (clock, time) in clocks.items():
        if name in times:
            made[name] = instants
        elif clock in times:
            made[name] = _at(columns[name][: len(time)], time, instants)
    note = f"interpolated to {fastest} from {first:g} to {last:g}; clocks: {spans}"
    return made, (note,)


def _at(values: Array, time: Array, instants: Array) -> Array:
    """`values` (samples,) of `time` at `instants` (Akima); NaN in gaps and at missing samples."""
    finite = np.isfinite(values)
    if finite.sum() < 2:
        return np.full(len(instants), np.nan)
    after = np.clip(np.searchsorted(time, instants), 1, len(time) - 1)
    before, step = after - 1, usual_step(time)
    near = np.where(instants - time[before] < time[after] - instants, before, after)
    known = finite[before] & finite[after] & (time[after] - time[before] <= GAP * step)
    spline = scipy.interpolate.Akima1DInterpolator(time[finite], values[finite], method="makima")
    between = np.where(known, spline(instants), np.nan)
    exact = np.abs(time[near] - instants) <= _EXACT * step
    return np.asarray(np.where(exact, values[near], between), dtype=np.float64)


def usual_step(time: Array) -> float:
    """Mean of the steps of a rising clock that are not gaps."""
    steps = np.diff(time)
    return float(np.mean(steps[steps < GAP * np.median(steps)]))


def pulse(values: Array) -> tuple[int, float] | None:
    """First sample and height of the only pulse of a column; None if it is no such column."""
    if len(values) < 3 or not np.all(np.isfinite(values)):  # before, in, after
        return None
    away = values - np.median(values)
    height = float(away[np.argmax(np.abs(away))])
    high = away / height > 0.5 if height else np.zeros(len(values), dtype=bool)
    edges = np.flatnonzero(np.diff(high.astype(np.int8)))
    low = np.abs(away[~high])
    # The samples next to an edge may be between both levels.
    flat = np.count_nonzero(low > _FLAT * abs(height)) <= len(edges)
    single = len(edges) == 2 and not high[0] and np.mean(high) < _PULSE
    return (int(edges[0]) + 1, height) if single and flat else None
