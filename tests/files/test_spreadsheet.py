"""Workbooks, against openpyxl, which has independent code, and hand-written ODF."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Any

import numpy as np
import openpyxl
import pandas as pd
import pytest

from impc.errors import DataError, InputError, OutputError
from impc.files.formats import read_table, write_table
from impc.files.spreadsheet import workbook_bytes
from impc.files.table import make_table
from impc.studies.cohort.participants import read_participants, read_sheet
from tests.files.samples import ods_file, pushed_seat, workbook

SEAT = pushed_seat(50)


def book(path: Path, rows: list[list[Any]], **others: list[list[Any]]) -> Path:
    return workbook(path, Sheet=rows, **others)


def seat_rows(heads: list[str]) -> list[list[Any]]:
    return [heads, *map(list, zip(*(values.tolist() for values in SEAT.values()), strict=True))]


def test_a_workbook_of_a_laboratory(tmp_path: Path) -> None:
    above: list[list[Any]] = [
        ["Subject", "S01"],
        ["Rate", 100],
        [],
        ["time", "seat", "trunk", "push"],
    ]
    units = ["s", "deg", "deg", "N*m"]
    rows = seat_rows(units)
    table = read_table(book(tmp_path / "a.xlsx", [*above, *rows], notes=[["by", "hand"]]))
    for name, values in SEAT.items():
        np.testing.assert_allclose(table.columns[name], values, rtol=4e-16)  # openpyxl: 16 digits
    assert dict(table.units) == dict(zip(SEAT, units, strict=True))
    assert dict(table.skipped) == {"sheet notes": "is another sheet"}


def test_the_same_numbers_from_both_programs(tmp_path: Path) -> None:
    rows = seat_rows(["time (s)", "seat [deg]", "trunk (deg)", "push"])
    ods_file(tmp_path / "a.ods", {"cover": [["Recorded", "today"]], "data": rows})
    ods, xlsx = read_table(tmp_path / "a.ods"), read_table(book(tmp_path / "a.xlsx", rows))
    assert ods.units == xlsx.units == {"time": "s", "seat": "deg", "trunk": "deg"}
    assert dict(ods.skipped) == {"sheet cover": "is another sheet"}
    for name, values in SEAT.items():
        np.testing.assert_array_equal(ods.columns[name], values)
        np.testing.assert_allclose(xlsx.columns[name], values, rtol=4e-16)


def test_times_words_and_numbers_saved_as_text(tmp_path: Path) -> None:
    start = datetime.datetime(2026, 1, 1, 10, 0, 0)
    rows: list[list[Any]] = [["when", "tilt", "note", "flag", "empty", "gap"]]
    for k in range(4):
        stamp = start + k * datetime.timedelta(milliseconds=250)
        rows.append([stamp, f"{k},5", "x", True, None, None if k == 1 else k])
    table = read_table(book(tmp_path / "a.xlsx", rows))
    np.testing.assert_allclose(table.columns["when"], [0, 0.25, 0.5, 0.75], atol=1e-9)
    np.testing.assert_array_equal(table.columns["tilt"], [0.5, 1.5, 2.5, 3.5])
    np.testing.assert_array_equal(table.columns["gap"], [0, np.nan, 2, 3])
    assert table.units == {"when": "s"}
    assert dict(table.skipped) == {
        "note": "is text, such as 'x' in cell C2",
        "flag": "holds true and false",
        "empty": "is empty",
    }


def test_a_sheet_that_is_hidden_is_none(tmp_path: Path) -> None:
    made = openpyxl.load_workbook(book(tmp_path / "a.xlsx", [["x"], [1], [2]], b=[["y"], [3], [4]]))
    made["Sheet"].sheet_state = "hidden"
    made.active = made["b"]
    made.save(tmp_path / "a.xlsx")
    assert list(read_table(tmp_path / "a.xlsx").columns) == ["y"]


@pytest.mark.parametrize(
    ("rows", "says"),
    [
        ([["t", "x"], [0, 1], [1, "high"]], "has text in 1 of 2 rows, the first 'high' in cell B3"),
        (
            [["t", "x"], [0, "999"], [1, "1,000"]],
            "'1,000' in cell B3 can be a decimal or thousands",
        ),
        ([["t", "x"], [0, 1], [1, datetime.date(2026, 1, 1)]], "has dates and numbers"),
        ([["only", "words"], ["a", "b"]], "has no rows of numbers"),
    ],
)
def test_what_is_refused(tmp_path: Path, rows: list[list[Any]], says: str) -> None:
    with pytest.raises(DataError) as caught:
        read_table(book(tmp_path / "a.xlsx", rows))
    assert says in str(caught.value)


def test_workbooks_of_impc_are_read_by_openpyxl(tmp_path: Path) -> None:
    numbers = np.array([0.1 + 0.2, -1e-300, 12345678901234567.0])
    gaps = np.array([1.0, np.nan, 3.0])
    table = make_table("trial", {"a & b": numbers, "c": gaps}, {"c": "deg"})
    write_table(tmp_path / "a.xlsx", table)
    (sheet,) = openpyxl.load_workbook(tmp_path / "a.xlsx").worksheets
    heads, *rows = sheet.iter_rows(values_only=True)
    assert heads == ("a & b", "c (deg)")
    assert [row[1] for row in rows] == [1, None, 3]
    np.testing.assert_allclose([row[0] for row in rows], numbers, rtol=4e-16)
    path = tmp_path / "b.xlsx"
    cells = [("=1+1", True, 0.1), ("<x>\x00", False, -np.inf)]
    path.write_bytes(workbook_bytes({"a": pd.DataFrame(cells, columns=["x", "@y", "z"])}))
    (sheet,) = openpyxl.load_workbook(path).worksheets
    assert [[cell.value for cell in row] for row in sheet] == [
        ["x", "'@y", "z"], ["'=1+1", "yes", 0.1], ["<x>\\x00", "no", None]
    ]  # fmt: skip
    assert sheet["A2"].data_type == "s"  # no formula


def test_a_workbook_begins_with_what_it_is(tmp_path: Path) -> None:
    readme = pd.DataFrame({"sheet": ["gain"], "what it holds": ["The gain of " + "a" * 60]})
    numbers = pd.DataFrame({"a_head_that_is_long": [1.0], "b": ["a text that is longer"]})
    path = tmp_path / "a.xlsx"
    path.write_bytes(workbook_bytes({"gain": numbers}, readme))
    book = openpyxl.load_workbook(path)
    assert book.sheetnames == ["README", "gain"]
    for sheet, table in zip(book.worksheets, (readme, numbers), strict=True):
        assert sheet.freeze_panes == "A2"
        for cell, head in zip(sheet[1], table.columns, strict=True):
            assert cell.font.bold
            longest = max(len(str(one)) for one in (head, *table[head]))
            assert longest < sheet.column_dimensions[cell.column_letter].width < longest + 5
    assert book["gain"]["A2"].value == 1


def test_ods_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"write \.xlsx, which opens there too"):
        write_table(tmp_path / "a.ods", make_table("trial", {"x": np.arange(2.0)}))


@pytest.mark.parametrize("ending", [".xlsx", ".ods"])
def test_participants_in_a_workbook(tmp_path: Path, ending: str) -> None:
    rows: list[list[Any]] = [["subject", "group", "mass"], ["1", "a", 79.7], [2.0, "b", 68]]
    path = tmp_path / f"participants{ending}"
    if ending == ".ods":
        ods_file(path, {"people": rows})
    else:
        book(path, rows)
    sheet = read_sheet(path)
    assert [row["subject"] for row in sheet] == ["1", "2"]
    assert [one.values["mass"] for one in read_participants(path).values()] == [79.7, 68.0]
    path.write_bytes(b"PK\x03\x04")
    with pytest.raises(InputError, match="is damaged and cannot be read"):
        read_sheet(path)
