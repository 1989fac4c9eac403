"""Small files that take gigabytes, hours or the process of whoever believes what they say.

`HOSTILE[name].make(folder)` writes the file; `HOSTILE[name].phrase` must be said of it.
"""

from __future__ import annotations

import copy
import io
import itertools
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from tests.files.damage import written, written_by_impc
from tests.files.samples import hdf5_mat, mat5_array, mat5_element, mat5_file, ods_file

__all__ = ["HOSTILE", "Hostile"]


@dataclass(frozen=True)
class Hostile:
    """How to write a hostile file, and what must be said of it."""

    make: Callable[[Path], Path]
    phrase: str


HOSTILE: dict[str, Hostile] = {}


def _hostile(phrase: str) -> Callable[[Callable[[Path], Path]], None]:
    def put(make: Callable[[Path], Path]) -> None:
        HOSTILE[make.__name__.strip("_").replace("_", " ")] = Hostile(make, phrase)

    return put


# HDF5 -----------------------------------------------------------------------------------------


def _hdf5(folder: Path, fill: Callable[[Any], None]) -> Path:
    """A .mat file of version 7.3 whose content `fill` writes."""
    path = folder / "trial.mat"
    hdf5_mat(path, {})
    with h5py.File(path, "r+") as file:
        fill(file)
    return path


@_hostile("is not numeric")
def _array_type(folder: Path) -> Path:
    # One value of 1.6 GB: its type is an array.
    kind = np.dtype(("<f8", (200_000_000,)))
    return _hdf5(folder, lambda file: file.create_dataset("x", (4,), kind, chunks=None))


@_hostile("has no values, only one to fill it with")
def _fill_values(folder: Path) -> Path:
    def fill(file: Any) -> None:
        file.create_dataset("x", (100_000_000,), "f8", chunks=(1000,), fillvalue=1.5)

    return _hdf5(folder, fill)


@_hostile("is too large once it is unpacked (at x)")
def _fill_values_around_one_chunk(folder: Path) -> Path:
    def fill(file: Any) -> None:
        made = file.create_dataset("x", (10**12,), "f8", chunks=(1000,), fillvalue=1.5)
        made[:10] = 1.0

    return _hdf5(folder, fill)


@_hostile("is too large once it is unpacked (at x)")
def _narrow_numbers(folder: Path) -> Path:
    def fill(file: Any) -> None:
        made = file.create_dataset("x", (900_000_000,), "u1", chunks=(1000,))
        made[:10] = 1

    return _hdf5(folder, fill)


@_hostile("is too large once it is unpacked (at x)")
def _chunk_of_gigabytes(folder: Path) -> Path:
    def fill(file: Any) -> None:
        made = file.create_dataset(
            "x", (20,), "f8", chunks=(400_000_000,), maxshape=(None,), compression="gzip"
        )
        made.id.write_direct_chunk((0,), zlib.compress(bytes(160)))

    return _hdf5(folder, fill)


@_hostile("is damaged and cannot be read")
def _chunk_that_unpacks_to_more_than_it_may(folder: Path) -> Path:
    def fill(file: Any) -> None:
        made = file.create_dataset("x", (20,), "f8", chunks=(20,), compression="gzip")
        packer = zlib.compressobj(1)
        packed = b"".join(packer.compress(bytes(10_000_000)) for _ in range(30)) + packer.flush()
        made.id.write_direct_chunk((0,), packed)

    return _hdf5(folder, fill)


@_hostile("is not numeric")
def _long_strings(folder: Path) -> Path:
    return _hdf5(folder, lambda file: file.create_dataset("x", (4,), "S1000000000"))


@_hostile("is not numeric")
def _variable_lengths(folder: Path) -> Path:
    def fill(file: Any) -> None:
        made = file.create_dataset("x", (1000,), h5py.vlen_dtype(np.float64))
        made[:] = [np.arange(10.0)] * 1000

    return _hdf5(folder, fill)


@_hostile("the attribute MATLAB_class is too long")
def _attribute_of_gigabytes(folder: Path) -> Path:
    def fill(file: Any) -> None:
        made = file.create_dataset("x", data=np.arange(9.0))
        kind = h5py.h5t.py_create(np.dtype(("S1", (60_000,))))
        h5py.h5a.create(made.id, b"MATLAB_class", kind, h5py.h5s.create_simple((1,)))

    return _hdf5(folder, fill)


@_hostile("is another name of what stands before it")
def _cycle_of_links(folder: Path) -> Path:
    def fill(file: Any) -> None:
        first = file.create_group("a")
        first["again"] = first
        second = first.create_group("b")
        second["up"] = first

    return _hdf5(folder, fill)


@_hostile("is another name of what stands before it")
def _hard_links_at_every_level(folder: Path) -> Path:
    def fill(file: Any) -> None:
        # 30^7 paths lead to the last group.
        groups = [file.create_group(f"g{level}") for level in range(8)]
        for group, below in itertools.pairwise(groups):
            for link in range(30):
                group[f"l{link}"] = below

    return _hdf5(folder, fill)


@_hostile("holds more than 10000 names")
def _one_dataset_by_many_names(folder: Path) -> Path:
    def fill(file: Any) -> None:
        made = file.create_dataset("x", data=np.arange(20_000.0))
        for link in range(12_000):
            file[f"l{link}"] = made

    return _hdf5(folder, fill)


@_hostile("is nested too deep")
def _groups_within_groups(folder: Path) -> Path:
    return _hdf5(folder, lambda file: file.create_group("/".join("g" * 500)))


# MATLAB 5 -------------------------------------------------------------------------------------


def _mat5(folder: Path, *elements: bytes) -> Path:
    return written(folder, mat5_file(*elements), "trial.mat")


@_hostile("is damaged and ends the process")
def _type_that_does_not_exist(folder: Path) -> Path:
    # scipy's reader looks it up in a table of 20 and ends the process.
    return written(
        folder, mat5_file(mat5_array(6, (9, 1), "x", mat5_element(200, bytes(72)))), "trial.mat"
    )


@_hostile("is damaged and ends the process")
def _type_that_does_not_exist_in_a_packed_struct(folder: Path) -> Path:
    inner = mat5_array(6, (9, 1), "", mat5_element(60, bytes(72)))
    fields = mat5_element(5, struct.pack("<i", 8)) + mat5_element(1, b"a".ljust(8, b"\0"))
    packed = zlib.compress(mat5_array(2, (1, 1), "s", fields + inner))
    return _mat5(folder, mat5_element(15, packed, padded=False))


@_hostile("is damaged and cannot be read")
def _array_without_flags(folder: Path) -> Path:
    inside = mat5_element(5, bytes(16)) * 2 + mat5_element(1, b"x") + mat5_element(9, bytes(8))
    return _mat5(folder, mat5_element(14, inside))


@_hostile("is damaged and cannot be read")
def _sizes_that_are_not_there(folder: Path) -> Path:
    numbers = mat5_element(9, bytes(800))
    return written(
        folder, mat5_file(mat5_array(6, (2**31 - 1, 2**31 - 1), "x", numbers)), "trial.mat"
    )


@_hostile("GB to read")
def _length_that_is_not_there(folder: Path) -> Path:
    content = mat5_file(mat5_array(6, (100, 1), "x", mat5_element(9, bytes(800))))
    place = content.rindex(struct.pack("<II", 9, 800))
    false = content[:place] + struct.pack("<II", 9, 3_900_000_000) + content[place + 8 :]
    return written(folder, false, "trial.mat")


@_hostile("is damaged and cannot be read")
def _packed_variable_that_says_too_little(folder: Path) -> Path:
    packed = zlib.compress(struct.pack("<II", 14, 800) + bytes(200_000_000), 1)
    return _mat5(folder, mat5_element(15, packed, padded=False))


@_hostile("GB to read")
def _many_packed_variables(folder: Path) -> Path:
    numbers = mat5_element(2, bytes(3_000_000))
    inner = [mat5_array(9, (3_000_000, 1), f"x{index:02}", numbers) for index in range(50)]
    packed = [mat5_element(15, zlib.compress(one, 1), padded=False) for one in inner]
    return _mat5(folder, *packed)


@_hostile("GB to read")
def _cells_without_end(folder: Path) -> Path:
    return _mat5(folder, mat5_array(1, (2**31 - 1, 9), "x", b""))


@_hostile("x is a cell array")
def _cells_of_nothing(folder: Path) -> Path:
    cells = mat5_element(14, b"") * 300_000
    return _mat5(folder, mat5_array(1, (300_000, 1), "x", cells))


@_hostile("holds no column of numbers")
def _cells_within_cells(folder: Path) -> Path:
    inner = mat5_array(6, (1, 1), "", mat5_element(9, bytes(8)))
    for _ in range(2000):
        inner = mat5_array(1, (1, 1), "", inner)
    return _mat5(folder, inner)


# TDMS and C3D ---------------------------------------------------------------------------------


@_hostile("is damaged and cannot be read")
def _tdms_of_1e12_values(folder: Path) -> Path:
    path = written_by_impc(folder, "trial.tdms")
    content = path.read_bytes()
    samples = struct.pack("<Q", 600)
    assert content.count(samples) >= 3
    path.write_bytes(content.replace(samples, struct.pack("<Q", 10**12)))
    return path


@_hostile("says inf samples per second")
def _tdms_of_an_infinite_rate(folder: Path) -> Path:
    path = written_by_impc(folder, "trial.tdms")
    content = path.read_bytes()
    step = struct.pack("<d", 0.01)
    assert step in content
    path.write_bytes(content.replace(step, struct.pack("<d", 5e-324)))
    return path


@_hostile("inconsistent analog rate")
def _c3d_of_an_infinite_rate(folder: Path) -> Path:
    path = written_by_impc(folder, "trial.c3d")
    content = path.read_bytes()
    rate = struct.pack("<f", 100.0)
    assert rate in content
    path.write_bytes(content.replace(rate, struct.pack("<f", np.inf)))
    return path


@_hostile("frames")
def _c3d_of_frames_that_are_not_there(folder: Path) -> Path:
    path = written_by_impc(folder, "trial.c3d")
    content = bytearray(path.read_bytes())
    content[8:10] = b"\xff\xff"  # the last frame
    path.write_bytes(content)
    return path


# Workbooks ------------------------------------------------------------------------------------


def _with_sheet(folder: Path, sheet: str) -> Path:
    """A workbook of impc with another text for its sheet."""
    path = written_by_impc(folder, "trial.xlsx")
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    files["xl/worksheets/sheet1.xml"] = sheet.encode()
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


_SHEET = (
    '<worksheet xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main">{}</worksheet>'
)


@_hostile("is too large once it is unpacked (1.2 GB)")
def _zip_bomb(folder: Path) -> Path:
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


@_hostile("is damaged and cannot be read")
def _zip_that_says_too_little(folder: Path) -> Path:
    path = _with_sheet(folder, _SHEET.format(" " * 50_000_000))
    content = path.read_bytes()
    size = struct.pack("<I", len(_SHEET.format("")) + 50_000_000)
    assert content.count(size) == 2  # before the file, and in the directory
    return written(folder, content.replace(size, struct.pack("<I", 100)), "trial.xlsx")


@_hostile("GB to read")
def _cell_at_the_end_of_the_sheet(folder: Path) -> Path:
    row = '<row r="{}"><c r="{}"><v>1</v></c></row>'
    cells = row.format(1, "A1") + row.format(1_048_576, "XFD1048576")
    return _with_sheet(folder, _SHEET.format(f"<sheetData>{cells}</sheetData>"))


# An entity stands for nothing: the cell is empty.
@_hostile("has no rows of numbers")
def _entities_of_entities(folder: Path) -> Path:
    entities = ['<!ENTITY e0 "111">']
    entities += [f'<!ENTITY e{level + 1} "{f"&e{level};" * 10}">' for level in range(12)]
    cells = "<sheetData><row><c><v>&e12;</v></c></row></sheetData>"
    return _with_sheet(folder, f"<!DOCTYPE w [{''.join(entities)}]>" + _SHEET.format(cells))


@_hostile("has no rows of numbers")
def _entity_that_names_a_file(folder: Path) -> Path:
    cells = "<sheetData><row><c><v>&e;</v></c></row></sheetData>"
    declared = '<!DOCTYPE w [<!ENTITY e SYSTEM "file:///etc/passwd">]>'
    return _with_sheet(folder, declared + _SHEET.format(cells))


@_hostile("Cell limit exceeded")
def _cells_repeated_without_end(folder: Path) -> Path:
    path = folder / "trial.ods"
    ods_file(path, {"a": [[1.0, 2.0]]})
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name).decode() for name in archive.namelist()}
    many = files["content.xml"]
    for what, part in (("row", "rows"), ("cell", "columns")):
        again = f'<table:table-{what} table:number-{part}-repeated="1000000000"'
        many = many.replace(f"<table:table-{what}", again, 1)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in {**files, "content.xml": many}.items():
            archive.writestr(name, content)
    return path


# Text -----------------------------------------------------------------------------------------


@_hostile("line 1 has 399999 characters")
def _columns_without_end(folder: Path) -> Path:
    row = ",".join(["1"] * 200_000)
    return written(folder, f"{row}\n{row}\n")


@_hostile("holds no column of numbers (a0 has 1 values)")
def _headings_without_end(folder: Path) -> Path:
    heads = [*(f"a{index}" for index in range(2_000)), *["a"] * 17_000]
    return written(folder, ",".join(heads) + "\n" + ",".join(["1"] * 19_000) + "\n")


@_hostile("no rows of numbers")
def _digits_without_end(folder: Path) -> Path:
    return written(folder, "x\n" + "1" * 49_000 + "x\n")


@_hostile("no rows of numbers")
def _blanks_and_brackets_in_a_heading(folder: Path) -> Path:
    return written(folder, "a" + " " * 20_000 + "x" + "(" * 20_000 + "\n")
