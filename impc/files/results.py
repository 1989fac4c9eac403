"""result.json of every command: what is in each, checked when it is read (docs/results.md).

Written by `impc.reporting.document`. `schema` counts changes of a key's meaning: a program that
reads results sees from it whether it knows them.
"""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING, Any

import msgspec

from impc.errors import DataError
from impc.files.disk import require_ordinary

if TYPE_CHECKING:
    from pathlib import Path

    import pandas as pd

#: Of the files that are written now. Before the first one that has a number there were others.
SCHEMA = 7

Matrix = list[list[float]]


class MethodRecord(msgspec.Struct, frozen=True):
    """What a method found, as result.json has it."""

    seconds: float  # Of the method, s
    K: Matrix | None = None  # Gain (m, n) and metric (m, m), in SI units; None without a gain
    S: Matrix | None = None
    Q: Matrix | None = None  # Weights (n, n) and (m, m), at R[0][0] = 1; None without weights
    R: Matrix | None = None
    # How the method ended (`impc.inverse.estimates.Status`), and why without an answer; empty for
    # the methods of the example, which end in an answer
    status: str = ""
    reason: str = ""


class ResultFile(msgspec.Struct, frozen=True):
    """result.json of any command."""

    schema: int  # Which version of docs/results.md it follows
    command: str  # The command line, without folders
    made: str  # Date and time, UTC, ISO 8601
    versions: dict[str, str]  # Of Python and of the packages that compute
    files: list[str]  # Names of the recordings
    sha256: dict[str, Any] | None  # Digests of all files that went in
    # Of `impc fit`, `impc compare` and `impc.report`; empty for the other commands
    methods: dict[str, MethodRecord] = {}
    content: dict[str, Any] = {}  # All of the file, as JSON has it

    def table(self, name: str) -> pd.DataFrame:
        """The table of a finding of the page, by its `name`, which is also that of its CSV file.

        Parameters
        ----------
        name : str
            Such as "gain", of `impc fit`.

        Returns
        -------
        pandas.DataFrame
            Numbers in the units of the plant; NaN where there is none.

        Raises
        ------
        DataError
            When the result has no such table.
        """
        import pandas as pd  # noqa: PLC0415  # a third of a second

        found = self.content.get("findings", {})
        known = [key for key, item in found.items() if "table" in item]
        if name not in known:
            raise DataError(
                "result", f"has no table {name!r}", f"choose from {', '.join(known) or 'none'}"
            )
        return pd.DataFrame(found[name]["table"])


def read_content(file: Path) -> dict[str, Any]:
    """What stands in a file of JSON that this version of impc wrote."""
    try:
        require_ordinary(file)
        content = json.loads(file.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise _refused(
            file, f"is no result ({getattr(error, 'strerror', None) or error})"
        ) from None
    if not isinstance(content, dict):
        raise _refused(file, "is no result (no names at its top)")
    schema = content.get("schema", 1)
    if schema != SCHEMA:
        raise _refused(file, f"is of another version of impc (schema {schema}, not {SCHEMA})")
    return content


def read_result(place: Path) -> ResultFile:
    """The result of a command, from its folder or its result.json."""
    file = place / "result.json" if os.path.isdir(place) else place
    content = read_content(file)
    try:
        return msgspec.convert({**content, "content": content}, ResultFile)
    except msgspec.ValidationError as error:
        raise _refused(file, f"is no result ({error})") from None


def _refused(file: Path, problem: str) -> DataError:
    return DataError(f"file {file}", problem, "run the command that wrote it again")
