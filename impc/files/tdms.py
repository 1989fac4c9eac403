"""National Instruments TDMS, by nptdms (LGPL, the extra `tdms`)."""

from __future__ import annotations

import contextlib
import io
import logging
from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.errors import DataError
from impc.extras import optional
from impc.files.table import make_table

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from impc.arrays import Array
    from impc.files.table import Table

# Kinds of scales that nptdms applies.
_SCALES = (
    *("Linear", "Polynomial", "Table", "Add", "Subtract", "AdvancedAPI"),
    *("RTD", "Strain", "Thermistor", "Thermocouple"),
)
_BETWEEN = 0.1  # of a sample, by which two channels may be apart


def read_tdms(path: Path, largest: int) -> Table:
    """Read the channels of all groups at `path`; `group/channel` where two groups name one alike.

    Time stamps become seconds after the first. The rate is 1 / wf_increment, where it is given.
    Channels that begin at different times are cut to the time that they have in common. Arrays take
    `largest` bytes at most.
    """
    source = str(path)
    nptdms = optional("nptdms", source)
    # Opened here, because nptdms leaves a file open when its head is damaged.
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
            problem = f"is too large or damaged: it says that it has {claimed} values"
            raise DataError(source, problem, "export only the channels that are needed")
        return _table(source, channels, unknown)


def encode_tdms(table: Table) -> bytes:
    """The bytes of a TDMS file with one group."""
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
    """A file that is asked for no more than it has: Python takes the memory before it looks."""

    def read(self, size: int | None = -1, /) -> bytes:
        """As of any file; `size` in bytes."""
        if size is None or size < 0:
            return super().read()
        here = self.tell()
        end = self.seek(0, io.SEEK_END)
        self.seek(here)
        return super().read(min(size, max(0, end - here)))


def _unknown_scale(channel: Any, *owners: Any) -> str:
    """The kind of a scale that nptdms does not apply, so that its samples are raw counts."""
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
    timed: dict[str, Any] = {}
    for channel in channels:
        twice = names[channel.name] > 1
        name = f"{channel.group_name}/{channel.name}" if twice else channel.name
        if channel.path in unknown:
            skipped[name] = f"has a scale of the unknown kind {unknown[channel.path]!r}: raw counts"
            continue
        if channel.dtype.kind not in "fiubM":
            skipped[name] = "is complex" if channel.dtype.kind == "c" else "is text"
            continue
        data = channel[:]
        unit = str(channel.properties.get("unit_string", ""))
        if data.dtype.kind == "M" and len(data):
            data = (data - data[0]) / np.timedelta64(1, "s")
            unit = "s"
        columns[name] = np.asarray(data, dtype=np.float64)
        units[name] = unit
        if float(channel.properties.get("wf_increment", 0) or 0) > 0:
            timed[name] = channel.properties
    columns = _simultaneous(source, columns, timed)
    table = make_table(source, columns, units, None, skipped)
    told = {1 / float(timed[name]["wf_increment"]) for name in table.columns if name in timed}
    if len(told) > 1:
        raise DataError(
            source,
            f"has channels of {min(told):g} and {max(told):g} samples per second",
            "export those of one rate into a file of their own",
        )
    return make_table(source, table.columns, table.units, next(iter(told), None), table.skipped)


def _simultaneous(
    source: str, columns: dict[str, Array], timed: dict[str, Any]
) -> dict[str, Array]:
    """The columns, cut to the time that those with a clock have in common."""
    moments = {name: item.get("wf_start_time") for name, item in timed.items()}
    earliest = min((moment for moment in moments.values() if moment is not None), default=None)
    begins: dict[str, float] = {}
    for name, item in timed.items():
        begins[name] = float(item.get("wf_start_offset", 0) or 0)
        if moments[name] is not None:
            begins[name] += float((moments[name] - earliest) / np.timedelta64(1, "s"))
    if len(set(begins.values())) < 2:
        return columns
    last = max(begins, key=begins.__getitem__)
    step = float(timed[last]["wf_increment"])
    rows = {name: (begins[last] - begin) / step for name, begin in begins.items()}
    left = min(len(columns[name]) - lost for name, lost in rows.items())
    for name, lost in rows.items():
        if left < 2 or abs(lost - round(lost)) > _BETWEEN:
            raise DataError(
                source,
                f"channel {name} begins at {_when(moments, begins, name)} and {last} at "
                f"{_when(moments, begins, last)}, no whole number of samples apart",
                "export channels that are recorded together into a file of their own",
            )
    whole = {name: round(lost) for name, lost in rows.items()}
    return columns | {name: columns[name][lost : lost + int(left)] for name, lost in whole.items()}


def _when(moments: dict[str, Any], begins: dict[str, float], name: str) -> str:
    moment = moments[name]
    return f"{begins[name]:g} s" if moment is None else f"{begins[name]:g} s ({moment})"


@contextlib.contextmanager
def _silent(nptdms: Any) -> Iterator[None]:
    """Keep nptdms from printing warnings of its own: what matters becomes an error here."""
    handler = nptdms.log.log_manager.console_handler
    before = handler.level
    handler.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        handler.setLevel(before)
