"""MATLAB files of versions 5 to 7: valid ones are read, damaged ones do not crash the process."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
import scipy.sparse

from impc.errors import InputError
from impc.files.apart import matrices_apart
from impc.files.formats import read_table
from tests.files.samples import pushed_seat, save_mat

if TYPE_CHECKING:
    pass

LARGEST = 10**8


@pytest.mark.parametrize("packed", [False, True])
def test_matrices_of_every_type_and_shape(tmp_path: Path, packed: bool) -> None:
    rng = np.random.default_rng(3)
    kinds = ("f8", "f4", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "?")
    shapes = ((1, 1), (0, 3), (1, 7), (5, 2), (2, 3, 4))
    values = {
        f"x{i}_{j}": (100 * rng.random(shape)).astype(kind)
        for i, kind in enumerate(kinds)
        for j, shape in enumerate(shapes)
    }
    cells = np.array(["a", "größer", 5.0], dtype=object)
    texts = {"cells": cells, "text": "θ", "rows": np.array(["ab", "c"]), "none": ""}
    save_mat(tmp_path / "x.mat", {**values, **texts}, do_compression=packed)
    found = matrices_apart(tmp_path / "x.mat", LARGEST)
    assert found.pop("cells") == ["a", "größer", None]
    assert found.pop("text") == ["θ"]
    assert found.pop("rows") == ["ab", "c"]
    assert not any(found.pop("none"))
    assert set(found) == set(values)
    for name, value in values.items():
        assert found[name].shape == value.shape
        assert found[name].dtype == np.float64
        np.testing.assert_array_equal(found[name], value)


@pytest.mark.parametrize(
    ("value", "says"),
    [
        (np.eye(2) + 1j, "has a complex matrix x"),
        ({"y": 1.0}, "x is a struct"),
        (scipy.sparse.csc_array(np.eye(2)), "x is sparse"),
        ("a" * 1_000_001, "a text of more than 1000000 characters"),
    ],
)
def test_what_is_no_matrix_of_a_plant(tmp_path: Path, value: object, says: str) -> None:
    save_mat(tmp_path / "x.mat", {"x": value})
    with pytest.raises(InputError, match=says) as caught:
        matrices_apart(tmp_path / "x.mat", 2_500_000)
    assert caught.value.subject == f"plant {tmp_path / 'x.mat'}"


def test_the_other_byte_order(tmp_path: Path) -> None:
    def element(kind: int, content: bytes) -> bytes:
        size = len(content).to_bytes(4, "big")
        return kind.to_bytes(4, "big") + size + content + bytes(-len(content) % 8)

    numbers = np.arange(6.0)
    inside = (
        element(6, np.array([6, 0], ">u4").tobytes())
        + element(5, np.array([6, 1], ">i4").tobytes())
        + (1 << 16 | 1).to_bytes(4, "big") + b"x\0\0\0"
        + element(9, numbers.astype(">f8").tobytes())
    )  # fmt: skip
    head = b"MATLAB 5.0 MAT-file".ljust(116) + bytes(8) + b"\1\0MI"
    (tmp_path / "x.mat").write_bytes(head + element(14, inside))
    np.testing.assert_array_equal(read_table(tmp_path / "x.mat").columns["x"], numbers)


def test_the_process_that_asks_does_not_load_the_library(tmp_path: Path) -> None:
    save_mat(tmp_path / "x.mat", pushed_seat(20))
    text = (
        "import sys; from pathlib import Path; from impc.files.formats import read_table\n"
        f"print(read_table(Path({str(tmp_path / 'x.mat')!r})).samples, 'scipy.io' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    assert done.stdout == "20 False\n"
