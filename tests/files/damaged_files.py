"""Files that are damaged themselves, or not what they say that they are."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import c3d
import h5py
import numpy as np
from nptdms import ChannelObject, TdmsWriter

from tests.files.damage import OWN_RATE, Damage, Made, register, written, written_by_impc
from tests.files.samples import (
    csv_text,
    hdf5_mat,
    opaque_variable,
    pushed_seat,
    save_mat,
    settings,
)

__all__ = ["DAMAGED_FILES"]

DAMAGED_FILES: dict[str, Damage] = {}


def _damage(phrase: str, in_file: bool = True) -> Callable[[Callable[[Path], Made]], None]:
    return register(DAMAGED_FILES, phrase, in_file)


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
    return written(folder, ""), settings()


@_damage("is empty (0 bytes)")
def _empty_mat(folder: Path) -> Made:
    return written(folder, "", "trial.mat"), settings()


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


@_damage("has the ending '.xls'")
def _old_excel_workbook(folder: Path) -> Made:
    return written(folder, b"\xd0\xcf\x11\xe0" + bytes(100), "trial.xls"), settings()


@_damage("is damaged and cannot be read (File is not a zip file)")
def _excel_workbook(folder: Path) -> Made:
    return written(folder, b"PK\x03\x04" + bytes(100), "trial.xlsx"), settings()


@_damage("a zip archive or an Excel workbook")
def _excel_workbook_called_csv(folder: Path) -> Made:
    return written(folder, b"PK\x03\x04" + bytes(100)), settings()


@_damage("is a MATLAB file")
def _mat_called_csv(folder: Path) -> Made:
    save_mat(folder / "trial.csv", pushed_seat())
    return folder / "trial.csv", settings()


@_damage("a Python pickle")
def _pickle_called_mat(folder: Path) -> Made:
    return written(folder, b"\x80\x04\x95" + bytes(600), "trial.mat"), settings()


# Delimited text -------------------------------------------------------------------------------


@_damage("is empty")
def _csv_of_blank_lines(folder: Path) -> Made:
    return written(folder, "\n \n\n"), settings()


@_damage("no rows of numbers")
def _csv_of_a_header_alone(folder: Path) -> Made:
    return written(folder, "time,seat,trunk,push\n"), settings()


@_damage("a zero byte in line 4")
def _zero_bytes_in_csv(folder: Path) -> Made:
    lines = csv_text(pushed_seat()).split("\n")
    lines[3] = "\0" * 20
    return written(folder, "\n".join(lines)), settings()


@_damage("ends in the middle of a row")
def _truncated_csv(folder: Path) -> Made:
    text = csv_text(pushed_seat())
    return written(folder, text[: text.rindex(",") - 3]), settings()


@_damage("is divided by bars")
def _wrong_delimiter(folder: Path) -> Made:
    return written(folder, csv_text(pushed_seat(), "|")), settings()


@_damage("is divided by commas")
def _tsv_with_commas(folder: Path) -> Made:
    return written(folder, csv_text(pushed_seat()), "trial.tsv"), settings()


@_damage("names 4 columns, and the rows below have 8 values")
def _decimal_commas_between_commas(folder: Path) -> Made:
    shifted = {name: values + 0.123456 for name, values in pushed_seat().items()}
    return written(folder, csv_text(shifted, ",", ",")), settings()


@_damage("column 'seat' has text in 2 of 600 rows, the first 'overload' in line 12")
def _text_in_a_column(folder: Path) -> Made:
    lines = csv_text(pushed_seat()).split("\n")
    for line in (11, 40):
        time, _, *rest = lines[line].split(",")
        lines[line] = ",".join([time, "overload", *rest])
    return written(folder, "\n".join(lines)), settings()


@_damage("is text, such as 'left' in line 2", in_file=False)
def _column_of_text(folder: Path) -> Made:
    header, *lines = csv_text(pushed_seat()).strip().split("\n")
    text = "\n".join([header + ",side", *(line + ",left" for line in lines)])
    return written(folder, text), settings(('"seat"', '"side"'))


@_damage("line 31 has 5 values where the first row has 4")
def _row_with_a_value_more(folder: Path) -> Made:
    lines = csv_text(pushed_seat()).split("\n")
    lines[30] += ",1.0"
    return written(folder, "\n".join(lines)), settings()


@_damage("signals.theta2.column may be time, seat, seat_2, push", in_file=False)
def _two_columns_of_one_name(folder: Path) -> Made:
    return written(folder, csv_text(pushed_seat()).replace("trunk", "seat", 1)), settings()


@_damage("names 3 columns")
def _header_too_short(folder: Path) -> Made:
    return written(folder, csv_text(pushed_seat()).replace(",push", "", 1)), settings()


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


@_damage("T is a MATLAB table")
def _table_object(folder: Path) -> Made:
    header = b"MATLAB 5.0 MAT-file".ljust(116) + bytes(8) + b"\0\1IM"
    return written(folder, header + opaque_variable(b"T", b"table"), "trial.mat"), settings()


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
    return written(folder, csv_text(pushed_seat()), "trial.mat"), settings()


# TDMS and C3D ---------------------------------------------------------------------------------


@_damage("ends in the middle of its data")
def _truncated_tdms(folder: Path) -> Made:
    return _cut(written_by_impc(folder, "trial.tdms"), 0.6), settings(OWN_RATE)


@_damage("does not begin as such a file")
def _text_called_tdms(folder: Path) -> Made:
    return written(folder, csv_text(pushed_seat()), "trial.tdms"), settings(OWN_RATE)


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
    return folder / "trial.tdms", settings(OWN_RATE)


@_damage("holds no column of numbers")
def _tdms_of_text(folder: Path) -> Made:
    with TdmsWriter(str(folder / "trial.tdms")) as writer:
        writer.write_segment([ChannelObject("g", "notes", ["a", "b"])])
    return folder / "trial.tdms", settings(OWN_RATE)


@_damage("says 100 samples per second and recording.rate 500", in_file=False)
def _rate_that_contradicts_the_file(folder: Path) -> Made:
    return written_by_impc(folder, "trial.tdms"), settings((OWN_RATE[0], "rate = 500.0"))


@_damage("of 600 frames")
def _truncated_c3d(folder: Path) -> Made:
    return _cut(written_by_impc(folder, "trial.c3d"), 0.6), settings(OWN_RATE)


@_damage("does not begin as such a file")
def _text_called_c3d(folder: Path) -> Made:
    return written(folder, csv_text(pushed_seat()), "trial.c3d"), settings(OWN_RATE)


@_damage("is damaged and cannot be read")
def _c3d_with_a_wrong_header(folder: Path) -> Made:
    path = written_by_impc(folder, "trial.c3d")
    content = bytearray(path.read_bytes())
    content[4] += 1  # number of analog measurements in a frame
    path.write_bytes(content)
    return path, settings(OWN_RATE)


@_damage("has no analog channels")
def _c3d_of_markers_alone(folder: Path) -> Made:
    writer = c3d.Writer(point_rate=100.0)
    writer.set_point_labels(["head"])
    writer.add_frames([(np.zeros((1, 5)), np.zeros((0, 0))) for _ in range(20)])
    with (folder / "trial.c3d").open("wb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # c3d warns of what is missing
        writer.write(file)
    return folder / "trial.c3d", settings(OWN_RATE)
