"""Small files that need gigabytes, hours or a crash if their headers are trusted.

`HOSTILE[name]` has a phrase of the expected message, and a function of a folder that writes it.
"""

from __future__ import annotations

import copy
import io
import itertools
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from tests.files.damaged_files import written, written_by_impc
from tests.files.samples import hdf5_mat, mat5_array, mat5_element, mat5_file, ods_file

__all__ = ["HOSTILE", "repacked"]

Make = Callable[[Path], Path]


def hdf5(fill: Callable[[Any], object]) -> Make:
    """A .mat file of version 7.3 with content written by `fill`."""

    def make(folder: Path) -> Path:
        path = folder / "trial.mat"
        hdf5_mat(path, {})
        with h5py.File(path, "r+") as file:
            fill(file)
        return path

    return make


def dataset(*given: Any, begin: float | None = None, **more: Any) -> Make:
    """Add a dataset x, whose first ten values may be written."""

    def fill(file: Any) -> None:
        made = file.create_dataset("x", *given, **more)
        if begin is not None:
            made[:10] = begin

    return hdf5(fill)


def chunk(packed: bytes, size: int) -> Make:
    """Twenty numbers in a chunk of this content."""

    def fill(file: Any) -> None:
        given: Any = {"chunks": (size,), "maxshape": (None,), "compression": "gzip"}
        file.create_dataset("x", (20,), "f8", **given).id.write_direct_chunk((0,), packed)

    return hdf5(fill)


def zeros(count: int) -> bytes:
    """Compressed zeros, `times` ten million bytes."""
    packer = zlib.compressobj(1)
    return b"".join(packer.compress(bytes(10_000_000)) for _ in range(count)) + packer.flush()


def variable_lengths(file: Any) -> None:
    made = file.create_dataset("x", (1000,), h5py.vlen_dtype(np.float64))
    made[:] = [np.arange(10.0)] * 1000


def long_attribute(file: Any) -> None:
    made = file.create_dataset("x", data=np.arange(9.0))
    kind = h5py.h5t.py_create(np.dtype(("S1", (60_000,))))
    h5py.h5a.create(made.id, b"MATLAB_class", kind, h5py.h5s.create_simple((1,)))


def cycle(file: Any) -> None:
    first = file.create_group("a")
    first["again"] = first
    first.create_group("b")["up"] = first


def hard_links(file: Any) -> None:
    # 30^7 paths lead to the last group.
    groups = [file.create_group(f"g{level}") for level in range(8)]
    for group, below in itertools.pairwise(groups):
        for link in range(30):
            group[f"l{link}"] = below


def many_names(file: Any) -> None:
    made = file.create_dataset("x", data=np.arange(20_000.0))
    for link in range(12_000):
        file[f"l{link}"] = made


def mat5(*elements: bytes) -> Make:
    return lambda folder: written(folder, mat5_file(*elements), "trial.mat")


def packed5(content: bytes) -> bytes:
    return mat5_element(15, zlib.compress(content, 1), padded=False)


def unknown_type_in_a_struct() -> bytes:
    inner = mat5_array(6, (9, 1), "", mat5_element(60, bytes(72)))
    fields = mat5_element(5, struct.pack("<i", 8)) + mat5_element(1, b"a".ljust(8, b"\0"))
    return packed5(mat5_array(2, (1, 1), "s", fields + inner))


def false_length(folder: Path) -> Path:
    content = mat5_file(mat5_array(6, (100, 1), "x", mat5_element(9, bytes(800))))
    place = content.rindex(struct.pack("<II", 9, 800))
    false = content[:place] + struct.pack("<II", 9, 3_900_000_000) + content[place + 8 :]
    return written(folder, false, "trial.mat")


def many_variables() -> list[bytes]:
    numbers = mat5_element(2, bytes(3_000_000))
    return [packed5(mat5_array(9, (3_000_000, 1), f"x{k:02}", numbers)) for k in range(50)]


def cells_within_cells() -> bytes:
    inner = mat5_array(6, (1, 1), "", mat5_element(9, bytes(8)))
    for _ in range(2000):
        inner = mat5_array(1, (1, 1), "", inner)
    return inner


def with_bytes(name: str, old: bytes, new: bytes, times: int = 1) -> Make:
    """A file of impc with some bytes replaced, which must occur at least so often."""

    def make(folder: Path) -> Path:
        path = written_by_impc(folder, name)
        content = path.read_bytes()
        assert content.count(old) >= times
        path.write_bytes(content.replace(old, new))
        return path

    return make


def last_frame(folder: Path) -> Path:
    path = written_by_impc(folder, "trial.c3d")
    content = path.read_bytes()
    path.write_bytes(content[:8] + b"\xff\xff" + content[10:])
    return path


def repacked(path: Path, **exchanged: Callable[[bytes], bytes]) -> Path:
    """A zip archive in which files with these endings are replaced."""
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            change = exchanged.get(Path(name).stem, bytes)
            archive.writestr(name, change(content))
    return path


SHEET = (
    '<worksheet xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main">{}</worksheet>'
)


def sheet(content: str, before: str = "") -> Make:
    """A workbook of impc with another text for its sheet."""
    whole = (before + SHEET.format(content)).encode()
    return lambda folder: repacked(written_by_impc(folder, "trial.xlsx"), sheet1=lambda _: whole)


def zip_bomb(folder: Path) -> Path:
    # 60 names of the same 20 MB of blanks.
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a", b" " * 20_000_000)
        first = archive.getinfo("a")
        for index in range(59):
            other = copy.copy(first)
            other.filename = f"b{index}"
            archive.filelist.append(other)
    return written(folder, packed.getvalue(), "trial.xlsx")


def false_size(folder: Path) -> Path:
    path = sheet(" " * 50_000_000)(folder)
    content = path.read_bytes()
    size = struct.pack("<I", len(SHEET.format("")) + 50_000_000)
    assert content.count(size) == 2  # before the file, and in the directory
    return written(folder, content.replace(size, struct.pack("<I", 100)), "trial.xlsx")


ROW = '<row r="{}"><c r="{}"><v>1</v></c></row>'
FAR = f"<sheetData>{ROW.format(1, 'A1') + ROW.format(1_048_576, 'XFD1048576')}</sheetData>"
CELL = "<sheetData><row><c><v>&e12;</v></c></row></sheetData>"
ENTITIES = '<!ENTITY e0 "111">' + "".join(
    f'<!ENTITY e{level + 1} "{f"&e{level};" * 10}">' for level in range(12)
)
OUTSIDE = '<!ENTITY e12 SYSTEM "file:///etc/passwd">'


def cells_repeated(folder: Path) -> Path:
    def many(content: bytes) -> bytes:
        for what, part in ((b"row", b"rows"), (b"cell", b"columns")):
            again = b'<table:table-%b table:number-%b-repeated="1000000000"' % (what, part)
            content = content.replace(b"<table:table-" + what, again, 1)
        return content

    ods_file(folder / "trial.ods", {"a": [[1.0, 2.0]]})
    return repacked(folder / "trial.ods", content=many)


def later(make: Callable[[], Make]) -> Make:
    """Create the file on demand: compression takes seconds."""

    def run(folder: Path) -> Path:
        return make()(folder)

    return run


def text(content: str) -> Make:
    return lambda folder: written(folder, content)


MANY_HEADS = ",".join([*(f"a{index}" for index in range(1_000)), *["a"] * 8_000])
MANY = ",".join(["1"] * 200_000)

HOSTILE: dict[str, tuple[str, Make]] = {
    # HDF5. One value of 1.6 GB: its type is an array.
    "array type": ("is not numeric", dataset((4,), np.dtype(("<f8", (200_000_000,))))),
    "fill values": (
        "has no stored values, only a fill value",
        dataset((100_000_000,), "f8", chunks=(1000,), fillvalue=1.5),
    ),
    "fill values around one chunk": (
        "is too large once it is unpacked (at x)",
        dataset((10**12,), "f8", begin=1.0, chunks=(1000,), fillvalue=1.5),
    ),
    "narrow numbers": (
        "is too large once it is unpacked (at x)",
        dataset((900_000_000,), "u1", begin=1, chunks=(1000,)),
    ),
    "chunk of gigabytes": (
        "is too large once it is unpacked (at x)", chunk(zlib.compress(bytes(160)), 400_000_000)
    ),
    "chunk that unpacks to more than it may": (
        "is damaged and cannot be read", later(lambda: chunk(zeros(30), 20))
    ),
    "long strings": ("is not numeric", dataset((4,), "S1000000000")),
    "variable lengths": ("is not numeric", hdf5(variable_lengths)),
    "attribute of gigabytes": ("the attribute MATLAB_class is too long", hdf5(long_attribute)),
    "cycle of links": ("is a link to an earlier variable", hdf5(cycle)),
    "hard links at every level": ("is a link to an earlier variable", hdf5(hard_links)),
    "one dataset by many names": ("holds more than 10000 names", hdf5(many_names)),
    "groups within groups": (
        "is nested too deep", hdf5(lambda file: file.create_group("/".join("g" * 500)))
    ),
    # MATLAB 5. scipy's reader looks the type up in a table of 20 and ends the process.
    "unknown type": (
        "is damaged and ends the process",
        mat5(mat5_array(6, (9, 1), "x", mat5_element(200, bytes(72)))),
    ),
    "unknown type in a packed struct": (
        "is damaged and ends the process", mat5(unknown_type_in_a_struct())
    ),
    "array without flags": (
        "is damaged and cannot be read",
        mat5(mat5_element(
            14,
            mat5_element(5, bytes(16)) * 2 + mat5_element(1, b"x") + mat5_element(9, bytes(8)),
        )),
    ),
    "sizes that are not there": (
        "is damaged and cannot be read",
        mat5(mat5_array(6, (2**31 - 1, 2**31 - 1), "x", mat5_element(9, bytes(800)))),
    ),
    "length that is not there": ("GB to read", false_length),
    "packed variable that says too little": (
        "is damaged and cannot be read",
        later(lambda: mat5(packed5(struct.pack("<II", 14, 800) + bytes(200_000_000)))),
    ),
    "many packed variables": ("GB to read", later(lambda: mat5(*many_variables()))),
    "cells without end": ("GB to read", mat5(mat5_array(1, (2**31 - 1, 9), "x", b""))),
    "cells of nothing": (
        "x is a cell array",
        mat5(mat5_array(1, (300_000, 1), "x", mat5_element(14, b"") * 300_000)),
    ),
    "cells within cells": ("has no column of numbers", mat5(cells_within_cells())),
    # TDMS and C3D
    "tdms of 1e12 values": (
        "is damaged and cannot be read",
        with_bytes("trial.tdms", struct.pack("<Q", 600), struct.pack("<Q", 10**12), 3),
    ),
    "tdms of an infinite rate": (
        "states a rate of inf samples per second",
        with_bytes("trial.tdms", struct.pack("<d", 0.01), struct.pack("<d", 5e-324)),
    ),
    "c3d of an infinite rate": (
        "inconsistent analog rate",
        with_bytes("trial.c3d", struct.pack("<f", 100.0), struct.pack("<f", np.inf)),
    ),
    "c3d of frames that are not there": ("frames", last_frame),
    # Workbooks
    "zip bomb": ("is too large once it is unpacked (1.2 GB)", zip_bomb),
    "zip that says too little": ("is damaged and cannot be read", false_size),
    "cell at the end of the sheet": ("GB to read", sheet(FAR)),
    # An entity stands for nothing: the cell is empty.
    "entities of entities": (
        "has no rows of numbers", sheet(CELL, f"<!DOCTYPE w [{ENTITIES}]>")
    ),
    "entity that names a file": (
        "has no rows of numbers", sheet(CELL, f"<!DOCTYPE w [{OUTSIDE}]>")
    ),
    "cells repeated without end": ("Cell limit exceeded", cells_repeated),
    # Text
    "columns without end": ("line 1 has 399999 characters", text(f"{MANY}\n{MANY}\n")),
    "headings without end": (
        "has no column of numbers (a0 has 1 values)",
        text(MANY_HEADS + "\n" + ",".join(["1"] * 9_000) + "\n"),
    ),
    "digits without end": ("no rows of numbers", text("x\n" + "1" * 49_000 + "x\n")),
    "blanks and brackets in a heading": (
        "no rows of numbers", text("a" + " " * 20_000 + "x" + "(" * 20_000 + "\n")
    ),
}  # fmt: skip
