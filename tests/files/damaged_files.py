"""Damaged recordings and invalid settings, with the error that each must give.

`DAMAGED[name]` has a phrase of the expected one-line message, and a function of a folder that
writes the file and returns its path and the text of a configuration for `PLANT`.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import c3d
import h5py
import numpy as np
from nptdms import ChannelObject, TdmsWriter

from impc.files.formats import write_table
from impc.files.table import make_table
from tests.files.samples import csv_text, hdf5_mat, opaque_variable, pushed_seat, save_mat, settings

__all__ = ["DAMAGED", "PLANT", "written", "written_by_impc"]

#: Plant of the configurations, as given on the command line.
PLANT = "plants:seated_balance_plant"
Make = Callable[[Path], tuple[Path, str]]
Change = tuple[str, str]
#: TDMS and C3D state their rate: the configuration has no clock.
OWN_RATE = ('time = "time"', "")
SEAT = pushed_seat()
TEXT = csv_text(SEAT)
LINES = TEXT.split("\n")


def written(folder: Path, content: bytes | str, name: str = "trial.csv") -> Path:
    """A file with this content."""
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def written_by_impc(folder: Path, name: str) -> Path:
    """The pushed seat at 100 samples per second, without its clock."""
    columns = pushed_seat()
    columns.pop("time")
    write_table(folder / name, make_table(name, columns, {"seat": "deg", "trunk": "deg"}, 100.0))
    return folder / name


def made(fill: Callable[[Path], object], name: str = "trial.csv", *changes: Change) -> Make:
    """File that `fill` writes, and settings with these changes."""

    def make(folder: Path) -> tuple[Path, str]:
        fill(folder / name)
        return folder / name, settings(*changes)

    return make


def text(content: bytes | str, name: str = "trial.csv", *changes: Change) -> Make:
    return made(lambda path: written(path.parent, content, name), name, *changes)


def lines(changed: dict[int, str]) -> Make:
    """The valid text with some lines replaced."""
    return text("\n".join((dict(enumerate(LINES)) | changed).values()))


def seat(*changes: Change, **columns: Any) -> Make:
    """The valid text with other columns and settings."""
    return text(csv_text({**SEAT, **columns}), "trial.csv", *changes)


def changed(name: str, where: slice | int, value: Any) -> Any:
    """A column with some samples replaced."""
    column = SEAT[name].copy()
    column[where] = value
    return column


def cut(make: Make) -> Make:
    """The first 60 % of a file."""
    return broken(make, lambda content: content[: int(0.6 * len(content))])


def broken(make: Make, change: Callable[[bytes], bytes]) -> Make:
    def remade(folder: Path) -> tuple[Path, str]:
        path, configuration = make(folder)
        path.write_bytes(change(path.read_bytes()))
        return path, configuration

    return remade


def mat(values: dict[str, Any], name: str = "trial.mat", **options: Any) -> Make:
    """A .mat file of version 5 by scipy."""
    return made(lambda path: save_mat(path, values, **options), name)


def mat73(values: dict[str, Any], classes: dict[str, str] | None = None) -> Make:
    """A .mat file of version 7.3 by h5py."""
    return made(lambda path: hdf5_mat(path, values, classes), "trial.mat")


def linked(add: Callable[[Path, Any], object]) -> Make:
    """A .mat file of version 7.3 whose seat is a link to another file."""

    def fill(path: Path) -> None:
        hdf5_mat(path.with_name("other.mat"), SEAT)
        path.with_name("raw").write_bytes(bytes(8 * 600))
        hdf5_mat(path, {"time": np.arange(600.0)})
        with h5py.File(path, "r+") as file:
            add(path.with_name("raw"), file)

    return made(fill, "trial.mat")


def outside(raw: Path, file: Any) -> None:
    file.create_dataset("seat", (600,), "f8", external=[(raw, 0, 8 * 600)])


def own(name: str, change: Change = OWN_RATE) -> Make:
    """A TDMS or C3D file as impc writes it."""
    return made(lambda path: written_by_impc(path.parent, name), name, change)


def tdms(*channels: tuple[Any, ...]) -> Make:
    def fill(path: Path) -> None:
        with TdmsWriter(str(path)) as writer:
            writer.write_segment([ChannelObject("g", *channel) for channel in channels])

    return made(fill, "trial.tdms", OWN_RATE)


def markers(path: Path) -> None:
    writer = c3d.Writer(point_rate=100.0)
    writer.set_point_labels(["head"])
    writer.add_frames([(np.zeros((1, 5)), np.zeros((0, 0))) for _ in range(20)])
    with path.open("wb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # c3d warns of what is missing
        writer.write(file)


def sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(2_000_000_000)


def head_of(version: str, end: bytes) -> bytes:
    return f"MATLAB {version} MAT-file".encode().ljust(116) + bytes(8) + end


HEAD_5, HEAD_73 = head_of("5.0", b"\0\1IM"), head_of("7.3", b"\0\2IM")
PICKLE, ZIP, XLS = b"\x80\x04\x95" + bytes(600), b"PK\x03\x04" + bytes(100), b"\xd0\xcf\x11\xe0"
CELLS = np.empty(2, dtype=object)
CELLS[:] = [np.arange(5.0), "seat"]
SHIFTED = {name: values + 0.123456 for name, values in SEAT.items()}
SIDES = "\n".join([LINES[0] + ",side", *(line + ",left" for line in LINES[1:-1])])
RATES = [("seat", 100.0), ("trunk", 5000.0)]
DEGREES = 'column = "seat"\nunit = "deg"\nlimit = 12.0'
UNEVEN = np.cumsum(np.where(np.arange(600) % 2, 0.0196, 0.0004))
THETA2 = '[signals.theta2]\ncolumn = "trunk"\nunit = "deg"\n'
PATTERN = "pattern = '(?P<subject>[^_]+)_(?P<trial>[0-9]+)'"

DAMAGED: dict[str, tuple[str, Make]] = {
    "missing file": ("does not exist", made(lambda _: None)),
    "folder for a file": ("is a folder", made(Path.mkdir)),
    "empty csv": ("is empty (0 bytes)", text("")),
    "empty mat": ("is empty (0 bytes)", text("", "trial.mat")),
    "csv of two gigabytes": ("has 2.0 GB", made(sparse)),
    "mat of two gigabytes": ("has 2.0 GB", made(sparse, "trial.mat")),
    "old workbook": ("has the ending '.xls'", text(XLS + bytes(100), "trial.xls")),
    "no workbook": (
        "is damaged and cannot be read (File is not a zip file)", text(ZIP, "trial.xlsx")
    ),
    "workbook called csv": ("a zip archive or an Excel workbook", text(ZIP)),
    "mat called csv": ("is a MATLAB file", mat(SEAT, "trial.csv")),
    "pickle called mat": ("a Python pickle", text(PICKLE, "trial.mat")),
    **{
        f"text called {ending}": (
            "does not begin as such a file", text(TEXT, f"trial.{ending}", OWN_RATE)
        )
        for ending in ("mat", "tdms", "c3d")
    },
    # Delimited text
    "blank lines": ("is empty", text("\n \n\n")),
    "header alone": ("no rows of numbers", text("time,seat,trunk,push\n")),
    "zero bytes": ("a zero byte in line 4", lines({3: "\0" * 20})),
    "truncated csv": ("ends in the middle of a row", text(TEXT[: TEXT.rindex(",") - 3])),
    "decimal commas between commas": (
        "names 4 columns, but the rows below have 8 values", text(csv_text(SHIFTED, ",", ","))
    ),
    "column of words": (
        "is text, such as 'left' in line 2", text(SIDES, "trial.csv", ('"seat"', '"side"'))
    ),
    "row with a value more": (
        "line 31 has 5 values where the first row has 4", lines({30: LINES[30] + ",1.0"})
    ),
    "two columns of one name": (
        "signals.theta2.column may be time, seat, seat_2, push",
        lines({0: "time,seat,seat,push"}),
    ),
    "header too short": ("names 3 columns", lines({0: "time,seat,trunk"})),
    # MATLAB
    "truncated mat": ("is damaged and cannot be read", cut(mat(SEAT))),
    "truncated 7.3": ("is damaged and cannot be read", cut(mat73(SEAT))),
    "packed mat with wrong bytes": (
        "is damaged and cannot be read",
        broken(mat(SEAT, do_compression=True), lambda c: c[:2000] + bytes(100) + c[2100:]),
    ),
    "5 called 7.3": (
        "is damaged and cannot be read (Please use HDF reader",
        broken(mat(SEAT), lambda content: HEAD_73 + content[128:]),
    ),
    "table object": (
        "T is a MATLAB table", text(HEAD_5 + opaque_variable(b"T", b"table"), "trial.mat")
    ),
    "table object of 7.3": (
        "T is a MATLAB table", mat73({"T": np.arange(6, dtype=np.uint32)}, {"T": "table"})
    ),
    "cell array": ("is a cell array", mat({"data": CELLS})),
    "text and one number": ("has no column of numbers", mat({"subject": "S01", "fs": 100.0})),
    "complex signal": ("is complex", mat({"seat": np.exp(1j * np.arange(600))})),
    "three dimensions": ("has 3 dimensions", mat({"data": np.zeros((5, 6, 7))})),
    "link to another file": (
        "seat is a link",
        linked(lambda _, file: file.update(seat=h5py.ExternalLink("other.mat", "seat"))),
    ),
    "data in another file": ("seat lies in another file", linked(outside)),
    # TDMS and C3D
    "truncated tdms": ("ends in the middle of its data", cut(own("trial.tdms"))),
    "tdms of clocks far apart": (
        "has clocks without a common span: clock of seat (0 to 5.99 by 0.01), clock of trunk (",
        tdms(*((name, SEAT[name], {"wf_increment": 1 / rate}) for name, rate in RATES)),
    ),
    "tdms of text": ("has no column of numbers", tdms(("notes", ["a", "b"]))),
    "rate that contradicts the file": (
        "states 100 samples per second, but recording.rate is 500",
        own("trial.tdms", (OWN_RATE[0], "rate = 500.0")),
    ),
    "truncated c3d": ("of 600 frames", cut(own("trial.c3d"))),
    "c3d with a wrong header": (  # number of analog measurements in a frame
        "is damaged and cannot be read",
        broken(own("trial.c3d"), lambda c: c[:4] + bytes([c[4] + 1]) + c[5:]),
    ),
    "c3d of markers alone": ("has no analog channels", made(markers, "trial.c3d", OWN_RATE)),
    # The clock
    "times repeated": (
        "is repeated 3 times, the first from sample 101 to 102",
        seat(time=changed("time", slice(101, 104), 1.0)),
    ),
    "clock that runs backward": (
        "runs backward 1 times, the first from sample 300 to 301",
        seat(time=changed("time", slice(300, 301), 2.98)),
    ),
    "missing time": (
        "has 1 missing times, the first in sample 8", seat(time=changed("time", 7, np.nan))
    ),
    "gap in the clock": (
        "has 1 gaps, the first at 2 s, the longest of 0.51 s",
        seat(time=changed("time", slice(201, 600), SEAT["time"][201:] + 0.5)),
    ),
    "uneven clock": ("is not uniform", seat(time=UNEVEN)),
    "absent clock": ("column 'clock': is not in the file", seat(('"time"', '"clock"'))),
    "unknown rate": ("has neither a time column nor a sampling rate", seat(OWN_RATE)),
    "clock in degrees": ("is not a unit of time", seat(('"time"', '"time"\ntime_unit = "deg"'))),
    "cut behind the end": (
        "recording.stop = 60 s lies outside the recording", seat(('"time"', '"time"\nstop = 60.0'))
    ),
    # Channels
    "absent column": (
        "column 'seat angle': is not in the file", seat(('"seat"', '"seat angle"'))
    ),
    "unit against the file": (
        "has the unit 'rad' in the configuration and 'deg' in the file",
        text(
            TEXT.replace("seat", "seat (deg)", 1),
            "trial.csv",
            (DEGREES, 'column = "seat"\nunit = "rad"'),
        ),
    ),
    "degrees called radians": (
        "may hold degrees instead of radians", seat(('unit = "deg"\nlimit = 12.0', 'unit = "rad"'))
    ),
    "radians called degrees": ("if the column holds radians", seat(seat=np.deg2rad(SEAT["seat"]))),
    "missing samples": (
        "10 of 600 samples are missing or not finite, the first sample 51",
        seat(seat=changed("seat", slice(50, 60), np.nan)),
    ),
    "infinite sample": (
        "1 of 600 samples are missing or not finite, the first sample 100",
        seat(seat=changed("seat", 99, np.inf)),
    ),
    "missing end": (
        "at an end of the recording",
        seat(
            ('"time"', '"time"\nfill_gaps = 1.0'), seat=changed("seat", slice(590, 600), np.nan)
        ),
    ),
    "constant channel": ("is constant at 0 deg in all 600 samples", seat(seat=np.zeros(600))),
    "push that never acts": ("is constant at 0 Nm", seat(push=np.zeros(600))),
    "angle beyond the stop": (
        "exceeds its mechanical stop of 12 deg", seat(seat=changed("seat", 70, 13.0))
    ),
    "clipped channel": ("is clipped at 2 deg", seat(seat=np.clip(SEAT["seat"], -2.0, 2.0))),
    "too few samples": (
        "has 40 samples at the plant's rate, 50 are needed",
        text(csv_text({name: values[:40] for name, values in SEAT.items()})),
    ),
    # The configuration
    "output without a column": ("signals.theta2: is missing", seat((THETA2, ""))),
    "signal that the plant lacks": (
        "signals.theta3: is no output", seat(("signals.theta2", "signals.theta3"))
    ),
    "misspelled key": (
        "signals.theta1.limt: is not known; did you mean limit?", seat(("limit", "limt"))
    ),
    "limit in words": (
        "signals.theta1.limit: Expected 'float | null', got 'str'",
        seat(("limit = 12.0", 'limit = "12"')),
    ),
    "unknown unit": ("unit 'wibble' is not known", seat(('unit = "Nm"', 'unit = "wibble"'))),
    "unit not filled in": (
        "signals.perturbation.unit: is still '?'", seat(('unit = "Nm"', 'unit = "?"'))
    ),
    "no toml": ("is not TOML", seat(("[signals.theta1]", "[signals.theta1"))),
    "name that does not match": (
        "does not match recording.pattern", seat(('subject = "S01"', PATTERN))
    ),
    "no regular expression": (
        "is not a regular expression", seat(('subject = "S01"', "pattern = '(?P<subject>'"))
    ),
}  # fmt: skip
