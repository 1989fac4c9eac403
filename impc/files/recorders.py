"""National Instruments TDMS with nptdms (LGPL), and analog channels of C3D with c3d (MIT).

Both are extras, `tdms` and `c3d`. Marker positions of C3D are not read.
"""

from __future__ import annotations

import contextlib
import io
import logging
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from impc.arrays import Array
from impc.errors import DataError, OutputError
from impc.extras import optional
from impc.files.alignment import aligned, own_clocks
from impc.files.table import Table, make_table

# Kinds of scaling that nptdms applies.
_SCALES = (
    *("Linear", "Polynomial", "Table", "Add", "Subtract", "AdvancedAPI"),
    *("RTD", "Strain", "Thermistor", "Thermocouple"),
)
# Longest plausible increment of a waveform, s.
_SLOWEST = 1e6


def read_tdms(path: Path, largest: int) -> Table:
    """Read the channels of all groups; `group/channel` if two groups use the same name.

    Time stamps become seconds after the first; the rate is 1 / wf_increment of the fastest channel.
    The arrays may take `largest` bytes.
    """
    source = str(path)
    nptdms = optional("nptdms", source)
    # Opened here because nptdms leaves a file with a damaged head open.
    with _silent(nptdms), _Bounded(io.FileIO(path)) as handle, nptdms.TdmsFile.open(handle) as file:
        if file.file_status.incomplete_final_segment:
            raise DataError(
                source, "ends in the middle of its data", "copy it again, or close it in LabVIEW"
            )
        channels = [channel for group in file.groups() for channel in group.channels()]
        unknown = {
            channel.path: scale
            for group in file.groups()
            for channel in group.channels()
            if (scale := _unknown_scale(channel, group, file))
        }
        claimed = sum(len(channel) for channel in channels)
        if 8 * claimed > largest or claimed > path.stat().st_size:
            problem = f"is too large or damaged: it claims to have {claimed} values"
            raise DataError(source, problem, "export only the channels that are needed")
        return _table(source, channels, unknown)


def encode_tdms(table: Table) -> bytes:
    """Content of a TDMS file with one group."""
    nptdms = optional("nptdms", "TDMS")
    channels = []
    for name, values in table.columns.items():
        properties: dict[str, object] = {}
        if table.rate is not None:
            properties |= {"wf_start_offset": 0.0, "wf_increment": 1 / table.rate}
        if name in table.units:
            properties["unit_string"] = table.units[name]
        channels.append(nptdms.ChannelObject("recording", name, values, properties))
    content = io.BytesIO()
    with nptdms.TdmsWriter(content) as writer:
        writer.write_segment(channels)
    return content.getvalue()


class _Bounded(io.BufferedReader):
    """Reader that never requests more than the file has: Python allocates before it reads."""

    def read(self, size: int | None = -1, /) -> bytes:
        """Read up to `size` bytes."""
        if size is None or size < 0:
            return super().read()
        here = self.tell()
        end = self.seek(0, io.SEEK_END)
        self.seek(here)
        return super().read(min(size, max(0, end - here)))


def _unknown_scale(channel: Any, *owners: Any) -> str:
    """Kind of a scaling that nptdms does not apply (its samples are raw counts), or ""."""
    for owner in (channel, *owners):
        for key, kind in owner.properties.items():
            counts = kind == "AdvancedAPI" and channel.dtype.kind in "iu"
            if key.endswith("_Scale_Type") and (counts or kind not in _SCALES):
                return str(kind)
    return ""


def _table(source: str, channels: list[Any], unknown: dict[str, str]) -> Table:
    names = Counter(channel.name for channel in channels)
    columns: dict[str, Array] = {}
    units: dict[str, str] = {}
    skipped: dict[str, str] = {}
    paths: dict[str, str] = {}
    timed: dict[str, Any] = {}
    stamps = [channel[0] for channel in channels if channel.dtype.kind == "M" and len(channel)]
    for channel in channels:
        twice = names[channel.name] > 1
        name = f"{channel.group_name}/{channel.name}" if twice else channel.name
        if channel.path in unknown:
            skipped[name] = f"has unscaled counts (unknown scaling {unknown[channel.path]!r})"
            continue
        if channel.dtype.kind not in "fiubM":
            skipped[name] = "is complex" if channel.dtype.kind == "c" else "is text"
            continue
        data = channel[:]
        unit = str(channel.properties.get("unit_string", ""))
        if data.dtype.kind == "M" and len(data):
            data = (data - min(stamps)) / np.timedelta64(1, "s")
            unit = "s"
        columns[name] = np.asarray(data, dtype=np.float64)
        units[name], paths[name] = unit, f"{channel.group_name}/{channel.name}"
        if 0 < float(channel.properties.get("wf_increment", 0) or 0) < _SLOWEST:
            timed[name] = channel.properties
    clocks = _waveform_clocks(columns, timed) if timed else own_clocks(columns, units, paths)
    columns, notes = aligned(source, columns, clocks)
    rates = [1 / float(item["wf_increment"]) for name, item in timed.items()]
    return make_table(source, columns, units, max(rates, default=None), skipped, notes)


def _waveform_clocks(
    columns: dict[str, Array], timed: dict[str, Any]
) -> dict[str, tuple[str, Array]]:
    """Name and times in s of the clock of each channel with a waveform's start and increment."""
    moments = {name: item.get("wf_start_time") for name, item in timed.items()}
    earliest = min((moment for moment in moments.values() if moment is not None), default=None)
    clocks: dict[tuple[float, float, int], tuple[str, Array]] = {}
    found = {}
    for name, item in timed.items():
        if len(columns[name]) < 2:
            continue
        begin, step = float(item.get("wf_start_offset", 0) or 0), float(item["wf_increment"])
        if moments[name] is not None:
            begin += float((moments[name] - earliest) / np.timedelta64(1, "s"))
        key = begin, step, len(columns[name])
        clocks.setdefault(
            key, (f"clock of {name}", np.asarray(begin + step * np.arange(float(key[2]))))
        )
        found[name] = clocks[key]
    return found


@contextlib.contextmanager
def _silent(nptdms: Any) -> Iterator[None]:
    """Silence the warnings that nptdms prints; relevant ones are errors here."""
    handler = nptdms.log.log_manager.console_handler
    before = handler.level
    handler.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        handler.setLevel(before)


def read_c3d(path: Path, largest: int) -> Table:
    """Read the analog channels, units and rate; the arrays may take `largest` bytes."""
    source = str(path)
    c3d = optional("c3d", source)
    # c3d warns of minor contradictions in headers; relevant ones are checked here.
    with warnings.catch_warnings(), path.open("rb") as handle:
        warnings.simplefilter("ignore")
        reader = c3d.Reader(handle)
        expected = int(reader.last_frame) - int(reader.first_frame) + 1
        if not reader.analog_used or reader.analog_per_frame < 1:
            raise DataError(source, "has no analog channels", "export them; markers are not read")
        samples = expected * int(reader.analog_per_frame)
        if 8 * samples * int(reader.analog_used) > largest:
            raise DataError(source, "is too large", "export only the channels that are needed")
        frames = [analog for _, _, analog in reader.read_frames(copy=False)]
        if len(frames) < expected:
            raise DataError(
                source, f"ends after {len(frames)} of {expected} frames", "copy or export it again"
            )
        labels = [str(label).strip() for label in reader.analog_labels]
        units = _c3d_units(reader)
        rate = float(reader.analog_rate)
    values = np.concatenate(frames, axis=1)
    repeated = next((label for label, times in Counter(labels).items() if times > 1), None)
    if repeated is not None or len(labels) < len(values):
        problem = f"names two channels {repeated!r}" if repeated is not None else "lacks names"
        raise DataError(source, problem, "give each analog channel its own label")
    columns: dict[str, Array] = dict(zip(labels, values, strict=False))
    return make_table(source, columns, dict(zip(labels, units, strict=False)), rate)


def encode_c3d(table: Table) -> bytes:
    """Content of a C3D file with the columns as analog channels, in single precision."""
    c3d = optional("c3d", "C3D")
    if table.rate is None:
        raise OutputError("C3D", "needs a sampling rate", "give the table a rate")
    writer = c3d.Writer(point_rate=table.rate, analog_rate=table.rate, point_scale=-1.0)
    names = list(table.columns)
    writer.set_point_labels(["none"])  # the format requires a marker
    writer.set_analog_labels(names)
    writer.set_analog_scales(np.ones(len(names)))
    writer.set_analog_offsets(np.zeros(len(names)))
    packed, width = c3d.Writer.pack_labels([table.units.get(name, "") or " " for name in names])
    writer.analog_group.add_str("UNITS", "Analog units.", packed, width, len(names))
    samples = np.array(list(table.columns.values()))
    marker = np.zeros((1, 5))
    writer.add_frames([(marker, samples[:, index : index + 1]) for index in range(table.samples)])
    content = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        writer.write(content)
    return content.getvalue()


def _c3d_units(reader: Any) -> list[str]:
    group = reader.get("ANALOG")
    units = group.get("UNITS") if group is not None else None
    return [] if units is None else [str(unit).strip() for unit in units.string_array]
