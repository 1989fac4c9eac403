"""Results are read by their schema, and rejected in one line if it differs."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from impc.errors import DataError
from impc.files.results import SCHEMA, read_result
from impc.levels import Level
from impc.reporting.document import Report
from impc.reporting.verdict import Verdict

HEAD = {"schema": SCHEMA, "command": "", "made": "", "versions": {}, "files": [], "sha256": None}


def test_what_a_report_writes_is_read(tmp_path: Path) -> None:
    data = {"methods": {"inverse_mpc": {"K": [[1.0, 2.0]], "seconds": 2.0}}, "more": [1]}
    files = Report("w", "t", Verdict(Level.NOTE, "", ""), (), data=data).files()
    (tmp_path / "result.json").write_bytes(files["result.json"])
    found = read_result(tmp_path)
    assert found.methods["inverse_mpc"].K == [[1.0, 2.0]]
    assert found.methods["inverse_mpc"].Q is None
    assert found.content["more"] == [1]
    assert found.schema == SCHEMA
    assert found.versions["numpy"] == found.content["versions"]["numpy"]
    assert read_result(tmp_path / "result.json") == found


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{}", "another version of impc (schema 1, not 10)"),
        (json.dumps({"K": [[1.0]], "versions": {}, "made": ""}), "schema 1, not 10"),
        (json.dumps(HEAD | {"schema": 99}), "schema 99, not 10"),
        (json.dumps(HEAD | {"versions": 3}), "is not a result file"),
        (json.dumps({"schema": SCHEMA}), "is not a result file"),
        (json.dumps(HEAD | {"methods": {"a": {"seconds": "x"}}}), "$.methods[...].seconds"),
        ("", "is not a result file"),
        ("[]", "is not a result file"),
        ("null", "is not a result file"),
        ('{"schema"', "is not a result file"),
        ("[" * 100_000, "is not a result file"),
        ('{"a":' * 100_000, "is not a result file"),
    ],
)
def test_what_is_not_a_result(content: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "result.json").write_text(content)
    with pytest.raises(DataError) as refused:
        read_result(tmp_path)
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


def test_what_is_no_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="is not a result file"):
        read_result(tmp_path)
    os.mkfifo(tmp_path / "result.json")
    with pytest.raises(DataError, match="not a regular file"):
        read_result(tmp_path)
