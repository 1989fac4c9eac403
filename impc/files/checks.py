"""Checks of a recorded channel, one function each.

A check raises `DataError` if the channel cannot be used; otherwise it returns a finding or None.
Messages name file, signal and column, the number of samples, and the first of them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from impc.arrays import Array, BoolArray, IntArray
from impc.errors import DataError, FallError, ImpcError, one_line
from impc.files.units import Unit
from impc.levels import Level

#: First words of the message about a fall.
FELL = "the subject fell"
# Share of samples at an extreme value: above the first a finding, above the second an error. A
# coarsely quantised sinusoid stays at its extremes at most 2.4 times as long as at the next step
# (for 2 and 4 steps), so a factor of 3 is required.
_CLIPPED, _TOO_CLIPPED = 0.01, 0.05
_NEXT = 3.0
# A sensor failed where it keeps a value this many times longer than elsewhere, for at least this
# many samples, in at most this many stretches.
_LONGER, _STILL, _EPISODES = 4, 10, 20
# A code of missing values is at least twice in a signal, in at most half of it, and ten ranges of
# the others away, which have at least ten levels. If all its digits are nine, or it is a power of
# ten or an end of 16 or 32 bits, as written to seven digits, it may be one range away from two
# levels, and of nines also once or in most of it; 0 and -1 may be one range away.
_LEVELS, _AWAY = 10, 10.0
_CODE = re.compile(r"9{2,}|9{2,}\.(9+|25)|1e\+\d+|10{3,}|32767|32768|65535|2\.147484e\+09")
_SPARSE = 0.5  # share of samples below which a signal may be written only where it changes
# A jump is this many times the usual step; reported if it leads to one value this often.
_JUMP, _AGAIN = 6, 3
_BALANCED = 0.05  # share of a trial before a fall
_MISSING = 0.5  # share of an output or a command that may be missing
# Plausible range of an angle, rad: a posture spans at most half a turn; 0.2 deg is the span left of
# 11.5 deg that were recorded in rad and labelled deg.
_TURN, _WIDE, _TINY = np.pi, 1.0, np.deg2rad(0.2)
# Plausible sizes in SI units; their fourth powers are still finite floating-point numbers.
_LARGEST, _SMALLEST = 1e50, 1e-50
# Largest ratio of recording period to plant step; milliseconds read as seconds give 1000.
_SLOWER = 50


@dataclass(frozen=True)
class Notice:
    """One fault or finding."""

    level: Level  # AMBER: a finding, or a fall; RED: a fault that stops a fit
    file: str  # Recording or configuration
    place: tuple[str, ...]  # TOML path to look at; empty if there is none
    text: str
    remedy: str = ""

    def __str__(self) -> str:
        return one_line(f"{self.text}; {self.remedy}") if self.remedy else self.text


def fault(error: ImpcError) -> Notice:
    """The notice of an error; `impc fit` leaves out trials in which the subject fell."""
    text = one_line(f"{error.subject}: {error.problem}")
    level = Level.AMBER if isinstance(error, FallError) else Level.RED
    return Notice(level, error.file, error.place, text, one_line(error.remedy))


def finding(file: str, text: str, *place: str) -> Notice:
    """A finding of a `file`, which its text begins with."""
    return Notice(Level.AMBER, file, place, f"{file}: {text}")


@dataclass(frozen=True)
class Channel:
    """One recorded signal, before it is resampled."""

    source: str  # file
    signal: str  # name in the plant
    column: str  # name in the file
    unit: Unit
    time: Array  # (samples,), s, on the file's clock
    values: Array  # (samples,), in `unit`, after offset and sign

    @property
    def name(self) -> str:
        """File, signal and column, for messages."""
        return f"{self.source}: {self.signal} (column {self.column!r})"

    def at(self, index: int) -> str:
        """Number and time of a sample, for messages."""
        return f"sample {index + 1} ({self.time[index]:.6g} s)"

    def key(self, name: str) -> tuple[str, str, str, str]:
        """File and TOML path of a key of the signal."""
        return self.source, "signals", self.signal, name

    def finding(self, text: str, key: str = "column") -> Notice:
        """A finding about a key of the signal, by default its column."""
        return Notice(Level.AMBER, self.source, self.key(key)[1:], f"{self.name}{text}")


def unit_of_the_file(channel: Channel, stated: Unit | None, overruled: bool) -> Notice | None:
    """Require that the file's unit (if not "1") agrees with the configuration or is overruled."""
    if stated is None or (
        stated.base == channel.unit.base and np.isclose(stated.factor, channel.unit.factor)
    ):
        return None
    key = f"signals.{channel.signal}"
    if overruled or (stated.base == "dimensionless" and stated.factor == 1):
        said = f"read in {channel.unit.written!r} as {key} says; the file states {stated.written!r}"
        return channel.finding(f": {said}", "unit")
    raise DataError(
        channel.name,
        f"has the unit {channel.unit.written!r} in the configuration and {stated.written!r} in "
        "the file",
        f"correct {key}.unit, or set {key}.overrule_unit = true if the file is wrong",
    ).at(*channel.key("unit"))


def without_codes(values: Array, codes: float | Sequence[float]) -> Array:
    """`values` (samples,) with NaN where they are one of the `codes`."""
    found = values.copy()
    for code in np.atleast_1d(codes):
        found[np.isclose(values, code, rtol=1e-6, atol=0)] = np.nan  # also in single precision
    return found


def held(values: Array) -> Array:
    """`values` (samples,) with the last finite one where there is none."""
    last = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), 0))
    return np.asarray(values[last])


def missing_code(values: Array) -> tuple[str, int] | None:
    """Values of a column that may mark missing samples, as TOML, and how often they occur.

    They are repeated and far from all others.
    """
    finite = values[np.isfinite(values)]
    ends = [finite.min(), finite.max()] if len(finite) else []
    for codes in (ends[:1], ends[1:], ends) if ends else ():
        marked = np.isin(finite, codes)
        if all(_may_mark(finite[~marked], code, int(np.sum(finite == code))) for code in codes):
            said = [f"{code:.7g}" for code in codes]
            return said[0] if len(said) == 1 else f"[{', '.join(said)}]", int(marked.sum())
    return None


@np.errstate(over="ignore")
def _may_mark(rest: Array, code: float, times: int) -> bool:
    """Whether a value that occurs so many `times` may mark missing samples among the `rest`."""
    said = f"{code:.7g}".lstrip("-")
    usual = bool(_CODE.fullmatch(said))
    if not said.startswith("99") and not 1 < times < len(rest):
        return False
    if len(np.unique(rest)) < (2 if usual else _LEVELS):
        return False
    away, span = np.abs(rest - code).min(), np.ptp(rest)
    near = times > 1 and (usual or code in (0, -1))
    return bool(away > (1 if near else _AWAY) * span)


def changes_only(values: Array) -> int:
    """Number of samples of a column that is written only where it changes; 0 for the others."""
    finite = np.isfinite(values)
    written = values[finite]
    return len(written) if len(written) <= _SPARSE * len(values) else 0


def coded(channel: Channel, raw: Array) -> None:
    """Reject a signal with a value that may mark missing samples; `raw` are those of the file."""
    if (found := missing_code(raw)) is None:
        return
    code = found[0]
    raise DataError(
        channel.name,
        f"is {code} in {found[1]} of {len(raw)} samples, far from all others",
        f"if that marks missing values, write missing = {code} in [signals.{channel.signal}], "
        "otherwise missing = []",
    ).at(*channel.key("missing"))


def written_at_changes(channel: Channel, raw: Array) -> None:
    """Reject a signal that may be written only where it changes, until someone says so."""
    if written := changes_only(raw):
        raise DataError(
            channel.name,
            f"has a value in {written} of {len(raw)} samples",
            f"if it is written only where it changes, write held = true in "
            f"[signals.{channel.signal}], otherwise held = false",
        ).at(*channel.key("held"))


def measurable(channel: Channel) -> Notice | None:
    """Reject values that are implausibly large or small."""
    sizes = np.where(np.isfinite(channel.values), np.abs(channel.values), 0)
    first = int(np.argmax(sizes))
    factor = channel.unit.factor
    if sizes[first] > _LARGEST / factor or 0 < sizes[first] < _SMALLEST / factor:
        raise DataError(
            channel.name,
            f"is {channel.values[first]:.3g} {channel.unit.written} in {channel.at(first)}, which "
            "is implausible",
            f"check the column, and offset and unit in signals.{channel.signal}",
        )
    return None


def comparable_rates(subject: str, period: float, dt: float) -> None:
    """Require that a recording is not much slower than the plant; `period` and `dt` in s."""
    if period > _SLOWER * dt:
        raise DataError(
            subject,
            f"has a sample every {period:.4g} s, far slower than the plant (dt = {dt:.4g} s)",
            "correct recording.time_unit or rate, or use a plant with a longer dt",
        ).at(subject, "recording", "time_unit")


def gaps(channel: Channel, fill_gaps: float) -> BoolArray:
    """Mask (samples,) of missing samples at an end, or in gaps longer than `fill_gaps` s."""
    lost = ~np.isfinite(channel.values)
    kept = np.flatnonzero(~lost)
    after = np.searchsorted(kept, np.arange(len(lost)))
    inside = lost & (after > 0) & (after < len(kept))
    stretch = channel.time[kept[after[inside]]] - channel.time[kept[after[inside] - 1]]
    lost[inside] = stretch > fill_gaps * (1 + 1e-9)
    return lost


def missing(channel: Channel, fill_gaps: float, keep: bool | None = None) -> Notice | None:
    """Report samples that are missing or not finite; gaps up to `fill_gaps` s may be filled.

    `keep`: whether longer gaps count as not measured; None if they never can.
    """
    finite = np.isfinite(channel.values)
    lost = np.flatnonzero(~finite)
    if len(lost) == 0:
        return None
    kept = np.flatnonzero(finite)
    found = (
        f"{len(lost)} of {len(finite)} samples are missing or not finite, the first "
        f"{channel.at(lost[0])}"
    )
    if keep and (left := gaps(channel, fill_gaps)).any():
        share = float(np.mean(left))
        if share > _MISSING:
            remedy = "leave the trial out: at most half of a signal may be missing"
            raise DataError(channel.name, f"{found}; {share:.0%} lie in long gaps", remedy)
        filled = "; the others filled by interpolation" if left.sum() < len(lost) else ""
        return channel.finding(f": {found}; {100 * share:.2g} % count as not measured{filled}")
    remedy = "cut with recording.start and stop, or repair the file"
    remedy += ", or set recording.keep_gaps = true" if keep is False else ""
    if len(kept) == 0 or not finite[0] or not finite[-1]:
        raise DataError(channel.name, f"{found}, at an end of the recording", remedy)
    times = channel.time[kept]
    bridged = np.diff(times)[np.diff(kept) > 1]
    if bridged.max() > fill_gaps * (1 + 1e-9):
        raise DataError(
            channel.name,
            f"{found}, the longest stretch {bridged.max():.4g} s",
            f"{remedy}, or raise recording.fill_gaps (now {fill_gaps:g} s)",
        )
    return channel.finding(f": {found}; filled by interpolation")


def constant(channel: Channel) -> Notice | None:
    """Reject a constant channel: unplugged sensor, or perturbation that never acted."""
    values = channel.values[np.isfinite(channel.values)]
    if np.ptp(values) <= 1e-12 * np.max(np.abs(values)):
        raise DataError(
            channel.name,
            f"is constant at {values[0]:.6g} {channel.unit.written} in all {len(values)} samples",
            "name the right column, or leave out a disturbance that does not act",
        )
    return None


def clipped(channel: Channel) -> Notice | None:
    """Report a response that stays at its extreme values: amplifier or converter saturated."""
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
        return channel.finding(f" {found}")
    return None


def stretches(channel: Channel) -> Notice | None:
    """Report a response that freezes within its range, or repeatedly jumps to one value."""
    values, finite = channel.values, np.isfinite(channel.values)
    steps = np.abs(np.diff(values))
    ends = np.flatnonzero(~(steps == 0)) + 1
    starts, ends = np.append(0, ends), np.append(ends, len(values))
    ends_of_range = (np.nanmin(values), np.nanmax(values))  # reported by `clipped`
    extreme = np.isin(values[starts], ends_of_range)
    lengths = np.where(extreme, 1, ends - starts)
    if (still := _unusual(lengths)).any():
        first, often = int(starts[np.argmax(still)]), "stretch" if still.sum() == 1 else "stretches"
        return channel.finding(
            f" is constant in {still.sum()} {often}, {lengths[still].sum()} samples "
            f"in total, the first at {values[first]:.6g} {channel.unit.written} from "
            f"{channel.at(first)}: the sensor may have failed; cut it with recording.start and stop"
        )
    moves = steps[np.isfinite(steps) & (steps > 0)]
    inside = (starts > 0) & (ends < len(values)) & finite[starts]
    into, out = steps[starts[inside] - 1], steps[ends[inside] - 1]
    jumps = np.minimum(into, out) > _JUMP * np.median(moves)
    found, times = np.unique(values[starts[inside][jumps]], return_counts=True)
    if len(found) == 0 or times.max() < _AGAIN:
        return None
    value = found[np.argmax(times)]
    lost = values == value
    return channel.finding(
        f" jumps to {value:.6g} {channel.unit.written} and back {times.max()} times, "
        f"in {lost.sum()} samples, the first {channel.at(int(np.argmax(lost)))}: if it marks lost "
        f"samples, set signals.{channel.signal}.missing and recording.fill_gaps"
    )


def _unusual(lengths: IntArray) -> BoolArray:
    """Which of the `lengths` of stretches are far longer than the others."""
    sizes = np.sort(lengths)[::-1]
    gaps = np.flatnonzero(sizes[:-1] >= _LONGER * sizes[1:])[:1]
    few = len(gaps) and gaps[0] < _EPISODES and sizes[gaps[0]] >= _STILL
    return lengths >= (sizes[gaps[0]] if few else np.inf)


def straight_lines(values: Array) -> tuple[int, int, int] | None:
    """First and last sample of a straight line far longer than usual, and how many there are."""
    levels = np.unique(values[np.isfinite(values)])
    if len(levels) < _STILL:
        return None
    with np.errstate(all="ignore"):  # of values beyond anything measured
        close = 2.01 * float(np.diff(levels).min()) + 1e-12 * float(np.ptp(levels))
        bends = np.flatnonzero(~(np.abs(np.diff(values, 2)) <= close)) + 1
        starts, ends = np.append(0, bends), np.append(bends, len(values) - 1)
        flat = ~(np.abs(values[ends] - values[starts]) > _STILL * close)
    lines = _unusual(np.where(flat, 1, ends - starts))
    place = int(np.argmax(lines))
    return (int(starts[place]), int(ends[place]), int(lines.sum())) if lines.any() else None


def straight(channel: Channel) -> Notice | None:
    """Report stretches of a response that are a straight line between two samples."""
    if (found := straight_lines(channel.values)) is None:
        return None
    first, last, count = found
    return channel.finding(
        f" is a straight line in {count} stretch{'es' if count > 1 else ''}, the first of "
        f"{channel.time[last] - channel.time[first]:.4g} s from {channel.at(first)}: a gap that "
        "was filled by interpolation? Cut it with recording.start and stop, or leave its samples "
        "empty in the file and set recording.keep_gaps = true"
    )


def beyond_the_stop(channel: Channel, limit: float) -> Notice | None:
    """Reject values beyond the mechanical stop; `limit` in the channel's unit."""
    beyond = np.abs(channel.values) > limit * (1 + 1e-9)
    if not beyond.any():
        return None
    largest = float(np.nanmax(np.abs(channel.values)))
    raise _fault(
        channel,
        limit,
        f"exceeds its mechanical stop of {limit:g} {channel.unit.written} in {beyond.sum()} of "
        f"{len(beyond)} samples, the first {channel.at(int(np.argmax(beyond)))}, "
        f"at most {largest:.4g}",
        f"correct unit, offset or limit in signals.{channel.signal}",
    ).at(*channel.key("limit"))


def degrees_for_radians(channel: Channel) -> Notice | None:
    """Check that an angle is neither too large for a posture nor too small for a movement."""
    if not channel.unit.angle:
        return None
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
            "correct its unit; the column may hold degrees instead of radians",
        ).at(*channel.key("unit"))
    if channel.unit.factor < 1 and span < 2 * _TINY:
        raise DataError(
            channel.name,
            f"spans only {span / channel.unit.factor:.4g} {written}",
            'if the column holds radians, write unit = "rad"',
        ).at(*channel.key("unit"))
    if span > _WIDE:
        return channel.finding(
            f" spans {span / channel.unit.factor:.4g} {written} ({np.rad2deg(span):.0f} degrees), "
            f"largest in {where}: check its unit",
            "unit",
        )
    return None


def _fault(channel: Channel, beyond: float, problem: str, remedy: str) -> DataError:
    """`FallError` if the response passes `beyond` once and stays there; else the problem."""
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
    ).at(channel.source, "recording", "stop")


def too_few(source: str, samples: int, needed: int) -> None:
    """Require the `needed` number of samples at the plant's rate."""
    if samples < needed:
        raise DataError(
            source,
            f"has {samples} samples at the plant's rate, {needed} are needed",
            "record longer, or widen recording.start and stop",
        ).at(source, "recording", "start")


def _rests(resting: BoolArray) -> bool:
    """Whether the value is held for at least three consecutive samples."""
    held = resting[:-2] & resting[1:-1] & resting[2:]
    return bool(held.any())
