"""Mark tests that need the cursor recordings, which are not in the repository."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import pytest

from experiments.cursor_data import data_file

Test = TypeVar("Test", bound=Callable[..., object])


def recorded(test: Test) -> Test:
    """Skip a test, or a class of tests, if the recordings are absent."""
    name = data_file().name
    absent = pytest.mark.skipif(
        not data_file().exists(), reason=f"{name} is not there (IMPC_CURSOR_DATA)"
    )
    marked: Test = pytest.mark.recordings(absent(test))
    return marked
