"""Tables of recordings or participants of a study: .csv, .tsv, .xlsx or .ods."""

from __future__ import annotations

import csv
import re
import unicodedata
from typing import TYPE_CHECKING

from impc.errors import InputError
from impc.files.apart import cells_apart
from impc.files.disk import require_readable

if TYPE_CHECKING:
    from pathlib import Path

# Largest file in bytes; 100 000 participants of 100 characters are 10 MB.
_LARGEST = 100_000_000
_NAME = re.compile(r"([^\W_][\w .+-]{0,63})?")


def read_sheet(path: Path) -> list[dict[str, str]]:
    """Rows of the table at `path`: name of a column -> stripped text."""
    where = f"table {path.name}"
    lines = [[cell.strip() for cell in line] for line in _cells(path) if any(line)]
    if len(lines) < 2:
        raise InputError(where, "has no rows", "write a row of column names, then the data")
    heads = lines[0]
    if "" in heads or len({*heads}) < len(heads):
        twice = next((name for name in heads if heads.count(name) > 1), "")
        problem = f"has two columns {twice!a}" if twice else "has an unnamed column"
        raise InputError(where, problem, "give each column a unique name")
    for number, line in enumerate(lines[1:], start=2):
        if len(line) != len(heads):
            raise InputError(
                where, f"row {number} has {len(line)} cells, but there are {len(heads)} columns",
                "quote cells with decimal commas, or separate cells by semicolons",
            )  # fmt: skip
    return [dict(zip(heads, line, strict=True)) for line in lines[1:]]


def _cells(path: Path) -> list[list[str]]:
    require_readable(path, _LARGEST, InputError)
    if path.suffix.lower() in (".xlsx", ".ods"):
        return cells_apart(path, _LARGEST)
    try:
        content = path.read_bytes()
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:  # as a German Excel writes it
            text = content.decode("cp1252", "replace")
        first = text.partition("\n")[0]
        delimiter = "\t" if "\t" in first else ";" if ";" in first else ","
        return [*csv.reader(text.splitlines(), delimiter=delimiter)]
    except (OSError, csv.Error) as error:
        raise InputError(str(path), f"cannot be read ({error})", "save it again as CSV") from None


def checked_name(where: str, what: str, text: str) -> str:
    """Strip and normalise (NFC) a name; InputError if it is not safe."""
    name = unicodedata.normalize("NFC", text.strip())
    if not _NAME.fullmatch(name):
        raise InputError(
            f"{where}: {what}", f"{name[:70]!a} is no name",
            "use at most 64 letters, digits, spaces and . + - _, beginning with a letter or digit",
        )  # fmt: skip
    return name
