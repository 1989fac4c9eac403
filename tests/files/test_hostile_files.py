"""Small files that would take gigabytes, or end the process, end in one line before they do."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import pytest

from impc.errors import DataError
from impc.files import apart
from impc.files.formats import read_table
from tests.files.hostile_files import HOSTILE


@pytest.mark.parametrize("name", HOSTILE)
def test_one_line_and_little_memory(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A reader that took the memory would be told so, and not the reason that its header gives.
    monkeypatch.setattr(apart, "_ROOM", 250_000_000)
    path = HOSTILE[name].make(tmp_path)
    tracemalloc.start()
    try:
        with pytest.raises(DataError) as caught:
            read_table(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    message = str(caught.value)
    assert HOSTILE[name].phrase in message
    assert "\n" not in message
    assert len(message) - len(str(path)) < 300
    # Of the process that asks; the largest of the files is 8 MB.
    assert peak < 200_000_000
