"""The README keeps its word: its table is that of the example."""

from __future__ import annotations

import pytest

from impc.studies.example.cases import CaseResult
from impc.studies.example.report import methods_finding
from tests.documents.blocks import PAGES, blocks

README = PAGES["README.md"].read_text(encoding="utf-8")


def close(shown: str, found: str) -> bool:
    """Whether two cells agree; numbers to a few digits, because solvers differ in the last ones."""
    try:
        numbers = [float(text.replace("\u2212", "-")) for text in (shown, found)]
        return numbers[1] == pytest.approx(numbers[0], rel=2e-2, abs=2e-3)
    except ValueError:
        return shown == found


def test_the_table_is_what_comes_out(case_a: CaseResult) -> None:
    texts = (block.text for block in blocks("README.md") if block.language == "text")
    shown = next(text for text in texts if "Limit kept" in text)
    found = methods_finding(case_a).text()
    shown_rows, found_rows = shown.splitlines(), found.splitlines()
    assert len(shown_rows) == len(found_rows)
    assert shown_rows[0].split() == found_rows[0].split()
    for shown_row, found_row in zip(shown_rows[1:], found_rows[1:], strict=True):
        cells = list(zip(shown_row.split(), found_row.split(), strict=True))
        assert all(close(*pair) for pair in cells), cells
