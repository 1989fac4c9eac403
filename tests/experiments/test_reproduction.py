"""The reproduction page is complete, its names exist, and quick entries still come out so."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest

from experiments.reproduction.entry import Chapter, Entry, Verdict
from experiments.reproduction.example import controller_entries
from experiments.reproduction.page import figure_name, page

pytestmark = pytest.mark.full

FOLDER = Path(__file__).parents[2] / "docs" / "reproduction"
PAGE = (FOLDER / "index.md").read_text(encoding="utf-8")
ROWS = [
    [cell.replace("\\|", "|").strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
    for line in PAGE.splitlines()
    if line.startswith("| ") and not line.startswith("| |")
]
EQUATIONS = {"2": 1, "3": 26, "4": 5, "5": 7, "A": 6, "B": 1, "C": 5}
TABLES = {"2": 6, "3": 2, "4": 3, "5": 5, "C": 1}
FIGURES = {"2": 6, "3": 7, "4": 5, "5": 3}


def expanded(item: str) -> set[str]:
    """Every label of an item: "(C.1) to (C.3)" is three."""
    found = re.fullmatch(r"\((\w)\.(\d+)\) to \(\w\.(\d+)\)", item)
    if found:
        chapter, first, last = found.groups()
        return {f"({chapter}.{number})" for number in range(int(first), int(last) + 1)}
    return set(item.split(", "))


def test_every_equation_table_and_figure_has_a_line() -> None:
    labels = set().union(*(expanded(row[0]) for row in ROWS))
    wanted = {
        form.format(chapter, number)
        for form, counts in (
            ("({}.{})", EQUATIONS),
            ("Table {}.{}", TABLES),
            ("Figure {}.{}", FIGURES),
        )
        for chapter, count in counts.items()
        for number in range(1, count + 1)
    }
    assert wanted - labels == set()


def test_every_line_has_a_verdict_and_says_why_where_it_must() -> None:
    for item, _, _, verdict in ROWS:
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
    shown = {row[0] + row[1]: row[3] for row in ROWS}
    for entry in controller_entries():
        says = shown[entry.item + entry.says]
        assert says.startswith(f"**{entry.verdict.value}**"), entry


@pytest.mark.parametrize("text", ["a | b", "plain"])
def test_a_row_keeps_its_cells(text: str) -> None:
    entry = Entry("(1.1)", text, ("impc",), text, Verdict.NOT, text, "one/two.png")
    row = next(
        line
        for line in page([Chapter("T", "In its place.", (entry,))]).splitlines()
        if "(1.1)" in line
    )
    assert len(re.split(r"(?<!\\)\|", row)) == 6
    assert figure_name(entry) == "one-two.png"
