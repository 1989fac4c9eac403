"""Tables of recordings or participants of a study: .csv, .tsv, .xlsx or .ods."""

from __future__ import annotations

import csv
import unicodedata
from dataclasses import dataclass
from typing import TYPE_CHECKING

from impc.errors import InputError
from impc.files.apart import cells_apart

if TYPE_CHECKING:
    from pathlib import Path

# Largest file in bytes; 100 000 participants of 100 characters are 10 MB.
_LARGEST = 100_000_000
_BETWEEN = frozenset(" .+-_")
_LONGEST = 64  # Characters of a name


@dataclass(frozen=True)
class Sheet:
    """The rows of a table."""

    name: str  # Name of its file
    heads: tuple[str, ...]  # Names of the columns
    rows: tuple[dict[str, str], ...]  # Column name -> stripped text

    @property
    def where(self) -> str:
        """Name of the table in messages."""
        return f"table {self.name}"


def read_sheet(path: Path) -> Sheet:
    """Read the table at `path`."""
    where = f"table {path.name}"
    lines = _cells(where, path)
    if len(lines) < 2:
        raise InputError(where, "has no rows", "write a row of column names, then the data")
    heads = tuple(cell.strip() for cell in lines[0])
    for name in heads:
        if not name or heads.count(name) > 1:
            problem = (
                f"has {heads.count(name)} columns {name!a}" if name else "has an unnamed column"
            )
            raise InputError(where, problem, "give each column a unique name")
    for number, line in enumerate(lines[1:], start=2):
        if len(line) != len(heads):
            raise InputError(
                where, f"row {number} has {len(line)} cells, but there are {len(heads)} columns",
                "quote cells with decimal commas, or separate cells by semicolons",
            )  # fmt: skip
    rows = (dict(zip(heads, map(str.strip, line), strict=True)) for line in lines[1:])
    return Sheet(path.name, heads, tuple(rows))


def _cells(where: str, path: Path) -> list[list[str]]:
    """All lines that are not empty."""
    try:
        if path.exists() and not path.is_file():
            raise InputError(where, "is not a regular file", "check the path")
        if path.stat().st_size > _LARGEST:
            raise InputError(where, f"has more than {_LARGEST // 1_000_000} MB", "check the path")
        if path.suffix.lower() in (".xlsx", ".ods"):
            return [row for row in cells_apart(path, _LARGEST) if any(row)]
        content = path.read_bytes()
    except OSError as error:
        raise InputError(where, f"cannot be read ({error.strerror})", "check the path") from None
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:  # as a German Excel writes it
        text = content.decode("cp1252", "replace")
    if "\0" in text:
        raise InputError(where, "contains a NUL character", "save it again as UTF-8 text")
    first = text.partition("\n")[0]
    delimiter = "\t" if "\t" in first else ";" if ";" in first else ","
    try:
        return [line for line in csv.reader(text.splitlines(), delimiter=delimiter) if any(line)]
    except csv.Error as error:
        raise InputError(where, f"cannot be read ({error})", "save it again as CSV") from None


def checked_name(where: str, what: str, text: str) -> str:
    """Strip and normalise (NFC) a name; InputError if it is not safe."""
    name = unicodedata.normalize("NFC", text.strip())
    bad = [letter for letter in name if not (letter.isalnum() or letter in _BETWEEN)]
    if bad:
        raise InputError(
            f"{where}: {what} {name[:_LONGEST]!a}", f"contains {bad[0]!a}",
            "use letters, digits, spaces and . + - _",
        )  # fmt: skip
    if name and not name[0].isalnum():
        raise InputError(
            f"{where}: {what} {name!a}", f"begins with {name[0]!a}", "begin with a letter or digit"
        )
    if len(name) > _LONGEST:
        raise InputError(
            f"{where}: {what} {name[:_LONGEST]!a}...", f"has {len(name)} characters",
            f"use at most {_LONGEST}",
        )  # fmt: skip
    return name
