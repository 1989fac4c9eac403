"""result.json of every command: what is in each, checked when it is read (docs/results.md).

Written by `impc.reporting.document`. `schema` counts changes of a key's meaning: a program that
reads results sees from it whether it knows them.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from impc.checking import checked
from impc.errors import DataError
from impc.files.disk import require_ordinary

if TYPE_CHECKING:
    import pandas as pd

#: Of the files that are written now. Before the first one that has a number there were others.
SCHEMA = 3

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


@checked
def read_result(path: str | Path) -> ResultFile:
    """Read the result of a command, from its folder or its result.json.

    Parameters
    ----------
    path : str or Path
        The folder or the file.

    Raises
    ------
    DataError
        When there is none, it is damaged, or another version of impc wrote it.

    Examples
    --------
    >>> import tempfile
    >>> import control
    >>> import impc
    >>> plant = impc.Plant(control.ss([[0.9]], [[1]], [[1]], 0, 1))
    >>> bounds = impc.Bounds(plant, u_min=-0.3, u_max=0.3)
    >>> truth = impc.Controller(plant, impc.Weights(1, 1), bounds, horizon=3)
    >>> trial = impc.Recording(plant, truth.simulate([1.0], steps=20).x)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     files = impc.report(impc.estimate(impc.Problem(plant, bounds, 3, [trial])), folder)
    ...     found = impc.read_result(folder)
    >>> found.methods["inverse_mpc"].status, found.content["states"]
    ('explained', ['x[0]'])
    """
    place = Path(path)
    file = place / "result.json" if os.path.isdir(place) else place
    try:
        require_ordinary(file)
        content = msgspec.json.decode(file.read_bytes(), type=dict[str, Any])
    except (OSError, msgspec.DecodeError, RecursionError) as error:
        raise _refused(
            file, f"is no result ({getattr(error, 'strerror', None) or error})"
        ) from None
    schema = content.get("schema", 1)
    if schema != SCHEMA:
        raise _refused(file, f"is of another version of impc (schema {schema}, not {SCHEMA})")
    try:
        return msgspec.convert({**content, "content": content}, ResultFile)
    except msgspec.ValidationError as error:
        raise _refused(file, f"is no result ({error})") from None


def _refused(file: Path, problem: str) -> DataError:
    return DataError(f"file {file}", problem, "run the command that wrote it again")
