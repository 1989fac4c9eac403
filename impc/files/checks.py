"""What can be wrong with a recorded channel, one small function a check.

A check raises `DataError` when the channel cannot be used, and returns a finding, one sentence for
the report, when it can. An empty string: nothing to say. Every message names file, signal and
column, how many samples, and where the first is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.errors import DataError, FallError

if TYPE_CHECKING:
    from impc.arrays import Array, BoolArray
    from impc.files.units import Unit

#: How the message of a fall begins.
FELL = "the subject fell"
# Share of samples that rest on an extreme value: above the first a finding, above the second no
# use. A sinusoid in coarse steps rests on its extremes too, but at most 2.4 times as long as on the
# next step (square roots of 2 and 4 steps); so three times is asked for.
_CLIPPED, _TOO_CLIPPED = 0.01, 0.05
_NEXT = 3.0
# A response stands still where it keeps a value so many times longer than anywhere else, for so
# many samples at least, and in so many places at most.
_LONGER, _STILL, _EPISODES = 4, 10, 20
# A jump is so many times the usual step, and is no accident when it leads to one value so often.
_JUMP, _AGAIN = 6, 3
_BALANCED = 0.05  # share of a trial before a fall
_MISSING = 0.5  # share of an output or a command that may be missing
# Largest deviations of an angle, rad: more than half a turn is no posture; 0.2 deg is the size of
# 11.5 deg that were recorded in rad and called deg.
_TURN, _WIDE, _TINY = np.pi, 1.0, np.deg2rad(0.2)

# In SI units. Fourth powers of both are still numbers, and nothing measured comes near.
_LARGEST, _SMALLEST = 1e50, 1e-50
# The plant's samples for one of the recording: milliseconds taken for seconds are 1000.
_SLOWER = 50


@dataclass(frozen=True)
class Channel:
    """One recorded signal, before it is resampled."""

    source: str  # File, name in the plant, name in the file
    signal: str
    column: str
    unit: Unit
    time: Array  # (samples,), s, on the file's clock
    values: Array  # (samples,), in `unit`, after offset and sign

    @property
    def name(self) -> str:
        """File, signal and column, for messages."""
        return f"{self.source}: {self.signal} (column {self.column!r})"

    def at(self, index: int) -> str:
        """Where the sample `index` is, for messages."""
        return f"sample {index + 1} ({self.time[index]:.6g} s)"


def unit_of_the_file(channel: Channel, stated: Unit | None, overruled: bool) -> str:
    """The unit that the file gives must be that of the configuration, unless it is overruled.

    A file that says "1" gives none.
    """
    if stated is None or (
        stated.base == channel.unit.base and np.isclose(stated.factor, channel.unit.factor)
    ):
        return ""
    key = f"signals.{channel.signal}"
    if overruled or (stated.base == "dimensionless" and stated.factor == 1):
        return (
            f"{channel.name}: taken in {channel.unit.written!r} by {key}, where the file says "
            f"{stated.written!r}"
        )
    raise DataError(
        channel.name,
        f"is in {channel.unit.written!r} by the configuration and in {stated.written!r} by the "
        "file",
        f"correct {key}.unit, or write {key}.overrule_unit = true if the file is wrong",
    )


def measurable(channel: Channel) -> str:
    """Values that no measurement has: infinite almost, or all but nothing."""
    sizes = np.where(np.isfinite(channel.values), np.abs(channel.values), 0)
    first = int(np.argmax(sizes))
    factor = channel.unit.factor
    if sizes[first] > _LARGEST / factor or 0 < sizes[first] < _SMALLEST / factor:
        raise DataError(
            channel.name,
            f"is {channel.values[first]:.3g} {channel.unit.written} in {channel.at(first)}, which "
            "is no measurement",
            f"correct the column, or offset and unit in signals.{channel.signal}",
        )
    return ""


def comparable_rates(subject: str, period: float, dt: float) -> None:
    """Require that a recording is not much slower than the plant: its `period`, and `dt`, in s."""
    if period > _SLOWER * dt:
        raise DataError(
            subject,
            f"has a sample every {period:.4g} s, and the plant one every {dt:.4g} s",
            "correct recording.time_unit or rate, or give the plant a longer dt",
        )


def gaps(channel: Channel, fill_gaps: float) -> BoolArray:
    """Missing samples in stretches longer than `fill_gaps`, in s, or at an end (samples,)."""
    lost = ~np.isfinite(channel.values)
    kept = np.flatnonzero(~lost)
    after = np.searchsorted(kept, np.arange(len(lost)))
    inside = lost & (after > 0) & (after < len(kept))
    stretch = channel.time[kept[after[inside]]] - channel.time[kept[after[inside] - 1]]
    lost[inside] = stretch > fill_gaps * (1 + 1e-9)
    return lost


def missing(channel: Channel, fill_gaps: float, keep: bool | None = None) -> str:
    """Samples of a `channel` that are missing or not finite; `fill_gaps`, in s, may be bridged.

    `keep` says whether longer gaps count as not measured; None where they cannot.
    """
    finite = np.isfinite(channel.values)
    lost = np.flatnonzero(~finite)
    if len(lost) == 0:
        return ""
    kept = np.flatnonzero(finite)
    found = (
        f"{len(lost)} of {len(finite)} samples are missing or not finite, the first "
        f"{channel.at(lost[0])}"
    )
    if keep and (left := gaps(channel, fill_gaps)).any():
        share = float(np.mean(left))
        if share > _MISSING:
            remedy = "leave the trial out: at most half of a signal may be missing"
            raise DataError(channel.name, f"{found}: {share:.0%} of them", remedy)
        filled = "; the others filled by interpolation" if left.sum() < len(lost) else ""
        return f"{channel.name}: {found}; {100 * share:.2g} % count as not measured{filled}"
    remedy = "cut with recording.start and stop, or repair the file"
    remedy += ", or write recording.keep_gaps = true" if keep is False else ""
    if len(kept) == 0 or not finite[0] or not finite[-1]:
        raise DataError(channel.name, f"{found}, at an end of the recording", remedy)
    times = channel.time[kept]
    bridged = np.diff(times)[np.diff(kept) > 1]
    if bridged.max() > fill_gaps * (1 + 1e-9):
        raise DataError(
            channel.name,
            f"{found}, the longest stretch {bridged.max():.4g} s",
            f"{remedy}, or allow recording.fill_gaps (now {fill_gaps:g} s)",
        )
    return f"{channel.name}: {found}; filled by interpolation"


def constant(channel: Channel) -> str:
    """A channel that never changes: an unplugged sensor, a perturbation that never acted."""
    values = channel.values[np.isfinite(channel.values)]
    if np.ptp(values) <= 1e-12 * np.max(np.abs(values)):
        raise DataError(
            channel.name,
            f"is constant at {values[0]:.6g} {channel.unit.written} in all {len(values)} samples",
            "name the right column; a disturbance may be left out",
        )
    return ""


def clipped(channel: Channel) -> str:
    """A response that rests on its extreme values: an amplifier or converter at its end."""
    finite = channel.values[np.isfinite(channel.values)]
    span = np.ptp(finite)
    levels = np.unique(finite)
    step = max(0.01 * span, 1.001 * (levels[-1] - levels[-2]), 1.001 * (levels[1] - levels[0]))
    for extreme in (levels[-1], levels[0]):
        resting = channel.values == extreme
        near = (np.abs(channel.values - extreme) <= step) & ~resting
        share = resting.sum() / len(resting)
        if share < _CLIPPED or resting.sum() < _NEXT * near.sum() or not _rests(resting):
            continue
        first = int(np.argmax(resting))
        found = (
            f"is clipped at {extreme:.6g} {channel.unit.written} in {resting.sum()} of "
            f"{len(resting)} samples, the first {channel.at(first)}"
        )
        if share > _TOO_CLIPPED:
            raise _fault(channel, abs(extreme), found, "record with a wider range")
        return f"{channel.name} {found}"
    return ""


def stretches(channel: Channel) -> str:
    """A response that stands still within its range, or jumps to one value and back."""
    values, finite = channel.values, np.isfinite(channel.values)
    steps = np.abs(np.diff(values))
    ends = np.flatnonzero(~(steps == 0)) + 1
    starts, ends = np.append(0, ends), np.append(ends, len(values))
    ends_of_range = (np.nanmin(values), np.nanmax(values))  # where it is clipped
    extreme = np.isin(values[starts], ends_of_range)
    lengths = np.where(extreme, 1, ends - starts)
    sizes = np.sort(lengths)[::-1]
    gaps = np.flatnonzero(sizes[:-1] >= _LONGER * sizes[1:])[:1]
    if len(gaps) and gaps[0] < _EPISODES and sizes[gaps[0]] >= _STILL:
        still = lengths >= sizes[gaps[0]]
        first, often = int(starts[np.argmax(still)]), "time" if still.sum() == 1 else "times"
        return (
            f"{channel.name} stands still {still.sum()} {often}, {lengths[still].sum()} samples "
            f"in all, the first at {values[first]:.6g} {channel.unit.written} from "
            f"{channel.at(first)}: did the sensor fail? cut it with recording.start and stop"
        )
    moves = steps[np.isfinite(steps) & (steps > 0)]
    inside = (starts > 0) & (ends < len(values)) & finite[starts]
    into, out = steps[starts[inside] - 1], steps[ends[inside] - 1]
    jumps = np.minimum(into, out) > _JUMP * np.median(moves)
    found, times = np.unique(values[starts[inside][jumps]], return_counts=True)
    if len(found) == 0 or times.max() < _AGAIN:
        return ""
    value = found[np.argmax(times)]
    lost = values == value
    return (
        f"{channel.name} jumps to {value:.6g} {channel.unit.written} and back {times.max()} times, "
        f"in {lost.sum()} samples, the first {channel.at(int(np.argmax(lost)))}: samples that were "
        "lost? leave them empty in the file, and allow recording.fill_gaps"
    )


def beyond_the_stop(channel: Channel, limit: float) -> str:
    """A value that the mechanical stop does not let happen; limit in the channel's unit."""
    beyond = np.abs(channel.values) > limit * (1 + 1e-9)
    if not beyond.any():
        return ""
    largest = float(np.nanmax(np.abs(channel.values)))
    raise _fault(
        channel,
        limit,
        f"is beyond its stop of {limit:g} {channel.unit.written} in {beyond.sum()} of "
        f"{len(beyond)} samples, the first {channel.at(int(np.argmax(beyond)))}, "
        f"at most {largest:.4g}",
        f"correct unit, offset or limit in signals.{channel.signal}",
    )


def degrees_for_radians(channel: Channel) -> str:
    """An angle that is too large for a posture, or too small for a movement."""
    if not channel.unit.angle:
        return ""
    finite = channel.values[np.isfinite(channel.values)] * channel.unit.factor
    span = float(np.ptp(finite))
    written = channel.unit.written
    where = channel.at(int(np.nanargmax(np.abs(channel.values))))
    if span > _TURN:
        raise _fault(
            channel,
            _TURN / 2 / channel.unit.factor,
            f"spans {span / channel.unit.factor:.4g} {written}, more than half a turn, largest in "
            f"{where}",
            "the column is in smaller units: degrees taken for radians?",
        )
    if channel.unit.factor < 1 and span < 2 * _TINY:
        raise DataError(
            channel.name,
            f"spans {span / channel.unit.factor:.4g} {written} only",
            'radians taken for degrees? write unit = "rad"',
        )
    if span > _WIDE:
        return (
            f"{channel.name} spans {span / channel.unit.factor:.4g} {written} "
            f"({np.rad2deg(span):.0f} degrees), largest in {where}: check its unit"
        )
    return ""


def _fault(channel: Channel, beyond: float, problem: str, remedy: str) -> DataError:
    """A fall, where the response goes `beyond` a value once and stays there; else the problem."""
    size = np.abs(channel.values)
    first = int(np.argmax(size >= beyond))
    if first < _BALANCED * len(size) or np.any(size[first:] < beyond / 2):
        return DataError(channel.name, problem, remedy)
    usual = min(beyond / 2, 2 * float(np.nanquantile(size[:first], 0.9)))
    when = float(channel.time[np.flatnonzero(~(size[:first] > usual))[-1]])
    return FallError(
        channel.name,
        f"{FELL} at {when:.4g} s",
        f"leave the trial out, or cut it with recording.stop = {math.floor(10 * when) / 10:g}",
    )


def too_few(source: str, samples: int, needed: int) -> str:
    """Fewer samples of a `source` at the analysis rate than the `needed` ones."""
    if samples < needed:
        raise DataError(
            source,
            f"has {samples} samples at the plant's rate, {needed} are needed",
            "record longer, or widen recording.start and stop",
        )
    return ""


def _rests(resting: BoolArray) -> bool:
    """Whether the value is held over at least three samples in a row."""
    held = resting[:-2] & resting[1:-1] & resting[2:]
    return bool(held.any())
