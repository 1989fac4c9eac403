"""The door: which format a file is in, by its ending and its first bytes, and who reads it."""

from __future__ import annotations

import functools
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from impc.checking import checked
from impc.errors import DataError, ImpcError, InputError, OutputError
from impc.files.apart import read_apart
from impc.files.delimited import encode_delimited, read_delimited
from impc.files.disk import LARGEST, damaged, require_readable, unwritable
from impc.files.matlab import encode_matlab
from impc.files.matlab73 import HDF5_SIGNATURE
from impc.files.recorders import encode_c3d, encode_tdms
from impc.files.spreadsheet import encode_workbook

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.files.table import Table


@dataclass(frozen=True)
class Format:
    """How files of one ending are recognised, read and written."""

    # (path, most bytes that its arrays may take) -> table; of a workbook also the name of a sheet,
    # where one is asked for. Whatever it raises becomes one line.
    read: Callable[..., Table]
    encode: Callable[[Table], bytes]  # Table -> the bytes of a file
    # Whether the first kilobyte of a file is that of this format; by default, of any text: of what
    # does not begin as something else
    begins: Callable[[bytes], bool] = lambda head: not _what_it_is(head)


_WORKBOOKS = (".xlsx", ".ods")
# First bytes of what else may carry one of the endings, and what it is.
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
        With one of the endings in `FORMATS`.
    largest : int
        Bytes above which a file is refused before it is read.
    sheet : str
        Of a workbook; by default the first one with rows of numbers.

    Raises
    ------
    DataError
        When the file is missing, empty, too large, damaged, not what its ending says, or holds no
        column of numbers.

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
    suffix = _suffix(path, DataError)
    head, form = _head(path, largest), FORMATS[suffix]
    _require(source, form.begins(head), suffix, head)
    if sheet and suffix not in _WORKBOOKS:
        raise DataError(source, "has no sheets", "leave recording.sheet out")
    try:
        return form.read(path, largest, sheet) if sheet else form.read(path, largest)
    except ImpcError:
        raise
    except MemoryError:
        raise DataError(
            source, "does not fit in memory", "save only the signals that are needed"
        ) from None
    except Exception as error:  # of our own readers ValueError, of pandas any
        raise damaged(source, error) from None


@checked
def write_table(path: Path | str, table: Table) -> None:
    """Write a table in the format of the `path`, whole or not at all; .mat is written as v5.

    Raises
    ------
    OutputError
        When the ending is not known, the format cannot hold the table, or the file cannot be
        written.

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
    _write(path, FORMATS[suffix].encode(table))


def encode_table(ending: str, table: Table) -> bytes:
    """The bytes of a table in the format of an ending, a key of `FORMATS`; .mat is v5."""
    return FORMATS[_suffix(Path(f"table{ending}"), OutputError)].encode(table)


def _suffix(path: Path, error: type[InputError | OutputError]) -> str:
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        known = ", ".join(FORMATS)
        remedy = "export it as one of these"
        raise error(str(path), f"has the ending {suffix!r}, and not {known}", remedy)
    return suffix


def _head(path: Path, largest: int) -> bytes:
    """The first bytes of a file that can be read and is neither empty nor too large."""
    require_readable(path, largest)
    try:
        with path.open("rb") as file:
            return file.read(1024)
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise DataError(str(path), f"cannot be opened ({reason})", "check the path") from None


def _what_it_is(head: bytes) -> str:
    """What a file that begins like this is, as far as its first bytes say; empty if they do not."""
    return next((what for mark, what in _SIGNATURES.items() if head.startswith(mark)), "")


def _require(source: str, agrees: bool, suffix: str, head: bytes) -> None:
    if not agrees:
        found = _what_it_is(head)
        what = f"is {found}" if found else "does not begin as such a file"
        raise DataError(source, f"ends in {suffix} and {what}", "export it again")


def _read_matlab(path: Path, largest: int) -> Table:
    """v5 or v7.3: the version in the header and the HDF5 signature behind it must agree."""
    source, head = str(path), _head(path, largest)
    hdf5 = HDF5_SIGNATURE in (head[:8], head[512:520])
    version = int.from_bytes(head[124:126], "big" if head[126:128] == b"MI" else "little") >> 8
    if hdf5 and (version == 2 or head.startswith(HDF5_SIGNATURE)):
        return read_apart("matlab73", path, largest)
    _require(source, head.startswith(b"MATLAB "), ".mat", head)
    if version == 1 and not hdf5:
        return read_apart("matlab", path, largest)
    inside, said = ("7.3", "5") if hdf5 else ("5", "7.3")
    if hdf5 or version == 2:
        problem = f"says that it is version {said} and holds version {inside} or damaged data"
        raise DataError(source, problem, "save it again in MATLAB: save(..., '-v7')")
    raise DataError(source, "is of no version that MATLAB writes", "save it again with '-v7'")


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


def _write(path: Path, content: bytes) -> None:
    try:
        with tempfile.TemporaryDirectory(prefix=".impc-", dir=path.parent) as staging:
            new = Path(staging, path.name)
            new.write_bytes(content)
            os.replace(new, path)
    except OSError as error:
        raise unwritable(str(path), error, "give another path") from None


#: By ending: the formats that are read and written. A new one is a line here.
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
