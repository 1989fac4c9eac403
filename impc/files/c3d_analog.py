"""The analog channels of C3D, by c3d (MIT, the extra `c3d`). Marker positions are not read."""

from __future__ import annotations

import io
import warnings
from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.errors import DataError, OutputError
from impc.extras import optional
from impc.files.table import make_table

if TYPE_CHECKING:
    from pathlib import Path

    from impc.arrays import Array
    from impc.files.table import Table


def read_c3d(path: Path, largest: int) -> Table:
    """Read the analog channels of the file at `path`, with their units and rate.

    Its arrays take `largest` bytes at most.
    """
    source = str(path)
    c3d = optional("c3d", source)
    # c3d warns of headers that contradict themselves in small things; what matters is checked here.
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
        units = _units(reader)
        rate = float(reader.analog_rate)
    values = np.concatenate(frames, axis=1)
    repeated = next((label for label, times in Counter(labels).items() if times > 1), None)
    if repeated is not None or len(labels) < len(values):
        problem = f"names two channels {repeated!r}" if repeated is not None else "lacks names"
        raise DataError(source, problem, "give each analog channel its own label")
    columns: dict[str, Array] = dict(zip(labels, values, strict=False))
    return make_table(source, columns, dict(zip(labels, units, strict=False)), rate)


def encode_c3d(table: Table) -> bytes:
    """The bytes of a C3D file with the columns as analog channels, in single precision."""
    c3d = optional("c3d", "C3D")
    if table.rate is None:
        raise OutputError("C3D", "needs the rate of the samples", "give the table a rate")
    writer = c3d.Writer(point_rate=table.rate, analog_rate=table.rate, point_scale=-1.0)
    names = list(table.columns)
    writer.set_point_labels(["none"])  # the format has no file without a marker
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


def _units(reader: Any) -> list[str]:
    group = reader.get("ANALOG")
    units = group.get("UNITS") if group is not None else None
    return [] if units is None else [str(unit).strip() for unit in units.string_array]
