"""Recordings as programs and people export them: one table of files and what becomes of them.

The same 300 samples at 50 per second (time, tilt, tap) stand in every file, written by Python.
"""

from __future__ import annotations

import datetime
import re
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import control
import numpy as np
import openpyxl
import pytest
from click.testing import CliRunner

from impc.arrays import Array
from impc.cli.main import main
from impc.errors import InputError
from impc.files.configuration import configuration
from impc.files.draft import draft
from impc.files.formats import read_table
from impc.files.plant_sources import PlantSource, make_plant
from impc.files.reading import recording_of
from impc.files.table import make_table
from impc.model.recordings import Recording
from tests.files.hostile_files import repacked
from tests.files.samples import (
    hdf5_mat,
    mat5_file,
    ods_file,
    opaque_variable,
    save_mat,
    workbook,
)

RATE, SAMPLES = 50, 300
TIME = np.arange(SAMPLES) / RATE
_RNG = np.random.default_rng(4)  # seed 4
TAP = np.repeat(_RNG.choice([-1.5, 0.0, 1.5], SAMPLES // 10), 10)
TILT = np.round(
    np.convolve(TAP, np.exp(-np.arange(40) / 9))[:SAMPLES] + _RNG.normal(size=SAMPLES) / 9, 5
)
Content = str | Callable[[Path], object]
SIGNALS = {"tilt": TILT, "tap": TAP}
START = datetime.datetime(2026, 3, 2, 10, 15, 0)


def at(form: str, start: datetime.datetime = START, digits: int = 3) -> list[str]:
    """The clock as text: a format of strftime, in which %f has so many digits."""
    moments = [start + datetime.timedelta(seconds=float(second)) for second in TIME]
    part = [f"{moment.microsecond / 1e6:.{digits}f}"[2:] for moment in moments]
    return [
        moment.strftime(form.replace("%f", more))
        for moment, more in zip(moments, part, strict=True)
    ]


def minutes(form: str = "{:d}:{:05.2f}", start: float = 0.0) -> list[str]:
    return [form.format(int((start + t) // 60), (start + t) % 60) for t in TIME]


def text(clock: Any = (), delimiter: str = ",", decimal: str = ".", head: str = "time",
         **changed: Any) -> str:  # fmt: skip
    """A file of text with the three columns, of which some are replaced."""
    made = {head: clock if len(clock) else TIME, **SIGNALS, **changed}

    def cell(value: Any) -> str:
        if not isinstance(value, str):
            value = "" if np.isnan(value) else f"{value:.10g}".replace(".", decimal)
        return f'"{value}"' if delimiter in value else value

    lines = [delimiter.join(map(cell, row)) for row in zip(*made.values(), strict=True)]
    return "\n".join([delimiter.join(made), *lines]) + "\n"


def grouped(values: Array, mark: str, decimal: str) -> list[str]:
    """Numbers with a thousands mark, such as 1.234,5."""
    return [f"{value:,.2f}".replace(",", "G").replace(".", decimal).replace("G", mark)
            for value in values]  # fmt: skip


def spoiled(values: Array | list[Any], code: Any, *places: int) -> list[Any]:
    made: list[Any] = list(values)
    for place in places:
        made[place] = code
    return made


SOME = tuple(range(50, 290, 17))
THOUSANDS = 1000 * TILT


def rows(cells: Sequence[Sequence[Any]], hidden: Sequence[int] = ()) -> Callable[[Path], object]:
    return lambda path: workbook(path, hidden, Data=cells)


def filtered(path: Path, blank: str = " ") -> None:
    """A workbook of LibreOffice, of which a filter hides a row."""
    ods_file(path, {"Info": [["by", "hand"]], "Data": sheet_of(TIME.tolist())})
    row = b"<table:table-row"
    hides = row + blank.encode() + b'table:visibility="filter"'
    repacked(path, content=lambda text: hides.join(text.rsplit(row, 1)))


def narrowed(path: Path) -> None:
    """A workbook of which a column is hidden."""
    rows(sheet_of(TIME.tolist()))(path)
    book = openpyxl.load_workbook(path)
    book["Data"].column_dimensions["B"].hidden = True
    book.save(path)


def sheet_of(clock: Sequence[Any], tilt: Sequence[Any] = TILT.tolist()) -> list[list[Any]]:
    return [["time", "tilt", "tap"], *map(list, zip(clock, tilt, TAP.tolist(), strict=True))]


def mat(version: str, **values: Any) -> Callable[[Path], object]:
    def write(path: Path) -> None:
        if version == "7.3":
            hdf5_mat(path, {name: np.asarray(value).T for name, value in values.items()})
        else:
            save_mat(path, values)

    return write


# Clocks -----------------------------------------------------------------------------------------

NIGHT = datetime.datetime(2026, 3, 2, 23, 59, 57)
CLOCKS = {
    "ISO 8601": at("%Y-%m-%dT%H:%M:%S.%f"),
    "with a zone": at("%Y-%m-%dT%H:%M:%S.%f+01:00"),
    "in UTC, nanoseconds": at("%Y-%m-%d %H:%M:%S.%fZ", digits=9),
    "over midnight": at("%Y-%m-%d %H:%M:%S.%f", NIGHT),
    "time of day": at("%H:%M:%S.%f"),
    "time of day over midnight": at("%H:%M:%S.%f", NIGHT),
    "hours without a zero": at("%H:%M:%S.%f", datetime.datetime(2026, 1, 1, 0, 0)),
    "milliseconds after a colon": at("%H:%M:%S:%f"),
    "minutes and seconds": minutes(),
    "minutes beyond the hour": minutes(start=3598.0),
    "minutes that begin anew": [said[3:] for said in at("%H:%M:%S.%f", NIGHT)],
    "American": at("%m/%d/%Y %I:%M:%S.%f %p"),
    "American over noon": at("%I:%M:%S.%f %p", datetime.datetime(2026, 1, 1, 11, 59, 57)),
    "a comma behind the date": at("%m/%d/%Y, %I:%M:%S.%f %p"),
    "German": at("%d.%m.%Y %H:%M:%S,%f"),
    "of MATLAB": at("%d-%b-%Y %H:%M:%S.%f"),
    "the month first, over midnight": at("%m/%d/%Y %H:%M:%S.%f", NIGHT),
    "over the end of a month": at("%m/%d/%Y %H:%M:%S.%f", NIGHT.replace(day=31)),
    "a zone by name": at("%Y-%m-%d %H:%M:%S.%f CET"),
    "a zone of hours": at("%Y-%m-%d %H:%M:%S.%f+02"),
    "a weekday": at("%a %b %d %Y %H:%M:%S.%f"),
    "a name of a month": at("%B %d, %Y %I:%M:%S.%f %p"),
    "a month of Spain": at("%d-abr-%y %I:%M:%S.%f a. m."),
    "Chinese": at("%Y年%m月%d日 %H:%M:%S.%f"),
    "of pandas": [f"0 days 00:00:{t:09.6f}" for t in TIME],
}


def require_signals(path: Path, clock: str = "time") -> None:
    table = read_table(path)
    assert list(table.columns) == [clock, "tilt", "tap"]
    found = table.columns[clock] - table.columns[clock][0]
    np.testing.assert_allclose(found / found[-1], TIME / TIME[-1], atol=1e-6)
    for name, values in SIGNALS.items():
        np.testing.assert_allclose(table.columns[name], values, atol=1e-9)
    assert list(draft(table).signals) == ["tilt", "tap"]
    guess = draft(table).clock
    assert guess is not None
    assert guess.column == clock


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
@pytest.mark.parametrize("name", CLOCKS)
def test_times_as_text_are_a_clock(name: str, delimiter: str, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    decimal = "," if delimiter == ";" else "."
    path.write_text(text(CLOCKS[name], delimiter, decimal))
    require_signals(path)
    assert read_table(path).units == {"time": "s"}


@pytest.mark.parametrize("ending", [".csv", ".txt"])
def test_a_date_in_a_column_of_its_own(ending: str, tmp_path: Path) -> None:
    """Separated by commas, or as all columns by blanks."""
    clock, delimiter = at("%H:%M:%S.%f"), "," if ending == ".csv" else " "
    lines = [delimiter.join(("2026-03-02", *row.split(","))) for row in text(clock).split()[1:]]
    path = tmp_path / f"a{ending}"
    path.write_text("\n".join([delimiter.join(("Date", "time", "tilt", "tap")), *lines]) + "\n")
    require_signals(path)
    assert read_table(path).skipped == {"Date": "holds dates without a time"}


@pytest.mark.parametrize("name", [*CLOCKS, "dates", "times"])
def test_a_workbook_has_the_same_clocks(name: str, tmp_path: Path) -> None:
    cells: list[Any] = list(CLOCKS.get(name, ()))
    if name in ("dates", "times"):
        moments = [START + datetime.timedelta(seconds=float(t)) for t in TIME]
        cells = moments if name == "dates" else [moment.time() for moment in moments]
    rows(sheet_of(cells))(tmp_path / "a.xlsx")
    table = read_table(tmp_path / "a.xlsx")
    np.testing.assert_allclose(table.columns["time"], TIME, atol=1e-3)
    assert table.units == {"time": "s"}


# Files that are read ----------------------------------------------------------------------------

LABCHART = (
    "Interval=\t0.02 s\nTimeFormat=\tStartOfBlock\nChannelTitle=\ttilt\ttap\nRange=\t9 V\t9 V"
)
SAMPLED = (
    f"a.acq\n20 msec/sample\n2 channels\nAngle\ndeg\nForce\nN\nmin,tilt,tap\n,{SAMPLES},{SAMPLES}"
)
COMMENTED = [f"{line}\t#* start" if k == 9 else line
             for k, line in enumerate(text((), "\t").splitlines()[1:])]  # fmt: skip
WRAP = np.round(20 * np.arange(SAMPLES) + 62_000)
READ: dict[str, tuple[str, Content, str]] = {
    "thousands point": (
        ".csv", text(grouped(1000 * TIME, ".", ","), ";", ",", "ms", tilt=TILT), "ms"),
    "thousands blank": (".csv", text(grouped(1000 * TIME, " ", ","), ";", ",", "ms"), "ms"),
    "thousands of a narrow blank": (
        ".csv", text(grouped(1000 * TIME, "\u202f", ","), "\t", ",", "ms"), "ms"),
    "thousands comma": (".csv", text(grouped(1000 * TIME, ",", "."), ",", ".", "ms"), "ms"),
    "Swiss": (".csv", text(grouped(1000 * TIME, "'", "."), ";", ".", "ms"), "ms"),
    "thousands in cells": (".xlsx", rows(sheet_of(grouped(1000 * TIME, ".", ","))), "time"),
    "a counter of 16 bits": (".csv", text((WRAP % 65536).tolist(), head="ms"), "ms"),
    "a signed counter": (".csv", text(((WRAP % 65536) - 32768).tolist(), head="ms"), "ms"),
    "seconds that wrap": (".csv", text(((WRAP % 65536) / 1000).tolist(), head="clock"), "clock"),
    "a counter of 8 bits": (".csv", text((np.arange(SAMPLES) % 256.0).tolist(), head="n"), "n"),
    "bars": (".csv", text((), "|"), "time"),
    "commas between": (".tsv", text(), "time"),
    "a counter of 12 bits": (".csv", text((WRAP % 4096).tolist(), head="ms"), "ms"),
    "of LabChart": (
        ".txt", "\n".join([LABCHART, "UnitName=\tdeg\tN", *COMMENTED]), "time"),
    "of AcqKnowledge": (
        ".csv", "\n".join([SAMPLED, *text(TIME / 60).splitlines()[1:]]), "min"),
    "units behind a slash": (
        ".csv", text((), ";", ",").replace("time;tilt;tap", "time / s;tilt / Grad;tap, N"), "time"),
    "quoted decimal commas": (
        ".csv", text().replace(",", '","').replace("\n", '"\n"').replace(".", ",")[:-1].join('""'),
        "time"),
    "a line above the names": (
        ".csv", f"Label: tilt Sampling frequency: 50 Number of points: 300\n{text()}", "time"),
}  # fmt: skip


def written(folder: Path, ending: str, content: Content) -> Path:
    path = folder / f"a{ending}"
    if isinstance(content, str):
        path.write_text(content, encoding="utf-8")
    else:
        content(path)
    return path


@pytest.mark.parametrize("name", READ)
def test_what_is_read(name: str, tmp_path: Path) -> None:
    ending, content, clock = READ[name]
    require_signals(written(tmp_path, ending, content), clock)


@pytest.mark.parametrize("pad", ["", "0"])
def test_a_slower_signal_with_a_clock_of_its_own(pad: str, tmp_path: Path) -> None:
    """As Delsys exports it, below which nothing or zeros stand."""
    faster = np.arange(2 * SAMPLES) / (2 * RATE)
    signal = np.interp(faster, TIME, TAP).round(6)
    slower = [f"{t},{tilt}" for t, tilt in zip(TIME, TILT, strict=True)]
    slower += [f"{pad},{pad}"] * SAMPLES
    lines = [f"{t},{tap},{one}" for t, tap, one in zip(faster, signal, slower, strict=True)]
    (tmp_path / "a.csv").write_text("\n".join(["X [s],tap,X [s],tilt", *lines]))
    table = read_table(tmp_path / "a.csv")
    np.testing.assert_allclose(table.columns["tilt"][::2], TILT, atol=1e-9)
    assert list(draft(table).signals) == ["tap", "tilt"]


@pytest.mark.parametrize("version", ["5", "7.3"])
@pytest.mark.parametrize("shape", [(1, 1, SAMPLES), (SAMPLES, 1, 1), (1, SAMPLES)])
def test_signals_of_simulink(shape: tuple[int, ...], version: str, tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    pair = np.stack([TILT, TAP])
    mat(version, time=TIME[:, None], tilt=TILT.reshape(shape), two=pair[:, None, :])(path)
    table = read_table(path)
    np.testing.assert_array_equal(table.columns["tilt"], TILT)
    np.testing.assert_array_equal(table.columns["two_2"], TAP)


# Files that are refused, or of which something is said ------------------------------------------

TWICE = np.concatenate([TIME[:150], TIME[:150]])
BLOCK = text().splitlines()
FRAMES = ["Devices", "1000", ",,Force", "Frame,Sub Frame,Fx", ",,N"]
MARKERS = ["", "Trajectories", "100", ",,C7,,", "Frame,Sub Frame,X,Y,Z", ",,mm,mm,mm"]
VICON = [
    *(*FRAMES, *(f"{k // 10},{k % 10},{TILT[k]}" for k in range(300))),
    *(*MARKERS, *(f"{k},0,{TILT[k]},1.5,2" for k in range(30))),
]
SPARSE = np.resize([1.5, -1.5, 0], SAMPLES)
LINE = np.concatenate([TILT[:100], np.linspace(TILT[100], TILT[160], 61).round(5), TILT[161:]])
OTHER = [*BLOCK[:99], "", *(f",{line}" for line in BLOCK[99:])]


def csv(clock: Any = (), head: str = "time", **changed: Any) -> tuple[str, Content]:
    return ".csv", text(clock, head=head, **changed)


def coded(code: object) -> tuple[str, Content]:
    return csv(tilt=spoiled(TILT, code, *SOME))


def coded_at(code: object, *places: int) -> tuple[str, Content]:
    return csv(tilt=spoiled(TILT, code, *places))


def book(tilt: Sequence[Any] = TILT.tolist(), hidden: Sequence[int] = ()) -> tuple[str, Content]:
    return ".xlsx", rows(sheet_of(TIME.tolist(), tilt), hidden)


def thing(kind: str) -> tuple[str, Content]:
    """A .mat file with one object of a class of MATLAB."""
    content = mat5_file(opaque_variable(b"T", kind.encode()))
    return ".mat", lambda path: path.write_bytes(content)


FRAMED = text(np.arange(SAMPLES), head="Frame")
OFTEN = tuple(range(60, 260))
TRIALS = "the file holds 2 trials; save each trial as a file of its own"
ENDS = "ends the recording, but more rows of numbers follow"
# File, and what `impc inspect` says.
SAID: dict[str, tuple[tuple[str, Content], str]] = {
    "two trials": (csv(TWICE), f"begins again in sample 151 (0 after 2.98): {TRIALS}"),
    "two trials without a name": (csv(1000 * TWICE, head="a"), TRIALS),
    "two trials by the day": (csv([f"0:{t:05.2f}" for t in TWICE]), TRIALS),
    "two trials as long as a counter": (csv(TWICE * 16.384 / 3, head="t"), TRIALS),
    "three trials": (csv((TIME % 2).round(2)), "the file holds 3 trials"),
    "a repeated row": (
        csv([*TIME[:99], *TIME[98:-1]]), "is repeated 1 times, the first from sample 99 to 100"
    ),
    "whole seconds": (
        csv(at("%H:%M:%S")), "has only 6 times in 300 samples; export it with fractions of a second"
    ),
    "a missing time": (csv(spoiled(TIME, np.nan, 9)), "has 1 missing times, the first in sample 1"),
    "uneven": (csv(TIME + np.arange(SAMPLES) % 3 / 120), "rises unevenly, in steps from"),
    "-9999": (
        coded(-9999), "-9999 in 15 of 300 samples, far from all others: does it mark missing "
        "values? (missing = -9999)",
    ),
    "999": (coded(999), "(missing = 999)"),
    "99.99": (coded(99.99), "(missing = 99.99)"),
    "of a push": (csv(tap=spoiled(TAP, -9999, *SOME)), "Column 'tap': -9999 in 15 of 300 samples"),
    "single precision": (coded(float(np.float32(1e30))), "(missing = 1e+30)"),
    "1e30": (coded(1e30), "(missing = 1e+30)"),
    "two codes": (csv(tilt=spoiled(spoiled(TILT, -9999, *SOME), 9999, 20, 40)),
                  "(missing = [-9999, 9999])"),
    "once": (coded_at(-9999, 9), "-9999 in 1 of 300 samples"),
    "mostly": (coded_at(-9999, *OFTEN), "-9999 in 200 of 300 samples"),
    "zeros of a lost marker": (
        csv(tilt=spoiled(TILT + 40, 0, *OFTEN[:30])), "(missing = 0)"),
    "in a clock": (csv(spoiled(TIME, -9999, *SOME)), "has -9999 in 15 samples, which no clock has"),
    "16 bits": (book(spoiled(TILT, 32767, *SOME)), "(missing = 32767)"),
    "-1e6": (
        (".mat", mat("5", time=TIME, tilt=np.array(spoiled(TILT, -1e6, *SOME)))),
        "(missing = -1000000)",
    ),
    "a dash": (
        coded("-"), "column 'tilt' has '-' in 15 of 300 rows, from line 52: read as missing values"
    ),
    "dashes in cells": (
        book(spoiled(TILT, "--", *SOME)), "has '--' in 15 of 300 rows, from cell B52"
    ),
    "a word": (coded("lost"), "column 'tilt' has 'lost' in 15 of 300 rows"),
    "changes": (
        csv(tap=np.where(np.arange(SAMPLES) % 10, np.nan, SPARSE)),
        "is it written only where it changes",
    ),
    "at a tenth of the rate": (
        csv(tap=np.where(np.arange(SAMPLES) % 10, np.nan, TAP)), "a value in 30 of 300 samples"
    ),
    "another clock": (
        csv(clock=spoiled(TIME, 0.0, 150, 151, 152), head="t", tap=TAP, ms=20 * np.arange(SAMPLES)),
        "clock 't' runs backward",
    ),
    "frames": ((".csv", FRAMED), "samples per second, which 'Frame' counts"),
    "a straight line": (csv(tilt=LINE), "is a straight line from sample 101 to 161"),
    "hidden rows": (
        book(hidden=range(50, 60)),
        "sheet 'Data' has 10 hidden rows, the first 50, which are read like the others",
    ),
    "hidden columns": ((".xlsx", narrowed), "sheet 'Data' has 1 hidden columns, which are read"),
    "filtered": ((".ods", filtered), "sheet 'Data' has 1 hidden rows, which are read like"),
    "a tag of two lines": (
        (".ods", lambda path: filtered(path, "\n")),
        "sheet 'Data' has 1 hidden rows, which are read like",
    ),
    "two blocks": ((".csv", "\n".join(VICON)), f"line 307 ('Trajectories') {ENDS}"),
    "a trial below": (
        (".csv", "\n".join([*BLOCK, "", *BLOCK])), f"line 303 ('time,tilt,tap') {ENDS}"
    ),
    "another form": ((".csv", "\n".join(OTHER)), "line 101 "),
    "table": (
        thing("table"),
        'is a MATLAB table; save a struct of vectors: s = table2struct(T, "ToScalar", true)',
    ),
    "timetable": (thing("timetable"), "table2struct(timetable2table(T)"),
    "timeseries": (thing("timeseries"), "save s.Time = ts.Time; s.Data = ts.Data"),
}  # fmt: skip


@pytest.mark.parametrize("name", SAID)
def test_what_inspect_says(name: str, tmp_path: Path) -> None:
    file, said = SAID[name]
    path = written(tmp_path, *file)
    done = CliRunner().invoke(main, ["inspect", str(path)])
    assert said in done.output + str(done.exception or "")
    names = re.findall(r"^\[signals\.(\w+)\]", done.output, re.MULTILINE)
    assert set(names) <= {"tilt", "tap"}  # a clock is no signal


# Answers to the questions -----------------------------------------------------------------------


def test_a_signal_in_seconds_is_no_clock() -> None:
    table = make_table("a", {"time": TIME, "reaction time": TILT, "lag_ms": TAP})
    assert list(draft(table).signals) == ["reaction time", "lag_ms"]


def stick() -> control.StateSpace:
    """A stick that falls in 0.3 s; the push is recorded, and so may be its rate."""
    system = control.c2d(control.ss([[0, 1], [9.8, 0]], [[0, 0], [1, 1]], np.eye(2), 0), 1 / RATE)
    names = {"inputs": ["command", "push"], "outputs": ["angle", "rate"]}
    system = control.ss(system.A, system.B, system.C, 0, 1 / RATE, **names)
    system.units = {"angle": "rad"}
    return system


def recorded(path: Path, tilt: str = "", tap: str = "", more: str = "") -> Recording:
    """The recording of a file with the answers of its questions."""
    asked = tomllib.loads(
        f'[recording]\ntime = "time"\n{more}\n[plant]\noutputs = ["angle"]\n'
        f'[signals.angle]\ncolumn = "tilt"\nunit = "deg"\n{tilt}\n'
        f'[signals.push]\ncolumn = "tap"\nunit = "1"\n{tap}\n'
    )
    found = configuration(asked, "a.toml")
    plant = make_plant(PlantSource("stick", stick, found.plant), found.recorded)
    return recording_of(read_table(path), found, plant)


ANSWERS: dict[str, tuple[str, dict[str, str], dict[str, str]]] = {
    "-9999": (
        "write missing = -9999 in [signals.angle], otherwise missing = []",
        {"tilt": "missing = -9999", "more": "fill_gaps = 0.05"},
        {"tilt": "missing = [999, -9999.0]", "more": "fill_gaps = 0.05"},
    ),
    "a dash": ("15 of 300 samples are missing", {"more": "fill_gaps = 0.05"}, {}),
    "changes": (
        "write held = true in [signals.push], otherwise held = false", {"tap": "held = true"}, {}
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", ANSWERS)
def test_the_line_that_is_asked_for_answers(name: str, tmp_path: Path) -> None:
    refused, *answers = ANSWERS[name]
    path = written(tmp_path, *SAID[name][0])
    with pytest.raises(InputError, match=re.escape(refused)):
        recorded(path)
    held = np.repeat(np.resize([1.5, -1.5, 0], SAMPLES)[::10], 10)
    for answer in filter(None, answers):
        trial = recorded(path, **answer)
        assert trial.outputs.shape == (SAMPLES, 1)
        kept = np.delete(np.arange(SAMPLES), SOME)
        np.testing.assert_allclose(trial.outputs[kept, 0], np.deg2rad(TILT[kept]), atol=1e-9)
        if "tap" in answer:
            np.testing.assert_array_equal(trial.disturbance[:, 0], held)


def test_a_value_that_is_none_is_kept(tmp_path: Path) -> None:
    path = written(tmp_path, *SAID["99.99"][0])
    trial = recorded(path, "missing = []")
    assert trial.outputs.max() == pytest.approx(np.deg2rad(99.99))


def test_an_output_that_is_not_recorded(tmp_path: Path) -> None:
    """The angle determines both states of the stick, its rate too; of two sticks each its own."""
    source = PlantSource("stick", stick, {"outputs": ["rate"]})
    plant = make_plant(source, ["push"])
    assert (plant.outputs, plant.C.shape) == (("rate",), (1, 2))
    two = control.append(stick(), stick())
    names = {"inputs": list("abcd"), "outputs": list("wxyz")}

    def pair() -> control.StateSpace:
        return control.ss(two.A, two.B, two.C, 0, 1 / RATE, **names)

    for outputs, said in (
        (["w"], "[plant] outputs: do not determine all states; that needs x, y, z"),
        (["v"], "[plant] outputs: has no output 'v'; choose from w, x, y, z"),
        ("w", "[plant] outputs: is no list of names"),
    ):
        with pytest.raises(InputError, match=re.escape(said)):
            make_plant(PlantSource("two", pair, {"outputs": outputs}), [])
    assert make_plant(PlantSource("two", pair, {"outputs": ["w", "z"]}), []).n == 4
