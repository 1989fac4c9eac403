"""Malicious files: names, links, and attempts to exhaust memory or time or to crash the process."""

from __future__ import annotations

import os
import tracemalloc
from pathlib import Path

import h5py
import numpy as np
import pytest

from impc.errors import DataError
from impc.files import apart
from impc.files.configuration import read_configuration
from impc.files.draft import draft, summary
from impc.files.formats import read_table, write_table
from impc.files.table import make_table
from tests.files.hostile_files import HOSTILE
from tests.files.samples import hdf5_mat


@pytest.mark.parametrize("name", HOSTILE)
def test_one_line_and_little_memory(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # If the memory were used up, that would be reported instead of the expected reason.
    monkeypatch.setattr(apart, "_ROOM", 250_000_000)
    phrase, make = HOSTILE[name]
    path = make(tmp_path)
    tracemalloc.start()
    try:
        with pytest.raises(DataError) as caught:
            read_table(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    message = str(caught.value)
    assert phrase in message
    assert "\n" not in message
    assert len(message) - len(str(path)) < 300
    # Memory of the parent process; the largest file has 8 MB.
    assert peak < 200_000_000


@pytest.mark.parametrize("ending", [".csv", ".xlsx", ".ods", ".mat", ".tdms", ".c3d"])
def test_a_sparse_file_of_two_gigabytes_is_refused_unread(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"trial{ending}"
    with path.open("wb") as file:
        file.truncate(2_000_000_000)
    tracemalloc.start()
    try:
        with pytest.raises(DataError, match=r"has 2\.0 GB"):
            read_table(path)
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()


def test_a_limit_of_ones_own_a_pipe_and_a_name_that_no_file_can_have(tmp_path: Path) -> None:
    write_table(tmp_path / "trial.csv", make_table("trial", {"x": np.arange(100.0)}))
    assert read_table(tmp_path / "trial.csv").samples == 100
    with pytest.raises(DataError, match=r"; at most .* are read"):
        read_table(tmp_path / "trial.csv", largest=100)
    os.mkfifo(tmp_path / "pipe.csv")
    with pytest.raises(DataError, match="is not a regular file"):
        read_table(tmp_path / "pipe.csv")
    with pytest.raises(DataError, match="cannot be opened"):
        read_table(tmp_path / ("x" * 300 + ".csv"))


def test_names_of_columns_cannot_write_toml(tmp_path: Path) -> None:
    name = 'x"\n[plant]\nevil = 1\n#\x7f\x1b[2J'
    table = make_table("trial", {name: np.arange(9.0), "y": np.arange(9.0) ** 2}, {"y": 'm"\nz=1'})
    assert "\x1b" not in summary(table)
    path = tmp_path / "subject.toml"
    path.write_text(draft(table).toml(), encoding="utf-8")
    configuration = read_configuration(path)
    assert configuration.plant == {}
    assert list(configuration.signals) == ["y"]


def test_a_million_references_are_not_followed(tmp_path: Path) -> None:
    """A cell of 8 MB whose 1e6 entries are the same dataset: 8 GB if they were read."""
    path = tmp_path / "trial.mat"
    hdf5_mat(path, {"big": np.arange(1000.0)})
    with h5py.File(path, "r+") as file:
        entries = np.full((1, 1_000_000), file["big"].ref, dtype=h5py.ref_dtype)
        file.create_dataset("cells", data=entries).attrs["MATLAB_class"] = np.bytes_("cell")
    table = read_table(path)  # in a process that may take 1 GB
    assert list(table.columns) == ["big"]
    assert "is a cell array" in table.skipped["cells"]
