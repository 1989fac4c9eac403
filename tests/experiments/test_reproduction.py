"""The reproduction page is complete, its names exist, and quick entries have its verdicts."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest

from experiments.reproduction.entry import Verdict
from experiments.reproduction.example import controller_entries

pytestmark = pytest.mark.full

FOLDER = Path(__file__).parents[2] / "docs" / "reproduction"
PAGE = (FOLDER / "index.md").read_text(encoding="utf-8")
ROWS = [
    [cell.replace("\\|", "|").strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
    for line in PAGE.splitlines()
    if line.startswith("| **")
]
TABLES = {"2": 6, "3": 2, "4": 3, "5": 5, "C": 1}


def test_every_line_has_a_verdict_and_says_why_where_it_must() -> None:
    for verdict, item, _, _ in ROWS:
        word, _, why = verdict.removeprefix("**").partition("**.")
        assert word in {known.value for known in Verdict}, item
        assert word == "reproduced" or why.strip(), f"{item}: {word}, but not why"


def test_every_name_on_the_page_exists() -> None:
    names = set(re.findall(r"`((?:impc|plants|experiments)[\w.]*(?::\w+)?)`", PAGE))
    assert len(names) > 50
    for name in names:
        module, _, attribute = name.partition(":")
        found = importlib.import_module(module)
        assert not attribute or hasattr(found, attribute), name


def test_every_figure_is_there() -> None:
    pictures = re.findall(r"```\{figure\} (\S+)", PAGE)
    assert len(pictures) > 8
    assert [name for name in pictures if not (FOLDER / name).exists()] == []


def test_quick_entries_come_out_as_the_page_says() -> None:
    shown = {row[1] + row[2]: row[0] for row in ROWS}
    for entry in controller_entries():
        says = shown[entry.item + entry.says]
        assert says.startswith(f"**{entry.verdict.value}**"), entry
