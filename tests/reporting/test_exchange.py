"""The .mat file and the long table, read back and compared with result.json."""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
import pandas as pd
import pytest
import scipy.io

from impc.reporting.exchange import LONG, long_rows, mat_bytes
from impc.reporting.provenance import Provenance
from impc.studies.example.cases import CaseResult
from impc.studies.example.report import example_report


@pytest.fixture(scope="module")
def files(case_a: CaseResult) -> dict[str, bytes]:
    report = example_report([case_a], Provenance("plants:yalmip_example", "impc example --case A"))
    return report.files()


def read(content: bytes) -> Any:
    load: Any = scipy.io.loadmat  # its stubs know paths only
    return load(io.BytesIO(content), simplify_cells=True)


def same(found: Any, wanted: Any) -> None:
    """Whether a value of the .mat file is that of result.json; null is NaN or empty."""
    if isinstance(wanted, dict):
        assert len(found) == len(wanted)
        for one, other in zip(found.values(), wanted.values(), strict=True):
            same(one, other)
    elif wanted is None or wanted == "":
        assert np.size(found) == 0 or np.isnan(found)
    elif isinstance(wanted, str):
        assert found == wanted
    elif isinstance(wanted, list) and any(isinstance(one, str | dict) for one in wanted):
        for one, other in zip(np.atleast_1d(found), wanted, strict=True):
            same(one, other)
    else:
        number = np.array(wanted, dtype=float)
        np.testing.assert_array_equal(np.ravel(np.asarray(found, float)), np.ravel(number))


def test_matlab_gets_the_numbers_of_result_json(files: dict[str, bytes]) -> None:
    found, wanted = read(files["results.mat"]), json.loads(files["result.json"])
    for name, value in wanted.items():
        if name != "findings":
            same(found[name], value)
    for name, finding in wanted["findings"].items():
        table = found["tables"][name.replace("-", "_")]
        assert list(table) == list(finding["table"])
        for column, values in finding["table"].items():
            same(table[column], values)
    long = pd.read_csv(io.BytesIO(files["long.csv"]))
    np.testing.assert_array_equal(found["tables"]["long"]["estimate"], long["estimate"])
    assert b"Created on" not in files["results.mat"]  # the same results, the same bytes


def test_the_long_table_has_the_numbers_of_result_json(files: dict[str, bytes]) -> None:
    table = pd.read_csv(io.BytesIO(files["long.csv"]))
    assert list(table.columns) == list(LONG)
    methods = json.loads(files["result.json"])["cases"]["A"]["methods"]
    count = 0
    for name, method in methods.items():
        own = table[table["method"] == name].set_index(["quantity", "row", "column"])["estimate"]
        if method["K"] is not None:
            assert [own["K", "u", one] for one in ("x1", "x2")] == method["K"][0]
        if method["Q"] is not None:
            assert own["Q", "x2", "x1"] == method["Q"][1][0]
            count += 1
        vaf = table[(table["method"] == name) & (table["quantity"] == "vaf")]
        assert vaf["estimate"].fillna(-1).tolist() == [
            -1 if one is None else one for one in method["vaf"].values()
        ]
    assert count > 3
    assert set(table.loc[table["quantity"] == "vaf", "unit"]) == {"%"}
    assert set(table["condition"]) == {"A"}


def test_an_interval_is_in_the_row_of_its_number() -> None:
    values = {
        "K.u.x": 2.0,
        "K_low.u.x": 1.0,
        "K_high.u.x": np.inf,
        "K_identified.u.x": False,
        "mass": 70.0,
        "mass_low": 69.0,
        "u_low.x": 3.0,
        "headline": "text",
        "none": None,
        "cost.a - 0.5 b": 1.0,
    }
    rows = long_rows(values, {"K.u.x": "N"}, {"subject": "S01", "group": "a", "trials": "3"})
    assert [(row["quantity"], row["row"], row["column"]) for row in rows] == [
        ("K", "u", "x"), ("mass", "", ""), ("u_low", "x", ""), ("none", "", ""),
        ("cost", "a - 0.5 b", ""),
    ]  # fmt: skip
    first = rows[0]
    assert (first["subject"], first["group"], first["visit"]) == ("S01", "a", "")
    assert (first["estimate"], first["low"], first["high"], first["known"]) == (2, 1, np.inf, "no")
    assert first["unit"] == "N"
    assert rows[1]["low"] == 69
    assert np.isnan(rows[3]["estimate"])


def test_names_are_valid_and_distinct_in_matlab() -> None:
    table = pd.DataFrame({"trial": ["b.csv", "a.csv", "b.csv"] * 1000, "x[0]": np.arange(3000.0)})
    content = {"x[0]": 1, "x(0)": [1, None], "_a": {}, "9 b": ["a", "b"], "é" * 70: True,
               "rows": [[1], [2, 3]], "list": [{"a": 1}, {"b": None}], "empty": []}  # fmt: skip
    found = read(mat_bytes(content, {"long-table": table}))
    assert [name for name in found if name[:2] != "__"] == [
        "x_0_", "x_0__2", "x_a", "x9_b", "x" + "_" * 62, "rows", "list", "empty", "tables"
    ]  # fmt: skip
    np.testing.assert_array_equal(found["x_0__2"], [1, np.nan])
    assert list(found["x9_b"]) == ["a", "b"]
    np.testing.assert_array_equal(found["rows"][1], [2, 3])
    long = found["tables"]["long_table"]
    np.testing.assert_array_equal(long["trial"][:3], [1, 2, 1])
    assert list(long["trial_labels"]) == ["b.csv", "a.csv"]
    np.testing.assert_array_equal(long["x_0_"], np.arange(3000))
