"""Every format, written by other means than impc and read, and written by impc."""

from __future__ import annotations

import importlib.util
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import c3d
import numpy as np
import pytest
import scipy.io
from nptdms import ChannelObject, TdmsFile, TdmsWriter
from numpy.typing import ArrayLike

from impc.errors import DataError, OutputError
from impc.files.formats import read_table, write_table
from impc.files.layout import split_heading
from impc.files.table import Table, make_table
from tests.files.samples import csv_text, hdf5_mat, opaque_variable, pushed_seat, save_mat

SEAT = pushed_seat(200)


def assert_columns(table: Table, expected: Mapping[str, ArrayLike], tolerance: float = 0.0) -> None:
    assert list(table.columns) == list(expected)
    for name, values in expected.items():
        exact = np.asarray(values, dtype=np.float64)
        np.testing.assert_allclose(table.columns[name], exact, rtol=0, atol=tolerance)


# Delimited text -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ending", "delimiter", "decimal"),
    [
        (".csv", ",", "."),
        (".csv", ";", "."),
        (".csv", ";", ","),
        (".csv", "\t", ","),
        (".tsv", "\t", "."),
        (".txt", "\t", ","),
        (".txt", "   ", "."),
        (".TXT", ";", ","),
    ],
)
def test_delimiters_and_decimal_signs(
    tmp_path: Path, ending: str, delimiter: str, decimal: str
) -> None:
    path = tmp_path / f"trial{ending}"
    path.write_text(csv_text(SEAT, delimiter, decimal))
    assert_columns(read_table(path), SEAT, 1e-9)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1", "utf-16"])
@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
def test_encodings_and_line_ends(tmp_path: Path, encoding: str, newline: str) -> None:
    text = "Zeit (s),Winkel ä (°)\n0,1.5\n0.1,-2\n0.2,3\n".replace("\n", newline)
    path = tmp_path / "trial.csv"
    path.write_bytes(text.encode(encoding))
    table = read_table(path)
    assert_columns(table, {"Zeit": np.array([0, 0.1, 0.2]), "Winkel ä": np.array([1.5, -2, 3])})
    assert table.units == {"Zeit": "s", "Winkel ä": "°"}


def test_what_stands_above_the_numbers(tmp_path: Path) -> None:
    path = tmp_path / "trial.csv"
    path.write_text("sep=;\nSubject: S01\n\ntime;seat;push\ns;deg;N*m\n0;1;2\n1;3;4\n")
    table = read_table(path)
    assert_columns(table, {"time": [0.0, 1.0], "seat": [1.0, 3.0], "push": [2.0, 4.0]})
    assert table.units == {"time": "s", "seat": "deg", "push": "N*m"}
    path.write_text("# time, seat [rad]\n0,1\n1,3\n")  # as numpy.savetxt writes it
    assert read_table(path).units == {"seat": "rad"}


def test_columns_without_a_name_and_values_that_are_missing(tmp_path: Path) -> None:
    path = tmp_path / "trial.csv"
    path.write_text("0,1,NaN\n1,,5e-3\n2,inf,NA\n")
    columns = read_table(path).columns
    assert list(columns) == ["column_1", "column_2", "column_3"]
    np.testing.assert_array_equal(columns["column_2"], [1, np.nan, np.inf])
    np.testing.assert_array_equal(columns["column_3"], [np.nan, 5e-3, np.nan])


def test_one_column_a_quoted_field_and_a_delimiter_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "trial.csv"
    path.write_text("angle (deg)\n1.5\n2.5\n")
    assert_columns(read_table(path), {"angle": np.array([1.5, 2.5])})
    path.write_text('"seat, left","push",\n"1","2",\n"3","4",\n')
    assert_columns(read_table(path), {"seat, left": np.array([1.0, 3]), "push": np.array([2.0, 4])})


def test_headings() -> None:
    assert split_heading("seat angle (deg)") == ("seat angle", "deg")
    assert split_heading("torque[Nm]") == ("torque", "Nm")
    assert split_heading("angle (left)") == ("angle (left)", "")
    assert split_heading("g (g)") == ("g", "g")


@pytest.mark.parametrize(
    ("rows", "says"),
    [
        # Nothing says which sign is the decimal one.
        (
            ["0;999", "1;1.000"],
            "has whole numbers, and '1.000' in line 3 can be a decimal or thousands",
        ),
        (["0;999", "1;-1,000"], "has whole numbers, and '-1,000' in line 3"),
        (["0;999", "1;12.345", "2;998"], "has whole numbers, and '12.345' in line 3"),
        (['0;"999"', '1;"1.000"'], "has whole numbers, and '1.000' in line 3"),
        (["0;1.234.567", "1;999"], "text in 1 of 2 rows"),
    ],
)
def test_thousands_separators_are_refused(tmp_path: Path, rows: list[str], says: str) -> None:
    path = tmp_path / "trial.csv"
    path.write_text("\n".join(["time;force", *rows]) + "\n")
    with pytest.raises(DataError, match=re.escape(says)):
        read_table(path)


@pytest.mark.parametrize(
    ("rows", "values"),
    [
        (["0;999.000", "1;1000.000"], [999, 1000]),  # decimals in every row
        (["0;1.000", "1;0.999"], [1, 0.999]),  # no group begins with 0
        (["0;1.125", "1;2", "2;2.5"], [1.125, 2, 2.5]),
        (["0,5;1,125", "1,5;-2", "2,5;2,5"], [1.125, -2, 2.5]),
        (["0;1.125e0", "1;2"], [1.125, 2]),
        # The decimal sign is a comma: a point can only divide thousands.
        (["0,5;999", "1,5;1.000"], [999, 1000]),
        (["0,5;999,5", "1,5;1.000,5"], [999.5, 1000.5]),
        (["0;1.125", "1;"], [1.125, np.nan]),
        (["0;NaN", "1;1000"], [np.nan, 1000]),
    ],
)
def test_thousands_are_read_where_the_decimal_sign_is_known(
    tmp_path: Path, rows: list[str], values: list[float]
) -> None:
    path = tmp_path / "trial.csv"
    path.write_text("\n".join(["time;force", *rows]) + "\n")
    np.testing.assert_array_equal(read_table(path).columns["force"], values)


# MATLAB ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("packed", [False, True])
def test_vectors_matrices_and_structs(tmp_path: Path, packed: bool) -> None:
    path = tmp_path / "trial.mat"
    angles = np.column_stack([SEAT["seat"], SEAT["trunk"]])
    values = {
        "time": SEAT["time"][None, :],
        "angles": angles,
        "wide": angles.T,
        "s": {"push": SEAT["push"][:, None], "inner": {"x": np.arange(200, dtype=np.int16)}},
        "fs": 100.0,
        "subject": "S01",
        "short": np.arange(7.0),
    }
    save_mat(path, values, do_compression=packed)
    table = read_table(path)
    expected = {
        "time": SEAT["time"],
        **{f"{name}_{i + 1}": angles[:, i] for name in ("angles", "wide") for i in (0, 1)},
        "s.push": SEAT["push"],
        "s.inner.x": np.arange(200.0),
    }
    assert_columns(table, expected)
    assert table.skipped["fs"] == "is one number (100)"
    assert table.skipped["subject"] == "is text"
    assert table.skipped["short"] == "has 7 values where most columns have 200"


def test_version_73_by_h5py(tmp_path: Path) -> None:
    path = tmp_path / "trial.mat"
    hdf5_mat(path, {**SEAT, "note": np.arange(3, dtype=np.uint16)}, {"note": "char"})
    table = read_table(path)
    assert_columns(table, {name: SEAT[name] for name in sorted(SEAT)})  # the order of HDF5
    assert table.skipped == {"note": "is text"}


@pytest.mark.parametrize("name", ["seat", "s.seat"])
@pytest.mark.parametrize("version", ["5", "7.3", "7.3, whole numbers"])
def test_no_imaginary_part_is_dropped(name: str, version: str, tmp_path: Path) -> None:
    """At the top level and in a field of a struct: no column, with a reason."""
    path = tmp_path / "trial.mat"
    numbers = np.exp(1j * np.arange(200.0))
    if version == "5":
        save_mat(path, {"time": SEAT["time"], "s": {"seat": numbers}, "seat": numbers})
    else:
        kind = "<i2" if "whole" in version else "<f8"
        pairs = np.zeros((1, 200), [("real", kind), ("imag", kind)])
        pairs["imag"] = 1
        hdf5_mat(path, {"time": SEAT["time"], "s/seat": pairs, "seat": pairs})
    table = read_table(path)
    assert list(table.columns) == ["time"]
    assert table.skipped[name] == "is complex"


def matlab_file(name: str) -> Path:
    """A file written by MATLAB, from the tests of scipy."""
    spec = importlib.util.find_spec("scipy.io.matlab")
    assert spec is not None
    assert spec.origin is not None
    path = Path(spec.origin).parent / "tests" / "data" / name
    if not path.exists():
        pytest.skip("this scipy came without its tests")
    return path


@pytest.mark.parametrize(
    ("name", "column"),
    [("testdouble_7.4_GLNX86.mat", "testdouble"), ("testhdf5_7.4_GLNX86.mat", "testdouble")],
)
def test_files_that_matlab_wrote(name: str, column: str) -> None:
    np.testing.assert_allclose(
        read_table(matlab_file(name)).columns[column], np.linspace(0, 2 * np.pi, 9), atol=1e-14
    )


@pytest.mark.parametrize(
    ("name", "phrase"),
    [
        ("testcell_7.4_GLNX86.mat", "is a cell array"),
        ("testobject_7.4_GLNX86.mat", "is a MATLAB object of class inline"),
        ("testsparse_7.4_GLNX86.mat", "is sparse"),
        ("testcomplex_7.4_GLNX86.mat", "is complex"),
        ("testfunc_7.4_GLNX86.mat", "is not numeric"),
        ("testvec_4_GLNX86.mat", "does not begin as such a file"),
        ("corrupted_zlib_data.mat", "is damaged"),
    ],
)
def test_files_that_matlab_wrote_and_cannot_be_read(name: str, phrase: str) -> None:
    with pytest.raises(DataError, match=phrase):
        read_table(matlab_file(name))


def test_the_names_of_columns_in_matlab(tmp_path: Path) -> None:
    table = make_table("trial", {"seat angle": np.arange(5.0)})
    with pytest.raises(OutputError, match="is not a valid MATLAB variable"):
        write_table(tmp_path / "trial.mat", table)
    assert list(tmp_path.iterdir()) == []


# TDMS and C3D ---------------------------------------------------------------------------------


def test_tdms_by_nptdms(tmp_path: Path) -> None:
    path = tmp_path / "trial.tdms"
    stamps = np.datetime64("2026-01-01T00:00:00") + 10_000 * np.arange(200).astype("m8[us]")
    waveform = {"wf_increment": 0.01, "unit_string": "deg"}
    with TdmsWriter(str(path)) as writer:
        for part in (slice(0, 120), slice(120, 200)):
            writer.write_segment(
                [
                    ChannelObject("a", "stamp", stamps[part]),
                    ChannelObject("a", "seat", SEAT["seat"][part], waveform),
                    ChannelObject("b", "seat", SEAT["push"][part].astype(np.float32)),
                    ChannelObject("b", "event", ["start"]),
                ]
            )
    table = read_table(path)
    expected = {"stamp": SEAT["time"], "a/seat": SEAT["seat"], "b/seat": SEAT["push"]}
    assert_columns(table, expected, 1e-12)
    assert table.units == {"stamp": "s", "a/seat": "deg"}
    assert table.rate == 100.0
    assert table.skipped == {"event": "is text"}


def tdms(path: Path, *channels: tuple[str, Any, dict[str, Any]]) -> Path:
    with TdmsWriter(str(path)) as writer:
        writer.write_segment([ChannelObject("g", *channel) for channel in channels])
    return path


@pytest.mark.parametrize(
    "late",
    [
        {"wf_start_offset": 0.4},
        {"wf_start_time": np.datetime64("2026-01-01T00:00:00.400")},
        {"wf_start_time": np.datetime64("2026-01-01T00:00:00.100"), "wf_start_offset": 0.3},
    ],
)
def test_tdms_channels_that_begin_at_different_times(tmp_path: Path, late: dict[str, Any]) -> None:
    begins = {"wf_start_time": np.datetime64("2026-01-01"), "wf_increment": 0.02}
    signal = np.sin(0.1 * np.arange(100.0))
    path = tdms(tmp_path / "a.tdms", ("push", signal, begins), ("seat", signal, begins | late))
    table = read_table(path)
    assert_columns(table, {"push": signal[20:], "seat": signal[:80]}, 1e-9)
    assert table.rate == 50.0
    assert "clock of push (0 to 1.98 by 0.02), clock of seat (0.4 to 2.38 by" in table.notes[0]


def test_tdms_channels_of_two_rates_and_groups_with_time_stamps(tmp_path: Path) -> None:
    time = 0.01 * np.arange(600)
    slow = ("seat", np.sin(time[::2]), {"wf_increment": 0.02})
    table = read_table(
        tdms(tmp_path / "a.tdms", ("push", np.sin(time), {"wf_increment": 0.01}), slow)
    )
    assert table.rate == 100.0
    np.testing.assert_allclose(table.columns["seat"], np.sin(time[:599]), atol=1e-4)
    stamps = np.datetime64("2026-01-01T10:00:00") + (1e6 * time).astype("timedelta64[us]")
    with TdmsWriter(str(tmp_path / "b.tdms")) as writer:
        for group, name, late in (("a", "push", 0), ("b", "seat", 400)):
            channel = ChannelObject(group, name, np.sin(time))
            shifted = stamps + np.timedelta64(late, "ms")
            writer.write_segment([ChannelObject(group, "Time", shifted), channel])
    found = read_table(tmp_path / "b.tdms").columns
    expected = {"a/Time": time[40:], "push": np.sin(time[40:]), "seat": np.sin(time[:560])}
    for name, values in expected.items():
        np.testing.assert_allclose(found[name], values, atol=1e-6)


@pytest.mark.parametrize("kind", ["AdvancedAPI", "Bridge"])
def test_a_tdms_scale_that_nobody_applies(tmp_path: Path, kind: str) -> None:
    scale = {"NI_Number_Of_Scales": 1, "NI_Scale[0]_Scale_Type": kind, "unit_string": "deg"}
    path = tdms(
        tmp_path / "a.tdms",
        ("time", np.arange(99.0), {}),
        ("seat", np.arange(99, dtype=np.int16), scale),
    )
    table = read_table(path)
    assert table.skipped == {"seat": f"has unscaled counts (unknown scaling {kind!r})"}
    assert "seat" not in table.columns


def test_c3d_by_c3d(tmp_path: Path) -> None:
    path = tmp_path / "trial.c3d"
    analog = np.array([SEAT["seat"], SEAT["push"]])
    writer = c3d.Writer(point_rate=50.0, analog_rate=200.0)
    writer.set_point_labels(["head"])
    writer.set_analog_labels(["seat angle", "push"])
    writer.set_analog_scales([0.5, 2.0])  # number = value / scale + offset
    writer.set_analog_offsets([0, 3])
    writer.add_frames(
        [(np.zeros((1, 5)), analog[:, first : first + 4]) for first in range(0, 200, 4)]
    )
    with path.open("wb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        writer.write(file)
    table = read_table(path)
    assert_columns(table, {"seat angle": analog[0], "push": analog[1]}, 1e-6)
    assert table.rate == 200.0


# Written by impc ------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", [".csv", ".tsv", ".txt", ".xlsx", ".mat", ".tdms", ".c3d"])
def test_written_and_read_again(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"trial{ending}"
    units = {"seat": "deg", "push": "N*m"}
    write_table(path, make_table("trial", SEAT, units, 100.0))
    again = read_table(path)
    kept = dict(SEAT)
    if ending == ".c3d":
        kept = {name: values.astype(np.float32) for name, values in SEAT.items()}
    if ending == ".xlsx":  # openpyxl writes 16 digits
        digits = {name: [f"{value:.16g}" for value in values] for name, values in SEAT.items()}
        kept = {name: np.array(texts, dtype=np.float64) for name, texts in digits.items()}
    assert_columns(again, kept)
    if ending != ".mat":
        assert again.units == units
    if ending in (".tdms", ".c3d"):
        assert again.rate == 100.0
    assert list(tmp_path.iterdir()) == [path]


def test_what_others_read_in_what_impc_writes(tmp_path: Path) -> None:
    columns = {"time": SEAT["time"], "s.seat": SEAT["seat"]}
    table = make_table("trial", columns, {"s.seat": "deg"}, 100.0)
    write_table(tmp_path / "a.mat", table)
    five = scipy.io.loadmat(tmp_path / "a.mat", simplify_cells=True)
    np.testing.assert_array_equal(five["s"]["seat"], SEAT["seat"])
    write_table(tmp_path / "c.tdms", table)
    channel = TdmsFile.read(tmp_path / "c.tdms")["recording"]["s.seat"]
    np.testing.assert_array_equal(channel[:], SEAT["seat"])
    assert channel.properties["unit_string"] == "deg"


def test_a_file_that_cannot_be_written_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "trial.c3d"
    path.write_bytes(b"old")
    with pytest.raises(OutputError, match="needs a sampling rate"):
        write_table(path, make_table("trial", SEAT))
    with pytest.raises(OutputError, match="cannot be written"):
        write_table(tmp_path / "none" / "trial.csv", make_table("trial", SEAT))
    with pytest.raises(OutputError, match="has the ending"):
        write_table(tmp_path / "trial.xyz", make_table("trial", SEAT))
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def read_or_reason(path: Path) -> Table | str:
    """The table, or the one-line reason why it is rejected."""
    try:
        return read_table(path)
    except DataError as error:
        return str(error)


@pytest.mark.parametrize("ending", [".csv", ".xlsx", ".mat", ".tdms", ".c3d"])
def test_files_cut_anywhere_give_no_wrong_number(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"trial{ending}"
    write_table(path, make_table("trial", SEAT, {"seat": "deg"}, 100.0))
    content = path.read_bytes()
    whole = read_table(path)
    refused = 0
    for size in range(1, len(content), len(content) // 60):
        path.write_bytes(content[:size])
        found = read_or_reason(path)
        if isinstance(found, str):
            refused += 1
            assert "\n" not in found
            continue
        # Text that is cut behind the last comma of a row cannot be said from a shorter recording,
        # but for its last number; a .mat between two variables, from a file with fewer of them.
        for name, values in found.columns.items():
            rows = len(values) - 1 if ending == ".csv" else len(values)
            np.testing.assert_array_equal(values[:rows], whole.columns[name][:rows])
    assert refused > (25 if ending == ".csv" else 55)


def test_strings_of_matlab_beside_signals(tmp_path: Path) -> None:
    # MATLAB saves each string as an object without a name that scipy can say.
    path = tmp_path / "trial.mat"
    save_mat(path, {"seat": SEAT["seat"]})
    with path.open("ab") as file:
        file.write(opaque_variable(b"note", b"string") + opaque_variable(b"who", b"string"))
    table = read_table(path)
    assert_columns(table, {"seat": SEAT["seat"]})
    assert "is a MATLAB string" in next(iter(table.skipped.values()))
