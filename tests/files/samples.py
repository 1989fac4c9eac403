"""Sample recording of a pushed seat, and files of it written by other means than impc."""

from __future__ import annotations

import io
import struct
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import h5py
import numpy as np
import openpyxl
import scipy.io
import scipy.signal

from impc.arrays import Array

__all__ = [
    "CONFIGURATION",
    "csv_text",
    "hdf5_mat",
    "mat5_array",
    "mat5_element",
    "mat5_file",
    "ods_file",
    "opaque_variable",
    "pushed_seat",
    "save_mat",
    "settings",
    "workbook",
]

#: Columns of `pushed_seat` as signals of `plants:seated_balance_plant`.
CONFIGURATION = """
[recording]
time = "time"
subject = "S01"

[signals.theta1]
column = "seat"
unit = "deg"
limit = 12.0

[signals.theta2]
column = "trunk"
unit = "deg"

[signals.perturbation]
column = "push"
unit = "Nm"
"""


def settings(*changes: tuple[str, str]) -> str:
    """`CONFIGURATION` with pieces replaced; each must occur."""
    text = CONFIGURATION
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return text


def pushed_seat(samples: int = 600, rate: float = 100.0, seed: int = 1) -> dict[str, Array]:
    """Clock in s, and two angles in deg that follow a two-level push in Nm; fixed random seed."""
    rng = np.random.default_rng(seed)
    hold = max(1, round(0.2 * rate))
    push = np.repeat(rng.choice([-10.0, 10.0], samples // hold + 1), hold)[:samples]
    mode = scipy.signal.cont2discrete(([[4.0]], [1.0, 2.0, 9.0]), 1 / rate)
    numerator, denominator = np.ravel(mode[0]), mode[1]
    seat = scipy.signal.lfilter(numerator, denominator, push)
    trunk = scipy.signal.lfilter(numerator, denominator, -push) / 2
    noise = 0.02 * rng.normal(size=(2, samples))
    return {
        "time": np.arange(samples) / rate,
        "seat": seat + noise[0],
        "trunk": trunk + noise[1],
        "push": push,
    }


def csv_text(columns: Mapping[str, Array], delimiter: str = ",", decimal: str = ".") -> str:
    """Columns as delimited text, 10 digits."""
    rows = zip(*(values.tolist() for values in columns.values()), strict=True)
    lines = [delimiter.join(f"{value:.10g}".replace(".", decimal) for value in row) for row in rows]
    return "\n".join([delimiter.join(columns), *lines]) + "\n"


def save_mat(path: Path, values: Mapping[str, Any], **options: Any) -> None:
    """A v5 .mat file by scipy."""
    content = io.BytesIO()
    save: Any = scipy.io.savemat
    save(content, dict(values), **options)
    path.write_bytes(content.getvalue())


def hdf5_mat(
    path: Path, values: Mapping[str, Any], classes: Mapping[str, str] | None = None
) -> Any:
    """A v7.3 .mat file by h5py, as MATLAB lays it out: transposed, with a user block."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in values.items():
            made = file.create_dataset(name, data=np.atleast_2d(value))
            made.attrs["MATLAB_class"] = np.bytes_((classes or {}).get(name, "double"))
    with path.open("r+b") as plain:
        plain.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116) + bytes(8) + b"\0\2IM")


def opaque_variable(name: bytes, kind: bytes) -> bytes:
    """A variable of a v5 file that is an object of a MATLAB class, such as table.

    Class 17 (opaque), then name, kind of object, class, and a reference.
    """
    sizes = mat5_element(6, struct.pack("<II", 13, 0)) + mat5_element(5, struct.pack("<ii", 6, 1))
    reference = mat5_element(14, sizes + mat5_element(1, b"") + mat5_element(6, bytes(24)))
    names = b"".join(mat5_element(1, text) for text in (name, b"MCOS", kind))
    return mat5_element(14, mat5_element(6, struct.pack("<II", 17, 0)) + names + reference)


def mat5_file(*elements: bytes) -> bytes:
    """A v5 file of these elements, little-endian."""
    return b"MATLAB 5.0 MAT-file".ljust(116) + bytes(8) + b"\0\1IM" + b"".join(elements)


def mat5_array(kind: int, sizes: tuple[int, ...], name: str, content: bytes) -> bytes:
    """Element of an array of a class such as 6 (double), with its dimensions and name."""
    flags = mat5_element(6, struct.pack("<II", kind, 0))
    shape = mat5_element(5, struct.pack(f"<{len(sizes)}i", *sizes))
    return mat5_element(14, flags + shape + mat5_element(1, name.encode()) + content)


def mat5_element(kind: int, content: bytes, padded: bool = True) -> bytes:
    """An element of a v5 file: type, length and bytes, padded to eight."""
    end = bytes(-len(content) % 8) if padded else b""
    return struct.pack("<II", kind, len(content)) + content + end


def workbook(path: Path, hidden: Sequence[int] = (), /, **sheets: Iterable[Sequence[Any]]) -> Path:
    """A workbook of openpyxl; the `hidden` rows are those of its first sheet."""
    book = openpyxl.Workbook()
    book.remove(book.active)
    for name, rows in sheets.items():
        sheet = book.create_sheet(name)
        for row in rows:
            sheet.append(list(row))
    for number in hidden:
        book.worksheets[0].row_dimensions[number].hidden = True
    book.save(path)
    return path


def ods_file(path: Path, sheets: Mapping[str, Iterable[Sequence[float | str]]]) -> None:
    """An OpenDocument 1.3 workbook as LibreOffice packs it: mimetype first, uncompressed."""
    kind = "application/vnd.oasis.opendocument.spreadsheet"
    names = " ".join(
        f'xmlns:{short}="urn:oasis:names:tc:opendocument:xmlns:{short}:1.0"'
        for short in ("office", "table", "text")
    )

    def cell(value: float | str) -> str:
        if isinstance(value, str):
            text = f"<text:p>{escape(value)}</text:p>"
            return f'<table:table-cell office:value-type="string">{text}</table:table-cell>'
        return f'<table:table-cell office:value-type="float" office:value="{float(value)!r}"/>'

    tables = "".join(
        f'<table:table table:name="{name}">'
        + "".join(f"<table:table-row>{''.join(map(cell, row))}</table:table-row>" for row in rows)
        + "</table:table>"
        for name, rows in sheets.items()
    )
    body = f"<office:body><office:spreadsheet>{tables}</office:spreadsheet></office:body>"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("mimetype", kind, zipfile.ZIP_STORED)
        archive.writestr(
            "content.xml", f"<office:document-content {names}>{body}</office:document-content>"
        )
        manifest = "urn:oasis:names:tc:opendocument:xmlns:manifest:1.0"
        entry = f'<m:file-entry m:full-path="/" m:media-type="{kind}"/>'
        archive.writestr(
            "META-INF/manifest.xml", f'<m:manifest xmlns:m="{manifest}">{entry}</m:manifest>'
        )
