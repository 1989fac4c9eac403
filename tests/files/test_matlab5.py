"""Files of MATLAB's versions 5 to 7: the same as scipy reads, where both do."""

from __future__ import annotations

import importlib.util
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import scipy.io

from impc.files.matlab5 import Cells, Other, Text, read_variables
from tests.files.samples import mat5_array, mat5_element, mat5_file, save_mat

if TYPE_CHECKING:
    from collections.abc import Iterator

LARGEST = 10**8
# Files that MATLAB did not write so, made to be refused or to be told apart.
ODD = {
    "bad_miuint32.mat",
    "bad_miutf8_array_name.mat",
    "corrupted_zlib_checksum.mat",
    "corrupted_zlib_data.mat",
    "malformed1.mat",
    "nasty_duplicate_fieldnames.mat",
    "test_empty_struct.mat",  # scipy: an array with None; here a struct without fields
}


def files_of_scipy() -> Iterator[Path]:
    """Those that MATLAB 5 to 7 wrote, from the tests of scipy."""
    spec = importlib.util.find_spec("scipy.io.matlab")
    assert spec is not None
    assert spec.origin is not None
    for path in sorted((Path(spec.origin).parent / "tests" / "data").glob("*.mat")):
        head = path.read_bytes()[:128]
        if path.name not in ODD and head.startswith(b"MATLAB 5"):
            yield path


def require_same(ours: Any, theirs: Any) -> None:
    if isinstance(ours, dict):
        assert set(ours) == set(theirs.dtype.names)
        for name, value in ours.items():
            require_same(value, theirs.flat[0][name])
    elif isinstance(ours, Cells):
        assert len(ours.values) == theirs.size
        for value, other in zip(ours.values, theirs.ravel(order="F"), strict=True):
            require_same(value, other)
    elif isinstance(ours, Text):
        written = [str(row).rstrip() for row in theirs.ravel()]
        assert list(ours.rows) == written or not any((*ours.rows, *written))
    elif isinstance(ours, Other):
        if ours.kind == "complex":
            assert np.iscomplexobj(theirs)
        else:  # sparse, a function, an object, an array of structs
            assert not (isinstance(theirs, np.ndarray) and theirs.dtype.kind in "fiubU")
    else:
        assert ours.shape == theirs.shape
        np.testing.assert_array_equal(ours, theirs)


def require_same_file(path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        theirs = {k: v for k, v in scipy.io.loadmat(path).items() if not k.startswith("__")}
    ours = read_variables(path, LARGEST)
    assert set(ours) == set(theirs)
    for name, value in ours.items():
        require_same(value, theirs[name])


def test_files_that_matlab_wrote() -> None:
    paths = list(files_of_scipy())
    if not paths:
        pytest.skip("this scipy came without its tests")
    assert len(paths) > 60
    for path in paths:
        require_same_file(path)


@pytest.mark.parametrize("packed", [False, True])
def test_numbers_of_every_type_and_shape(tmp_path: Path, packed: bool) -> None:
    rng = np.random.default_rng(3)
    kinds = ("f8", "f4", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "?")
    shapes = ((1, 1), (0, 3), (1, 7), (5, 2), (2, 3, 4))
    values = {
        f"x{i}_{j}": (100 * rng.random(shape)).astype(kind)
        for i, kind in enumerate(kinds)
        for j, shape in enumerate(shapes)
    }
    cells = np.empty((2, 2), dtype=object)
    cells[:] = [["a", np.eye(2)], ["größer", 5.0]]
    inside = {"s": {"deep": {"er": np.arange(4.0)}, "text": "θ"}, "cells": cells}
    save_mat(tmp_path / "x.mat", {**values, **inside}, do_compression=packed)
    require_same_file(tmp_path / "x.mat")


def test_the_other_byte_order(tmp_path: Path) -> None:
    def element(kind: int, content: bytes) -> bytes:
        size = len(content).to_bytes(4, "big")
        return kind.to_bytes(4, "big") + size + content + bytes(-len(content) % 8)

    numbers = np.arange(6.0)
    inside = (
        element(6, np.array([6, 0], ">u4").tobytes())
        + element(5, np.array([2, 3], ">i4").tobytes())
        + (1 << 16 | 1).to_bytes(4, "big") + b"x\0\0\0"
        + element(9, numbers.astype(">f8").tobytes())
    )  # fmt: skip
    head = b"MATLAB 5.0 MAT-file".ljust(116) + bytes(8) + b"\1\0MI"
    (tmp_path / "x.mat").write_bytes(head + element(14, inside))
    found = read_variables(tmp_path / "x.mat", LARGEST)["x"]
    np.testing.assert_array_equal(found, numbers.reshape(2, 3, order="F"))
    require_same_file(tmp_path / "x.mat")


@pytest.mark.parametrize("kind", [*range(-1, 20), 200, 2**31])
def test_each_type_of_element_is_read_or_refused(tmp_path: Path, kind: int) -> None:
    # Where numbers stand; scipy's process ends for some of those that do not exist.
    content = mat5_array(6, (1, 1), "x", mat5_element(kind % 2**32, bytes(8)))
    (tmp_path / "x.mat").write_bytes(mat5_file(content))
    if kind in (9, 12, 13):  # eight bytes are one number
        assert read_variables(tmp_path / "x.mat", LARGEST)["x"] == 0
    else:
        with pytest.raises(ValueError, match=r"numbers|type"):
            read_variables(tmp_path / "x.mat", LARGEST)
