"""Where a recording begins and ends in files as programs write them."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from impc.errors import DataError
from impc.files.formats import read_table
from tests.files.samples import workbook

TIME = np.round(np.arange(40) * 0.02, 2)
TILT = np.round(np.sin(0.3 * np.arange(40)), 4)
TAP = np.repeat([0.0, 1.5, -1.5, 0.5], 10)


def rows(delimiter: str = ",", decimal: str = ".", end: str = "", first: str = "") -> list[str]:
    """The rows of a recording of three columns."""
    numbers = [[f"{value:.4f}" for value in row] for row in zip(TIME, TILT, TAP, strict=True)]
    return [first + delimiter.join(row).replace(".", decimal) + end for row in numbers]


LVM = [
    "LabVIEW Measurement\t", "Writer_Version\t2", "Reader_Version\t2", "Separator\tTab",
    "Decimal_Separator\t.", "Multi_Headings\tNo", "X_Columns\tOne", "***End_of_Header***\t", "\t",
    "Channels\t2\t\t", "Samples\t40\t40\t", "Y_Unit_Label\tdeg\tVolts\t", "X0\t0.0E+0\t0.0E+0\t",
    "Delta_X\t0.020000\t0.020000\t", "***End_of_Header***\t\t\t",
]  # fmt: skip
QTM = [
    "NO_OF_FRAMES\t40", "NO_OF_CAMERAS\t8", "NO_OF_MARKERS\t1", "FREQUENCY\t50", "NO_OF_ANALOG\t0",
    "ANALOG_FREQUENCY\t0", "TIME_STAMP\t2024-03-01, 10:11:12.123\t1234.5", "MARKER_NAMES\tTIP",
    "time\ttilt\ttap",
]  # fmt: skip
STO = ["Coordinates", "version=1", "nRows=40", "nColumns=3", "inDegrees=yes", "", "endheader"]
EXCEL = ["Subject,12,", "Sampling rate (Hz),50,", "Weight,79.7,", "Date,01.03.2024,", ",,"]
TRC = [
    "PathFileType\t4\t(X/Y/Z)\ta.trc", "DataRate\tCameraRate\tNumFrames\tUnits",
    "50.00\t50.00\t40\tmm", "time\ttilt\ttap", "\t\t\t", "",
]  # fmt: skip
# Ending and lines: each file is read as the columns time, tilt and tap.
EVENTS = rows(end=",")
SHAPES: dict[str, tuple[str, list[str]]] = {
    "settings of LabVIEW": (".lvm", [*LVM, "time\ttilt\ttap\tComment", *rows("\t")]),
    "decimal commas of it": (".lvm", [*LVM, "time\ttilt\ttap\tComment", *rows("\t", ",")]),
    "as text": (".txt", [*LVM, "time\ttilt\ttap", *rows("\t")]),
    "settings of Qualisys": (".tsv", [*QTM, *rows("\t")]),
    "OpenSim": (".sto", [*STO, "time\ttilt\ttap", *rows("\t")]),
    "OpenSim with blanks": (".mot", [*STO, "time tilt tap", *rows("  ", first=" ")]),
    "OpenSim, tab behind the head": (".sto", [*STO, "time\ttilt\ttap\t", *rows("\t")]),
    "markers": (".trc", [*TRC, *rows("\t")]),
    "padded by Excel": (".csv", [*EXCEL, "time,tilt,tap", *rows()]),
    "padded below": (".csv", ["time,tilt,tap", *rows(), ",,", ",,"]),
    "settings without padding": (".csv", ["Subject,12", "Weight,79.7", "time,tilt,tap", *rows()]),
    "Excel's separator": (".csv", ["sep=;", "Rate;50", "time;tilt;tap", *rows(";", ",")]),
    "an end that the head lacks": (".csv", ["time;tilt;tap", *rows(";", ",", ";")]),
    "a tab behind each row": (".tsv", ["time\ttilt\ttap", *rows("\t", end="\t")]),
    "an empty column of comments": (".csv", ["time,tilt,tap,Comment", *EVENTS]),
    "a word": (".csv", ["time,tilt,tap,Event", *EVENTS[:20], EVENTS[20] + "hit", *EVENTS[21:]]),
    "no field for no word": (
        ".lvm", ["time\ttilt\ttap\tComment", rows("\t")[0] + "\tgo", *rows("\t")[1:]]
    ),
    "a footer of statistics": (".csv", ["time,tilt,tap", *rows(), "Mean,0.1,0.2", "SD,0.3,0.4"]),
    "statistics below a line": (".csv", ["time,tilt,tap", *rows(), "", ",0.1,0.2", ",1,2"]),
    "a footer of words": (".csv", ["time,tilt,tap", *rows(), "End of recording"]),
    "names of rows by R": (
        ".txt", ['"time" "tilt" "tap"', *(f'"{k}" {row}' for k, row in enumerate(rows(" ")))]
    ),
    "few settings": (
        ".lvm", ["Samples\t40\t40", "X0\t0\t0", "Delta_X\t0.02\t0.02", "Y0\t0\t0", "Gain\t1\t1",
                 "time\ttilt\ttap", *rows("\t")]
    ),
    "a head of two rows": (".csv", ["Stick,,Tap", "time,tilt,tap", *rows()]),
}  # fmt: skip


@pytest.mark.parametrize("end", ["\n", ""])
@pytest.mark.parametrize("name", SHAPES)
def test_the_rows_of_the_recording_are_read(name: str, end: str, tmp_path: Path) -> None:
    ending, lines = SHAPES[name]
    path = tmp_path / f"a{ending}"
    path.write_text("\n".join(lines) + end)
    table = read_table(path)
    assert [name for name in table.columns if name != "column_1"] == ["time", "tilt", "tap"]
    for column, values in (("time", TIME), ("tilt", TILT), ("tap", TAP)):
        np.testing.assert_allclose(table.columns[column], values, atol=1e-4)


def test_what_is_not_read_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    lines = ["time,tilt,tap,Event", *rows(end=",")[:-1], rows()[-1] + ",fell", "Mean,0.1,0.2,"]
    path.write_text("\n".join([*EXCEL, *lines]) + "\n")
    table = read_table(path)
    assert table.skipped == {"Event": "is text, such as 'fell' in line 46"}
    assert table.notes == ("line 47 and all below are not read; they begin with 'Mean,0.1,0.2,'",)


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({20: "0.4,overload,1"}, "has text in 1 of 40 rows, the first 'overload' in line 21"),
        ({20: "0.4,1"}, "line 21 has 2 values where the first row has 3"),
        ({20: "# pause"}, "line 21 has 1 values where the first row has 3"),
        ({20: "0.4,0,5,1"}, "line 21 has 4 values where the first row has 3"),
        ({1: "0.0,ERR,0"}, "has text in 1 of 40 rows, the first 'ERR' in line 2"),
        ({40: "0.78,0."}, "line 41 has 2 values where the first row has 3: the file ends"),
        ({40: "0.78,0.1,-"}, "has text in 1 of 40 rows, the first '-' in line 41"),
        ({0: "time,tilt"}, "the header names 2 columns, but the rows below have 3 values"),
        ({0: "time,tilt,tap,lean"}, "the header names 4 columns, but the rows below have 3"),
    ],
)
def test_a_damaged_row_is_no_end(tmp_path: Path, changed: dict[int, str], says: str) -> None:
    lines = ["time,tilt,tap", *rows()]
    for place, line in changed.items():
        lines[place] = line
    path = tmp_path / "a.csv"
    path.write_text("\n".join(lines))
    with pytest.raises(DataError, match=re.escape(says)):
        read_table(path)


@pytest.mark.parametrize(
    ("head", "names"),
    [
        (["X[s],EMG [mV],X[s]"], ["X", "EMG", "X_2"]),
        (["a,a,a"], ["a", "a_2", "a_3"]),
        (["a (deg),a (rad),b"], ["a (deg)", "a (rad)", "b"]),
        (["Head,,Trunk", "X,Y,X"], ["Head X", "Y", "Trunk X"]),
        (["Name,TIP,TIP", "time,,tap"], ["time", "TIP", "tap"]),
        (["A,A,A", "X,X,X"], ["A X", "A X_2", "A X_3"]),
    ],
)
def test_columns_of_one_name_are_told_apart(
    tmp_path: Path, head: list[str], names: list[str]
) -> None:
    path = tmp_path / "a.csv"
    path.write_text("\n".join([*head, *rows()]) + "\n")
    table = read_table(path)
    assert list(table.columns) == names
    heads = head[-1].replace("[s]", "").replace(" [mV]", "").split(",")
    stated = [name for old, name in zip(heads, names, strict=True) if old not in (name, "")]
    assert all(repr(name) in "".join(table.notes) for name in stated)
    assert bool(stated) == bool(table.notes)


def test_names_of_rows_without_a_head(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(
        "\n".join(['"time","tilt","tap"', *(f'"{k}",{r}' for k, r in enumerate(rows()))])
    )
    assert list(read_table(path).columns) == ["column_1", "time", "tilt", "tap"]


@pytest.mark.parametrize(
    "missing", ["#N/A", "#NV", "#DIV/0!", "n/a", "-nan(ind)", "NaN", "", "1.#QNAN"]
)
@pytest.mark.parametrize("decimal", [".", ","])
def test_what_stands_for_no_number(tmp_path: Path, missing: str, decimal: str) -> None:
    path = tmp_path / "a.csv"
    lines = ["time;tilt;tap", *rows(";", decimal)]
    lines[7] = (
        f"{TIME[6]};{missing};0".replace(".", decimal) if missing[:1] != "1" else f"0;{missing};0"
    )
    path.write_text("\n".join(lines) + "\n")
    assert np.flatnonzero(np.isnan(read_table(path).columns["tilt"])).tolist() == [6]


DATA = [["time", "tilt", "tap"], *np.column_stack([TIME, TILT, TAP]).tolist()]
INFO = [["Subject", 12], ["Mass", 79.7], ["Height", 1.66], ["Rate", 50]]


def test_the_sheet_with_signals_is_found(tmp_path: Path) -> None:
    table = read_table(workbook(tmp_path / "a.xlsx", Info=INFO, Data=DATA))
    np.testing.assert_array_equal(table.columns["tilt"], TILT)
    assert table.skipped == {"sheet Info": "is another sheet"}
    assert table.notes == ()


def test_a_sheet_may_be_asked_for(tmp_path: Path) -> None:
    second: list[Sequence[object]] = [["t", "x"], *([k, 2 * k] for k in range(9))]
    path = workbook(tmp_path / "a.xlsx", one=DATA, two=second)
    assert list(read_table(path, sheet="two").columns) == ["t", "x"]
    assert read_table(path).notes == ("sheet 'one' is read; other sheets have rows of numbers too",)
    with pytest.raises(DataError, match=r"has no sheet 'three'; set recording.sheet to one, two"):
        read_table(path, sheet="three")
    (tmp_path / "a.csv").write_text("t\n1\n2\n")
    assert list(read_table(tmp_path / "a.csv", sheet="one").columns) == ["t"]  # has none


def test_settings_and_statistics_in_a_sheet(tmp_path: Path) -> None:
    cells = [*INFO, [], *DATA, [], ["Mean", 0.1, 0.2], ["SD", 0.3, 0.4]]
    table = read_table(workbook(tmp_path / "a.xlsx", Sheet=cells))
    np.testing.assert_array_equal(table.columns["time"], TIME)
    assert table.notes == ("row 48 and all below are not read; they begin with 'Mean 0.1 0.2'",)


@pytest.mark.parametrize("line", [b"1\n", b"1,2\n", b"1;2;3;4\n"])
def test_short_lines_take_little_memory(tmp_path: Path, line: bytes) -> None:
    """Regression: the command's process needed 60 to 90 bytes per byte of the file."""
    path, size = tmp_path / "a.csv", 4_000_000
    path.write_bytes(line * (size // len(line)))
    code = (
        "import resource, sys, pandas\n"
        "from impc.files.formats import read_table\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "read_table(sys.argv[1])\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip
    unit = 1 if sys.platform == "darwin" else 1024
    assert int(done.stdout) * unit < 15 * size + 20_000_000
