"""Read result.json (docs/ref/results.md), one or many; `impc.reporting.document` writes it.

`schema` increases when a key changes its meaning, so that programs can detect it.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from impc.errors import DataError
from impc.files.disk import require_ordinary

if TYPE_CHECKING:
    import pandas as pd

#: Version of the files that are written now.
SCHEMA = 10

Matrix = list[list[float]]
# Columns around those of each fit in a table of fits (`summary` in impc/studies/fit/data.py).
_FIRST = ("subject", "visit", "condition", "trials", "verdict", "headline")
_LAST = ("reason", "made", "folder", "note")


class MethodRecord(msgspec.Struct, frozen=True):
    """Result of one method in result.json.

    Attributes
    ----------
    seconds : float
        Run time of the method in s.
    K : list of list of float
        Feedback gain (m, n) in SI units; null without a gain.
    S : list of list of float
        Metric (m, m) of the input in SI units; null without a gain.
    Q : list of list of float
        State weight (n, n), scaled to R[0][0] = 1; null without weights.
    R : list of list of float
        Input weight (m, m), scaled to R[0][0] = 1; null without weights.
    status : str
        How the method ended: "explained", "settled", "stopped", "gain only" or "none".
    reason : str
        Explanation if there is no result, or if weights fit worse than the gain; else empty.
    """

    seconds: float
    K: Matrix | None = None
    S: Matrix | None = None
    Q: Matrix | None = None
    R: Matrix | None = None
    status: str = ""
    reason: str = ""


class ResultFile(msgspec.Struct, frozen=True):
    """Content of result.json of any command.

    Attributes
    ----------
    schema : int
        Version of the meaning of the keys.
    command : str
        Command line, without folders.
    made : str
        Date and time (UTC, ISO 8601).
    versions : dict
        Versions of Python and of the packages that compute.
    files : list of str
        Names of the recordings.
    sha256 : dict
        SHA-256 of all inputs; null if there are none.
    methods : dict
        `MethodRecord` by method (`impc fit`, `impc compare`, `impc.report`; else empty).
    content : dict
        Whole file as parsed JSON (only in Python).
    """

    schema: int
    command: str
    made: str
    versions: dict[str, str]
    files: list[str]
    sha256: dict[str, Any] | None
    methods: dict[str, MethodRecord] = {}
    content: dict[str, Any] = {}

    def table(self, name: str) -> pd.DataFrame:
        """Return a table of the report by its `name`, which is also that of its CSV file.

        Parameters
        ----------
        name : str
            For example "gain" of `impc fit`.

        Returns
        -------
        pandas.DataFrame
            Numbers in the units of the plant; NaN where there is none.

        Raises
        ------
        DataError
            If the result has no such table.
        """
        import pandas as pd  # noqa: PLC0415  # takes a third of a second

        found = self.content.get("findings", {})
        known = [key for key, item in found.items() if "table" in item]
        if name not in known:
            raise DataError(
                "result", f"has no table {name!r}", f"choose from {', '.join(known) or 'none'}"
            )
        return pd.DataFrame(found[name]["table"])


def read_content(file: Path) -> dict[str, Any]:
    """Parsed content of a JSON file that this version of impc wrote."""
    try:
        require_ordinary(file)
        content = json.loads(file.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise _refused(
            file, f"is not a result file ({getattr(error, 'strerror', None) or error})"
        ) from None
    if not isinstance(content, dict):
        raise _refused(file, "is not a result file (no JSON object)")
    schema = content.get("schema", 1)
    if schema != SCHEMA:
        raise _refused(
            file, f"was written by another version of impc (schema {schema}, not {SCHEMA})"
        )
    return content


def read_result(place: Path) -> ResultFile:
    """Result of a command from its folder or its result.json."""
    file = place / "result.json" if os.path.isdir(place) else place
    content = read_content(file)
    try:
        return msgspec.convert({**content, "content": content}, ResultFile)
    except msgspec.ValidationError as error:
        raise _refused(file, f"is not a result file ({error})") from None


def results(root: Path | str) -> pd.DataFrame:
    """Table of the fits in a folder and below, newest first; `note` says why a row is empty."""
    return results_and_origins(root)[0]


def results_and_origins(root: Path | str) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The table `results`, and one with command, versions and SHA-256 of the inputs of each fit."""
    import pandas as pd  # noqa: PLC0415  # takes a third of a second

    rows, origins = list[dict[str, Any]](), list[dict[str, Any]]()
    for file in sorted(Path(root).rglob("result.json")):
        place = {"folder": file.parent.relative_to(root).as_posix()}
        try:
            found = read_result(file)
            row = msgspec.convert(found.content.get("summary"), dict[str, str | float | None])
            row = {name: float("nan") if one is None else one for name, one in row.items()}
        except DataError as error:
            rows.append(place | {"made": "", "note": error.problem})
        except msgspec.ValidationError:  # of another command
            rows.append(place | {"made": found.made, "note": f"no fit, but {found.command}"})
        else:
            rows.append(row | {"made": found.made, "note": ""} | place)
            names = ("made", "command", "versions", "sha256")
            origins.append(place | {name: getattr(found, name) for name in names})
    rows.sort(key=lambda row: (row["note"] == "", row["made"]), reverse=True)
    heads = dict.fromkeys([*_FIRST, *(name for row in rows for name in row if name not in _LAST)])
    made_of = pd.json_normalize(origins, sep=" ").astype(str)
    return pd.DataFrame(rows, columns=[*heads, *_LAST]), made_of


def _refused(file: Path, problem: str) -> DataError:
    return DataError(f"file {file}", problem, "repeat the command that wrote it")
