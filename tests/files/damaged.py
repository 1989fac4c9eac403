"""Damaged recordings: each with a phrase of the one line in which it must end.

``DAMAGED[name].make(folder)`` writes the file and returns its path and the text of a configuration
for `plants:seated_balance_plant`. `in_file` says that the fault shows without a configuration.
"""

from __future__ import annotations

import struct
import warnings
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

import c3d
import h5py
import numpy as np
from nptdms import ChannelObject, TdmsWriter

from impc.files.formats import write_table
from impc.files.table import make_table
from tests.files.samples import csv_text, hdf5_mat, pushed_seat, save_mat, settings

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from impc.arrays import Array

__all__ = ["DAMAGED", "PLANT", "Damage"]

#: The plant that the configurations are for, as the command line takes it.
PLANT = "plants:seated_balance_plant"

Made = tuple["Path", str]


@dataclass(frozen=True)
class Damage:
    """How to make a damaged recording, and what must be said of it."""

    make: Callable[[Path], Made]
    phrase: str
    in_file: bool


DAMAGED: dict[str, Damage] = {}
_RATE = ('time = "time"', "")  # TDMS and C3D tell their rate


def _damage(phrase: str, in_file: bool = True) -> Callable[[Callable[[Path], Made]], None]:
    def register(make: Callable[[Path], Made]) -> None:
        name = make.__name__.strip("_").replace("_", " ")
        assert name not in DAMAGED
        DAMAGED[name] = Damage(make, phrase, in_file)

    return register


def _file(folder: Path, content: bytes | str, name: str = "trial.csv") -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def _csv(folder: Path, **changed: Array) -> Path:
    return _file(folder, csv_text({**pushed_seat(), **changed}))


def _written(folder: Path, name: str) -> Path:
    columns = pushed_seat()
    columns.pop("time")
    write_table(folder / name, make_table(name, columns, {"seat": "deg", "trunk": "deg"}, 100.0))
    return folder / name


def _cut(path: Path, share: float) -> Path:
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    return path


# The file as such -----------------------------------------------------------------------------


@_damage("does not exist")
def _missing_file(folder: Path) -> Made:
    return folder / "trial.csv", settings()


@_damage("is a folder")
def _folder_for_a_file(folder: Path) -> Made:
    (folder / "trial.csv").mkdir()
    return folder / "trial.csv", settings()


@_damage("is empty (0 bytes)")
def _empty_csv(folder: Path) -> Made:
    return _file(folder, ""), settings()


@_damage("is empty (0 bytes)")
def _empty_mat(folder: Path) -> Made:
    return _file(folder, "", "trial.mat"), settings()


def _sparse(path: Path) -> Path:
    with path.open("wb") as file:
        file.truncate(2_000_000_000)
    return path


@_damage("has 2.0 GB")
def _sparse_csv_of_two_gigabytes(folder: Path) -> Made:
    return _sparse(folder / "trial.csv"), settings()


@_damage("has 2.0 GB")
def _sparse_mat_of_two_gigabytes(folder: Path) -> Made:
    return _sparse(folder / "trial.mat"), settings()


@_damage("has the ending '.xlsx'")
def _excel_workbook(folder: Path) -> Made:
    return _file(folder, b"PK\x03\x04" + bytes(100), "trial.xlsx"), settings()


@_damage("a zip archive or an Excel workbook")
def _excel_workbook_called_csv(folder: Path) -> Made:
    return _file(folder, b"PK\x03\x04" + bytes(100)), settings()


@_damage("is a MATLAB file")
def _mat_called_csv(folder: Path) -> Made:
    save_mat(folder / "trial.csv", pushed_seat())
    return folder / "trial.csv", settings()


@_damage("a Python pickle")
def _pickle_called_mat(folder: Path) -> Made:
    return _file(folder, b"\x80\x04\x95" + bytes(600), "trial.mat"), settings()


# Delimited text -------------------------------------------------------------------------------


@_damage("is empty")
def _csv_of_blank_lines(folder: Path) -> Made:
    return _file(folder, "\n \n\n"), settings()


@_damage("no rows of numbers")
def _csv_of_a_header_alone(folder: Path) -> Made:
    return _file(folder, "time,seat,trunk,push\n"), settings()


@_damage("a zero byte in line 4")
def _zero_bytes_in_csv(folder: Path) -> Made:
    lines = csv_text(pushed_seat()).split("\n")
    lines[3] = "\0" * 20
    return _file(folder, "\n".join(lines)), settings()


@_damage("ends in the middle of a row")
def _truncated_csv(folder: Path) -> Made:
    text = csv_text(pushed_seat())
    return _file(folder, text[: text.rindex(",") - 3]), settings()


@_damage("is divided by bars")
def _wrong_delimiter(folder: Path) -> Made:
    return _file(folder, csv_text(pushed_seat(), "|")), settings()


@_damage("is divided by commas")
def _tsv_with_commas(folder: Path) -> Made:
    return _file(folder, csv_text(pushed_seat()), "trial.tsv"), settings()


@_damage("names 4 columns, and the rows below have 8 values")
def _decimal_commas_between_commas(folder: Path) -> Made:
    shifted = {name: values + 0.123456 for name, values in pushed_seat().items()}
    return _file(folder, csv_text(shifted, ",", ",")), settings()


@_damage("column 'seat' has text in 2 of 600 rows, the first 'overload' in line 12")
def _text_in_a_column(folder: Path) -> Made:
    lines = csv_text(pushed_seat()).split("\n")
    for line in (11, 40):
        time, _, *rest = lines[line].split(",")
        lines[line] = ",".join([time, "overload", *rest])
    return _file(folder, "\n".join(lines)), settings()


@_damage("is text, such as 'left' in line 2", in_file=False)
def _column_of_text(folder: Path) -> Made:
    header, *lines = csv_text(pushed_seat()).strip().split("\n")
    text = "\n".join([header + ",side", *(line + ",left" for line in lines)])
    return _file(folder, text), settings(('"seat"', '"side"'))


@_damage("line 31 has 5 values where the first row has 4")
def _row_with_a_value_more(folder: Path) -> Made:
    lines = csv_text(pushed_seat()).split("\n")
    lines[30] += ",1.0"
    return _file(folder, "\n".join(lines)), settings()


@_damage("names two columns 'seat'")
def _two_columns_of_one_name(folder: Path) -> Made:
    return _file(folder, csv_text(pushed_seat()).replace("trunk", "seat", 1)), settings()


@_damage("names 3 columns")
def _header_too_short(folder: Path) -> Made:
    return _file(folder, csv_text(pushed_seat()).replace(",push", "", 1)), settings()


# MATLAB ---------------------------------------------------------------------------------------


@_damage("is damaged and cannot be read")
def _truncated_mat(folder: Path) -> Made:
    save_mat(folder / "trial.mat", pushed_seat())
    return _cut(folder / "trial.mat", 0.6), settings()


@_damage("is damaged and cannot be read")
def _compressed_mat_with_wrong_bytes(folder: Path) -> Made:
    path = folder / "trial.mat"
    save_mat(path, pushed_seat(), do_compression=True)
    content = bytearray(path.read_bytes())
    content[2000:2100] = bytes(100)
    path.write_bytes(content)
    return path, settings()


@_damage("is damaged and cannot be read")
def _truncated_mat_of_version_73(folder: Path) -> Made:
    hdf5_mat(folder / "trial.mat", pushed_seat())
    return _cut(folder / "trial.mat", 0.6), settings()


@_damage("says that it is version 5 and holds version 7.3")
def _version_73_called_5(folder: Path) -> Made:
    path = folder / "trial.mat"
    hdf5_mat(path, pushed_seat())
    with path.open("r+b") as file:
        file.write(b"MATLAB 5.0 MAT-file".ljust(116) + bytes(8) + b"\0\1IM")
    return path, settings()


@_damage("says that it is version 7.3 and holds version 5")
def _version_5_called_73(folder: Path) -> Made:
    path = folder / "trial.mat"
    save_mat(path, pushed_seat())
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(116) + bytes(8) + b"\0\2IM")
    return path, settings()


def _element(kind: int, content: bytes) -> bytes:
    """One element of a v5 file: its type, its length, its bytes, filled up to eight."""
    return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)


@_damage("T is a MATLAB table")
def _table_object(folder: Path) -> Made:
    # As MATLAB writes one: class 17 (opaque), then name, kind of object, class, and a reference.
    numbers = _element(6, struct.pack("<II", 13, 0)) + _element(5, struct.pack("<ii", 6, 1))
    reference = _element(14, numbers + _element(1, b"") + _element(6, bytes(24)))
    names = b"".join(_element(1, name) for name in (b"T", b"MCOS", b"table"))
    opaque = _element(14, _element(6, struct.pack("<II", 17, 0)) + names + reference)
    header = b"MATLAB 5.0 MAT-file".ljust(116) + bytes(8) + b"\0\1IM"
    return _file(folder, header + opaque, "trial.mat"), settings()


@_damage("T is a MATLAB table")
def _table_object_of_version_73(folder: Path) -> Made:
    path = folder / "trial.mat"
    hdf5_mat(path, {"T": np.arange(6, dtype=np.uint32)}, {"T": "table"})
    return path, settings()


@_damage("is a cell array")
def _cell_array(folder: Path) -> Made:
    cells = np.empty(2, dtype=object)
    cells[:] = [np.arange(5.0), "seat"]
    save_mat(folder / "trial.mat", {"data": cells})
    return folder / "trial.mat", settings()


@_damage("holds no column of numbers")
def _mat_of_text_and_one_number(folder: Path) -> Made:
    save_mat(folder / "trial.mat", {"subject": "S01", "fs": 100.0})
    return folder / "trial.mat", settings()


@_damage("is complex")
def _complex_signal(folder: Path) -> Made:
    save_mat(folder / "trial.mat", {"seat": np.exp(1j * np.arange(600))})
    return folder / "trial.mat", settings()


@_damage("has 3 dimensions")
def _three_dimensions(folder: Path) -> Made:
    save_mat(folder / "trial.mat", {"data": np.zeros((5, 6, 7))})
    return folder / "trial.mat", settings()


@_damage("would take 4.0 GB")
def _mat_that_unpacks_to_too_much(folder: Path) -> Made:
    path = folder / "trial.mat"
    save_mat(path, {"seat": np.arange(600.0)})
    # The tag in front of a packed variable says how long it is once unpacked.
    packed = zlib.compress(struct.pack("<II", 14, 4_000_000_000) + bytes(10_000))
    path.write_bytes(path.read_bytes()[:128] + struct.pack("<II", 15, len(packed)) + packed)
    return path, settings()


@_damage("seat points elsewhere")
def _link_to_another_file(folder: Path) -> Made:
    path = folder / "trial.mat"
    hdf5_mat(folder / "other.mat", pushed_seat())
    hdf5_mat(path, {"time": np.arange(600.0)})
    with h5py.File(path, "r+") as file:
        file["seat"] = h5py.ExternalLink("other.mat", "seat")
    return path, settings()


@_damage("seat lies in another file")
def _data_in_another_file(folder: Path) -> Made:
    path = folder / "trial.mat"
    (folder / "raw").write_bytes(bytes(8 * 600))
    hdf5_mat(path, {"time": np.arange(600.0)})
    with h5py.File(path, "r+") as file:
        external = [(folder / "raw", 0, 8 * 600)]
        file.create_dataset("seat", (600,), "f8", external=external)
    return path, settings()


@_damage("does not begin as such a file")
def _text_called_mat(folder: Path) -> Made:
    return _file(folder, csv_text(pushed_seat()), "trial.mat"), settings()


# TDMS and C3D ---------------------------------------------------------------------------------


@_damage("ends in the middle of its data")
def _truncated_tdms(folder: Path) -> Made:
    return _cut(_written(folder, "trial.tdms"), 0.6), settings(_RATE)


@_damage("does not begin as such a file")
def _text_called_tdms(folder: Path) -> Made:
    return _file(folder, csv_text(pushed_seat()), "trial.tdms"), settings(_RATE)


@_damage("has channels of 100 and 200 samples per second")
def _tdms_of_two_rates(folder: Path) -> Made:
    rates = {"seat": 100.0, "trunk": 200.0}
    with TdmsWriter(str(folder / "trial.tdms")) as writer:
        writer.write_segment(
            [
                ChannelObject("g", name, pushed_seat()[name], {"wf_increment": 1 / rate})
                for name, rate in rates.items()
            ]
        )
    return folder / "trial.tdms", settings(_RATE)


@_damage("holds no column of numbers")
def _tdms_of_text(folder: Path) -> Made:
    with TdmsWriter(str(folder / "trial.tdms")) as writer:
        writer.write_segment([ChannelObject("g", "notes", ["a", "b"])])
    return folder / "trial.tdms", settings(_RATE)


@_damage("says 100 samples per second and recording.rate 500", in_file=False)
def _rate_that_contradicts_the_file(folder: Path) -> Made:
    return _written(folder, "trial.tdms"), settings((_RATE[0], "rate = 500.0"))


@_damage("of 600 frames")
def _truncated_c3d(folder: Path) -> Made:
    return _cut(_written(folder, "trial.c3d"), 0.6), settings(_RATE)


@_damage("does not begin as such a file")
def _text_called_c3d(folder: Path) -> Made:
    return _file(folder, csv_text(pushed_seat()), "trial.c3d"), settings(_RATE)


@_damage("is damaged and cannot be read")
def _c3d_with_a_wrong_header(folder: Path) -> Made:
    path = _written(folder, "trial.c3d")
    content = bytearray(path.read_bytes())
    content[4] += 1  # number of analog measurements in a frame
    path.write_bytes(content)
    return path, settings(_RATE)


@_damage("has no analog channels")
def _c3d_of_markers_alone(folder: Path) -> Made:
    writer = c3d.Writer(point_rate=100.0)
    writer.set_point_labels(["head"])
    writer.add_frames([(np.zeros((1, 5)), np.zeros((0, 0))) for _ in range(20)])
    with (folder / "trial.c3d").open("wb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # c3d warns of what is missing
        writer.write(file)
    return folder / "trial.c3d", settings(_RATE)


# The clock ------------------------------------------------------------------------------------


def _time(change: Callable[[Array], object]) -> Array:
    time = pushed_seat()["time"].copy()
    change(time)
    return time


@_damage("is repeated 3 times, the first from sample 101 to 102", in_file=False)
def _duplicated_time_stamps(folder: Path) -> Made:
    time = _time(lambda time: time.__setitem__(slice(101, 104), time[100]))
    return _csv(folder, time=time), settings()


@_damage("runs backward 1 times, the first from sample 300 to 301", in_file=False)
def _clock_that_runs_backward(folder: Path) -> Made:
    time = _time(lambda time: time.__setitem__(slice(300, 600), time[:300]))
    return _csv(folder, time=time), settings()


@_damage("has 1 missing times, the first in sample 8", in_file=False)
def _missing_time(folder: Path) -> Made:
    return _csv(folder, time=_time(lambda time: time.__setitem__(7, np.nan))), settings()


@_damage("has 1 gaps, the first at 2 s, the longest of 0.51 s", in_file=False)
def _gap_in_the_clock(folder: Path) -> Made:
    time = _time(lambda time: time.__setitem__(slice(201, 600), time[201:] + 0.5))
    return _csv(folder, time=time), settings()


@_damage("is uneven", in_file=False)
def _uneven_clock(folder: Path) -> Made:
    time = np.cumsum(np.where(np.arange(600) % 2, 0.0196, 0.0004))
    return _csv(folder, time=time), settings()


@_damage("column 'clock': is not in the file", in_file=False)
def _absent_clock(folder: Path) -> Made:
    return _csv(folder), settings(('"time"', '"clock"'))


@_damage("tells no clock and no rate", in_file=False)
def _unknown_rate(folder: Path) -> Made:
    return _csv(folder), settings(_RATE)


@_damage("is no time", in_file=False)
def _clock_in_degrees(folder: Path) -> Made:
    return _csv(folder), settings(('time = "time"', 'time = "time"\ntime_unit = "deg"'))


@_damage("does not reach recording.stop = 60 s", in_file=False)
def _cut_behind_the_end(folder: Path) -> Made:
    return _csv(folder), settings(('time = "time"', 'time = "time"\nstop = 60.0'))


# Channels -------------------------------------------------------------------------------------


def _seat(change: Callable[[Array], object]) -> Array:
    seat = pushed_seat()["seat"].copy()
    change(seat)
    return seat


@_damage("column 'seat angle': is not in the file", in_file=False)
def _absent_column(folder: Path) -> Made:
    return _csv(folder), settings(('"seat"', '"seat angle"'))


@_damage("is in 'rad' by the configuration and in 'deg' by the file", in_file=False)
def _units_swapped_against_the_file(folder: Path) -> Made:
    text = csv_text(pushed_seat()).replace("seat", "seat (deg)", 1)
    return _file(folder, text), settings(
        ('column = "seat"\nunit = "deg"\nlimit = 12.0', 'column = "seat"\nunit = "rad"')
    )


@_damage("degrees taken for radians", in_file=False)
def _degrees_called_radians(folder: Path) -> Made:
    return _csv(folder), settings(('unit = "deg"\nlimit = 12.0', 'unit = "rad"'))


@_damage("radians taken for degrees", in_file=False)
def _radians_called_degrees(folder: Path) -> Made:
    return _csv(folder, seat=_seat(lambda seat: np.deg2rad(seat, out=seat))), settings()


@_damage("10 of 600 samples are missing or not finite, the first sample 51", in_file=False)
def _missing_samples(folder: Path) -> Made:
    seat = _seat(lambda seat: seat.__setitem__(slice(50, 60), np.nan))
    return _csv(folder, seat=seat), settings()


@_damage("1 of 600 samples are missing or not finite, the first sample 100", in_file=False)
def _infinite_sample(folder: Path) -> Made:
    return _csv(folder, seat=_seat(lambda seat: seat.__setitem__(99, np.inf))), settings()


@_damage("at an end of the recording", in_file=False)
def _missing_end(folder: Path) -> Made:
    seat = _seat(lambda seat: seat.__setitem__(slice(590, 600), np.nan))
    return _csv(folder, seat=seat), settings(('time = "time"', 'time = "time"\nfill_gaps = 1.0'))


@_damage("is constant at 0 deg in all 600 samples", in_file=False)
def _constant_channel(folder: Path) -> Made:
    return _csv(folder, seat=np.zeros(600)), settings()


@_damage("is constant at 0 Nm", in_file=False)
def _perturbation_that_never_acts(folder: Path) -> Made:
    return _csv(folder, push=np.zeros(600)), settings()


@_damage("is beyond its stop of 12 deg", in_file=False)
def _angle_beyond_the_stop(folder: Path) -> Made:
    return _csv(folder, seat=_seat(lambda seat: seat.__setitem__(70, 13.0))), settings()


@_damage("is clipped at 2 deg", in_file=False)
def _clipped_channel(folder: Path) -> Made:
    return _csv(folder, seat=np.clip(pushed_seat()["seat"], -2.0, 2.0)), settings()


@_damage("has 40 samples at the plant's rate, 50 are needed", in_file=False)
def _too_few_samples(folder: Path) -> Made:
    short = {name: values[:40] for name, values in pushed_seat().items()}
    return _file(folder, csv_text(short)), settings()


# The configuration ----------------------------------------------------------------------------


@_damage("signals.theta2: is missing", in_file=False)
def _output_without_a_column(folder: Path) -> Made:
    return _csv(folder), settings(('[signals.theta2]\ncolumn = "trunk"\nunit = "deg"\n', ""))


@_damage("signals.theta3: is no output", in_file=False)
def _signal_that_the_plant_lacks(folder: Path) -> Made:
    return _csv(folder), settings(("signals.theta2", "signals.theta3"))


@_damage("signals.theta1.limt: is not known; did you mean limit?", in_file=False)
def _misspelled_key(folder: Path) -> Made:
    return _csv(folder), settings(("limit", "limt"))


@_damage("signals.theta1.limit: Expected 'float | null', got 'str'", in_file=False)
def _limit_in_words(folder: Path) -> Made:
    return _csv(folder), settings(("limit = 12.0", 'limit = "12"'))


@_damage("unit 'wibble' is not known", in_file=False)
def _unknown_unit(folder: Path) -> Made:
    return _csv(folder), settings(('unit = "Nm"', 'unit = "wibble"'))


@_damage("signals.perturbation.unit: is still '?'", in_file=False)
def _unit_not_filled_in(folder: Path) -> Made:
    return _csv(folder), settings(('unit = "Nm"', 'unit = "?"'))


@_damage("is not TOML", in_file=False)
def _configuration_that_is_no_toml(folder: Path) -> Made:
    return _csv(folder), settings(("[signals.theta1]", "[signals.theta1"))


@_damage("does not match recording.pattern", in_file=False)
def _name_that_does_not_match(folder: Path) -> Made:
    pattern = "pattern = '(?P<subject>[^_]+)_(?P<trial>[0-9]+)'"
    return _csv(folder), settings(('subject = "S01"', pattern))


@_damage("is no regular expression", in_file=False)
def _pattern_that_is_none(folder: Path) -> Made:
    return _csv(folder), settings(('subject = "S01"', "pattern = '(?P<subject>'"))
