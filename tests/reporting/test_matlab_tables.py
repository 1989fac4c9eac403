"""Tables read back as MATLAB reads them."""

from __future__ import annotations

import io
import re
from typing import Any

import numpy as np
import scipy.io

from impc.reporting.document import TextTable, matlab_tables


def read(tables: dict[str, TextTable]) -> dict[str, Any]:
    load: Any = scipy.io.loadmat  # its stubs know paths only
    found: dict[str, Any] = load(io.BytesIO(matlab_tables(tables)))
    return found


def test_tables_are_structs_of_columns() -> None:
    rows = [("K.u.x", 0.1 + 0.2, None, 3), ("Δ", float("nan"), 2.5, 4)]
    table = TextTable("", ("number", "value", "high %", "1st"), rows)
    found = read({"gain": table, "no rows": TextTable("", ("a",), [])})
    gain = found["gain"][0, 0]
    assert gain.dtype.names == ("number", "value", "high__", "x1st")
    assert [cell[0, 0].item() for cell in gain["number"][:, None]] == ["K.u.x", "Δ"]
    np.testing.assert_array_equal(gain["value"], [[0.1 + 0.2], [np.nan]])
    np.testing.assert_array_equal(gain["high__"], [[np.nan], [2.5]])
    assert gain["x1st"].tolist() == [[3.0], [4.0]]
    assert found["no_rows"][0, 0]["a"].size == 0


def test_names_are_matlabs_and_differ() -> None:
    heads = ["a b", "a_b", "a-b", "x" * 80, "x" * 70, "", "_a", "7", "é"]
    table = TextTable("", heads, [tuple(range(len(heads)))])
    found = read({"t": table})["t"][0, 0]
    names = found.dtype.names
    assert len(set(names)) == len(heads)
    assert all(re.fullmatch("[A-Za-z][A-Za-z0-9_]{0,62}", name) for name in names)
    assert [float(found[name][0, 0]) for name in names] == list(range(len(heads)))
