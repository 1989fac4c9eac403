"""Tests that need the recordings of cursors, which are not in the repository."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import pytest

from experiments.cursor_data import data_file

Test = TypeVar("Test", bound=Callable[..., object])


def recorded(test: Test) -> Test:
    """A test, or a class of them, that is left out where the recordings are not there."""
    name = data_file().name
    absent = pytest.mark.skipif(
        not data_file().exists(), reason=f"{name} is not there (IMPC_CURSOR_DATA)"
    )
    marked: Test = pytest.mark.recordings(absent(test))
    return marked
