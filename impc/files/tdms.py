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

__all__ = ["encode_tdms", "read_tdms"]


def read_tdms(path: Path, largest: int) -> Table:
    """Read the channels of all groups; `group/channel` where two groups name one alike.

    Time stamps become seconds after the first. The rate is 1 / wf_increment, where it is told.

    Parameters
    ----------
    path : Path
        Of the file.
    largest : int
        The most bytes that its arrays may take.

    Raises
    ------
    DataError
        When the file was cut off while it was written or copied, or has no numeric channel.
    ImpcError
        When nptdms is not installed.
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
        claimed = sum(len(channel) for channel in channels)
        if 8 * claimed > largest or claimed > path.stat().st_size:
            problem = f"is too large or damaged: it says that it has {claimed} values"
            raise DataError(source, problem, "export only the channels that are needed")
        return _table(source, channels)


def encode_tdms(table: Table) -> bytes:
    """The bytes of a TDMS file with one group.

    Raises
    ------
    ImpcError
        When nptdms is not installed.
    """
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


def _table(source: str, channels: list[Any]) -> Table:
    names = Counter(channel.name for channel in channels)
    columns: dict[str, Array] = {}
    units: dict[str, str] = {}
    skipped: dict[str, str] = {}
    rates: dict[str, float] = {}
    for channel in channels:
        twice = names[channel.name] > 1
        name = f"{channel.group_name}/{channel.name}" if twice else channel.name
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
        step = float(channel.properties.get("wf_increment", 0) or 0)
        if step > 0:
            rates[name] = 1 / step
    table = make_table(source, columns, units, None, skipped)
    told = {rates[name] for name in table.columns if name in rates}
    if len(told) > 1:
        raise DataError(
            source,
            f"has channels of {min(told):g} and {max(told):g} samples per second",
            "export those of one rate into a file of their own",
        )
    return make_table(source, table.columns, table.units, next(iter(told), None), table.skipped)


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
