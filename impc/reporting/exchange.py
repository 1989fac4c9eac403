"""Results for other programs: a .mat file for MATLAB, and one long table for SPSS and R.

A row of the long table is one number: its labels, `quantity` (K, Q, R, vaf, ...), `row` and
`column` in the quantity by their names, estimate, interval, and whether it is identified.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from impc.arrays import Array
from impc.model.plant import UNKNOWN
from impc.reporting.finding import Finding
from impc.reporting.rendering import plain

#: Columns of the long table; those of a label are empty where a study has none.
LONG = (
    "subject", "group", "visit", "condition", "method",
    "quantity", "row", "column", "unit", "estimate", "low", "high", "known",
)  # fmt: skip
_LABELS, _ENDS = LONG[:5], ("low", "high", "identified")
# First bytes of a .mat file: a description, which would have the date.
_HEADER = b"MATLAB 5.0 MAT-file, results of impc".ljust(116)
# Longest name of a field in MATLAB; rows above which texts of a table are numbered.
_LONGEST, _MANY = 63, 2_000


def entries(
    quantity: str, rows: Sequence[str], columns: Sequence[str], matrix: Array
) -> dict[str, float]:
    """Entries of a `matrix` by name, ``quantity.row.column``."""
    return {
        f"{quantity}.{row}.{column}": float(value)
        for row, line in zip(rows, matrix, strict=True)
        for column, value in zip(columns, line, strict=True)
    }


def long_rows(
    values: Mapping[Any, Any], units: Mapping[str, str], labels: Mapping[Any, Any]
) -> list[dict[str, Any]]:
    """Rows of the long table from numbers by name, ``quantity.row.column``; texts are left out.

    The ends of an interval are ``quantity_low.row.column`` and ``quantity_high...``, and
    ``quantity_identified...`` says whether the number is identified.
    """
    found = []
    for name, value in values.items():
        quantity, _, place = name.partition(".")
        stem, _, end = quantity.rpartition("_")
        if isinstance(value, str) or (end in _ENDS and _joined(stem, place) in values):
            continue
        low, high, known = (values.get(_joined(f"{quantity}_{one}", place)) for one in _ENDS)
        row, column = [*re.split(r"\.(?=[^\W\d])", place, maxsplit=1), ""][:2]
        found.append({
            **{label: labels.get(label, "") for label in _LABELS},
            "quantity": quantity, "row": row, "column": column, "unit": units.get(name, UNKNOWN),
            "estimate": np.nan if value is None else float(value),
            "low": np.nan if low is None else float(low),
            "high": np.nan if high is None else float(high),
            "known": "" if known is None else "yes" if known else "no",
        })  # fmt: skip
    return found


def _joined(quantity: str, place: str) -> str:
    return f"{quantity}.{place}" if place else quantity


def long_finding(rows: Sequence[Any]) -> Finding:
    """The long table as a file and a sheet of the workbook."""
    caption = "Row: one number, for SPSS and R. Known: whether the recordings identify it."
    return Finding("long", pd.DataFrame(rows, columns=list(LONG)), caption)


def mat_bytes(content: Mapping[str, Any], tables: Mapping[str, pd.DataFrame]) -> bytes:
    """The `content` of result.json and all `tables` as nested structs of a .mat file (version 5).

    Names become valid in MATLAB as its ``matlab.lang.makeValidName`` makes them. None is empty, or
    NaN among numbers. Texts of long tables are numbered from 1; NAME_labels lists them.
    """
    import scipy.io  # noqa: PLC0415  # only needed here

    save: Any = scipy.io.savemat  # its stubs know paths only

    structs = {name: {**_columns(table)} for name, table in tables.items()}
    stream = io.BytesIO()
    found = _struct({**content, "tables": structs})
    save(stream, found, long_field_names=True, do_compression=True, oned_as="column")
    return _HEADER + stream.getvalue()[len(_HEADER) :]


def _columns(table: pd.DataFrame) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, column in table.items():
        found[str(name)] = column.to_numpy()
        if len(column) > _MANY and not pd.api.types.is_numeric_dtype(column):
            codes, texts = pd.factorize(column)
            found |= {str(name): codes + 1.0, f"{name}_labels": list(texts)}
    return found


def _struct(content: Mapping[str, Any]) -> dict[str, Any]:
    """Fields with valid, distinct names."""
    found: dict[str, Any] = {}
    for key, value in content.items():
        name = re.sub(r"\W", "_", str(key), flags=re.ASCII)
        name = (name if re.match("[A-Za-z]", name) else f"x{name}")[:_LONGEST]
        count = 1
        while name in found:
            count += 1
            name = f"{name[: _LONGEST - 4]}_{count}"
        found[name] = _value(value)
    return found


def _value(value: Any) -> Any:
    if hasattr(value, "items"):
        return _struct(value)
    if value is None:
        return np.empty((0, 0))
    if isinstance(value, list | tuple | np.ndarray):
        return _array(value)
    if isinstance(value, str):
        return plain(value)  # file names that are not UTF-8
    return value if isinstance(value, bool | np.bool_) else float(value)


def _array(values: Any) -> Any:
    """Numbers as an array, all else as a cell array."""
    kinds = {type(one) for one in values}
    if not kinds & {str, dict}:
        try:
            return np.array(values, dtype=bool if kinds and kinds <= {bool, np.bool_} else float)
        except (TypeError, ValueError):  # rows of texts, or of different lengths
            pass
    cells = np.empty((len(values), 1), dtype=object)
    for place, one in enumerate(values):
        cells[place, 0] = _value(one)
    return cells
