"""File formats: recognised by ending and first bytes, and passed to their readers."""

from __future__ import annotations

import functools
import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from impc.checking import checked
from impc.errors import DataError, ImpcError, InputError, OutputError
from impc.files.apart import read_apart
from impc.files.delimited import encode_delimited, read_delimited
from impc.files.disk import LARGEST, damaged, require_readable, unwritable
from impc.files.matlab import HDF5_SIGNATURE, encode_matlab
from impc.files.recorders import encode_c3d, encode_tdms
from impc.files.spreadsheet import encode_workbook
from impc.files.table import Table


@dataclass(frozen=True)
class Format:
    """How files of one ending are recognised, read and written."""

    # (path, largest size of its arrays in bytes[, sheet of a workbook]) -> table
    read: Callable[..., Table]
    encode: Callable[[Table], bytes]  # table -> content of a file
    # Whether the first kilobyte is that of this format; default: not that of a known other one
    begins: Callable[[bytes], bool] = lambda head: not _what_it_is(head)


_WORKBOOKS = (".xlsx", ".ods")
# First bytes of other kinds of files that occur with these endings.
_SIGNATURES = {
    b"PK\x03\x04": "a zip archive or an Excel workbook",
    b"\xd0\xcf\x11\xe0": "an Excel workbook that is old or locked by a password",
    b"MATLAB ": "a MATLAB file",
    b"TDSm": "a TDMS file",
    b"TDSh": "a TDMS index",
    HDF5_SIGNATURE: "an HDF5 file",
    b"\x1f\x8b": "a gzip archive",
    b"\x80\x04\x95": "a Python pickle",
    b"\x93NUMPY": "a numpy file",
    b"%PDF": "a PDF",
}


@checked
def read_table(path: Path | str, largest: int = LARGEST, sheet: str = "") -> Table:
    r"""Read the columns of a recording.

    Parameters
    ----------
    path : Path or str
        File with one of the supported endings: .csv, .tsv, .txt, .lvm, .sto, .mot, .trc, .xlsx,
        .ods, .mat, .tdms or .c3d.
    largest : int
        Largest size in bytes of the file, and of its arrays.
    sheet : str
        Sheet of workbooks; by default the first one with rows of numbers.

    Returns
    -------
    Table
        Numeric columns by name, with the units and the sampling rate that the file states.

    Raises
    ------
    DataError
        If the file is missing, empty, too large or damaged, is not what its ending says, or has
        no column of numbers.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import impc
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "lab.csv")
    ...     _ = path.write_text("t;tilt\n0,00;0,5\n0,01;0,6\n")
    ...     found = impc.read_table(path)
    >>> {name: column.tolist() for name, column in found.columns.items()}
    {'t': [0.0, 0.01], 'tilt': [0.5, 0.6]}
    """
    source, path = str(path), Path(path)
    try:
        form = recognised(path, largest)
        named = sheet and path.suffix.lower() in _WORKBOOKS
        return form.read(path, largest, sheet) if named else form.read(path, largest)
    except ImpcError as error:
        error.at(source)
        raise
    except MemoryError:
        raise DataError(
            source, "does not fit in memory", "save only the signals that are needed"
        ).at(source) from None
    except Exception as error:  # ValueError of our readers, anything of pandas
        raise damaged(source, error).at(source) from None


def recognised(path: Path, largest: int = LARGEST) -> Format:
    """Format of a file by its ending and first kilobyte; DataError if there is none."""
    suffix = _suffix(path, DataError)
    head, form = _head(path, largest), FORMATS[suffix]
    _require(str(path), form.begins(head), suffix, head)
    return form


@checked
def write_table(path: Path | str, table: Table) -> None:
    """Write a table atomically in the format that the ending of `path` names; .mat is v5.

    Parameters
    ----------
    path : Path or str
        File to write.
    table : Table
        Columns, with units if the format can store them.

    Raises
    ------
    OutputError
        If the ending is unknown, the format cannot hold the table, or writing fails.

    Examples
    --------
    >>> import tempfile
    >>> import impc
    >>> table = impc.make_table("simulated", {"t": [0, 0.01], "tilt": [0.5, 0.6]}, {"tilt": "deg"})
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     impc.write_table(f"{folder}/trial.mat", table)
    ...     impc.read_table(f"{folder}/trial.mat").columns["tilt"].tolist()
    [0.5, 0.6]
    """
    path = Path(path)
    suffix = _suffix(path, OutputError)
    write_file(path, FORMATS[suffix].encode(table))


def encode_table(ending: str, table: Table) -> bytes:
    """Content of a file of that ending (a key of `FORMATS`) with the table; .mat is v5."""
    return FORMATS[_suffix(Path(f"table{ending}"), OutputError)].encode(table)


def _suffix(path: Path, error: type[InputError | OutputError]) -> str:
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        known = ", ".join(FORMATS)
        remedy = "export it in one of these formats"
        raise error(str(path), f"has the ending {suffix!r}, not one of {known}", remedy)
    return suffix


def _head(path: Path, largest: int) -> bytes:
    """First kilobyte of a file, after checking that it is readable, not empty, not too large."""
    require_readable(path, largest)
    try:
        with path.open("rb") as file:
            return file.read(1024)
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise DataError(str(path), f"cannot be opened ({reason})", "check the path") from None


def _what_it_is(head: bytes) -> str:
    """Kind of file that begins with `head`; empty if it is not recognised."""
    return next((what for mark, what in _SIGNATURES.items() if head.startswith(mark)), "")


def _require(source: str, agrees: bool, suffix: str, head: bytes) -> None:
    if not agrees:
        found = _what_it_is(head)
        what = f"is {found}" if found else "does not begin as such a file"
        raise DataError(source, f"ends in {suffix} and {what}", "export it again")


def _read_matlab(path: Path, largest: int) -> Table:
    """Read v5 or v7.3, which is HDF5, perhaps behind a header."""
    head = _head(path, largest)
    hdf5 = HDF5_SIGNATURE in (head[:8], head[512:520])
    _require(str(path), hdf5 or head.startswith(b"MATLAB "), ".mat", head)
    return read_apart("matlab73" if hdf5 else "matlab", path, largest)


def _delimited(ending: str) -> Format:
    return Format(read_delimited, lambda table: encode_delimited(table, ending))


def _spreadsheet(encode: Callable[[Table], bytes]) -> Format:
    return Format(
        functools.partial(read_apart, "spreadsheet"),
        encode,
        lambda head: head.startswith(b"PK\x03\x04"),
    )


def _no_ods(table: Table) -> bytes:
    raise OutputError(
        table.source, "cannot be written as .ods", "write .xlsx, which opens there too"
    )


def write_file(path: Path, content: bytes) -> None:
    """Write `content` atomically to `path` in an existing folder."""
    try:
        with tempfile.TemporaryDirectory(prefix=".impc-", dir=path.parent) as staging:
            new = Path(staging, path.name)
            new.write_bytes(content)
            os.replace(new, path)
    except OSError as error:
        raise unwritable(str(path), error, "give another path") from None


#: Supported formats by ending.
FORMATS: dict[str, Format] = {
    ".csv": _delimited(".csv"),
    ".tsv": _delimited(".tsv"),
    ".txt": _delimited(".txt"),
    ".lvm": _delimited(".lvm"),
    ".sto": _delimited(".sto"),
    ".mot": _delimited(".mot"),
    ".trc": _delimited(".trc"),
    ".xlsx": _spreadsheet(encode_workbook),
    ".ods": _spreadsheet(_no_ods),
    ".mat": Format(_read_matlab, encode_matlab, lambda _: True),
    ".tdms": Format(
        functools.partial(read_apart, "tdms"), encode_tdms, lambda head: head.startswith(b"TDSm")
    ),
    ".c3d": Format(
        functools.partial(read_apart, "c3d"), encode_c3d, lambda head: head[1:2] == b"\x50"
    ),
}
