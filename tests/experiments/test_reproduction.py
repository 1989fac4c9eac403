"""The reproduction page has all claims, its names exist, and quick values have its verdicts."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import numpy as np
import pytest

from experiments.reproduction.balance import exact_values
from experiments.reproduction.example import controller_values
from experiments.reproduction.page import CLAIMS, FIGURES, VERDICTS, claims_page

FOLDER = Path(__file__).parents[2] / "docs" / "reproduction"
PAGE = (FOLDER / "index.md").read_text(encoding="utf-8")
TEMPLATE = CLAIMS.read_text(encoding="utf-8")


def rows(text: str, start: str = "| **") -> list[list[str]]:
    return [
        re.split(r" (?<!\\)\| ", line.strip("| "))
        for line in text.splitlines()
        if line.startswith(start)
    ]


def test_every_line_has_a_verdict_and_says_why_where_it_must() -> None:
    for verdict, item, _, _ in rows(PAGE):
        word, _, why = verdict.removeprefix("**").partition("**.")
        assert word in VERDICTS, item
        assert word == "reproduced" or why.strip(), f"{item}: {word}, but not why"


def test_the_page_has_every_statement_of_the_claims() -> None:
    claims = [row for row in rows(TEMPLATE, "| ") if row[0] not in ("verdict", "---|---|---|---")]
    says = [row[2].replace("{{", "{").replace("}}", "}") for row in claims]
    assert says == [row[2] for row in rows(PAGE)]
    assert len(says) > 100


def test_every_name_on_the_page_exists() -> None:
    names = set(re.findall(r"`((?:impc|plants|experiments)[\w.]*(?::\w+)?)`", PAGE + TEMPLATE))
    assert len(names) > 50
    for name in names:
        module, _, attribute = name.partition(":")
        found = importlib.import_module(module)
        assert not attribute or hasattr(found, attribute), name


def test_every_figure_is_there() -> None:
    pictures = re.findall(r"```\{figure\} (\S+)", PAGE)
    assert len(pictures) == len(FIGURES)
    assert [name for name in pictures if not (FOLDER / name).exists()] == []


@pytest.mark.full
def test_quick_values_have_the_verdicts_of_the_page() -> None:
    values = controller_values() | exact_values()
    shown = {row[1] + row[2]: row[0] for row in rows(PAGE)}
    checked = 0
    for row in rows(TEMPLATE, "| {"):
        name, _, verdict = row[0].removeprefix("{").partition("}")[0].partition(":")
        if name in values:
            said = verdict if values[name] else "not reproduced"
            assert shown[row[1] + row[2]].startswith(f"**{said}**"), row[1]
            checked += 1
    assert checked == 9


class Anything:
    """Value that a claim can show in any format, with any part."""

    def __getitem__(self, _: object) -> Anything:
        return self

    def __format__(self, _: str) -> str:
        return "1.5"


def test_a_statement_that_does_not_hold_is_not_reproduced() -> None:
    """One value decides the verdict, the count and the text of a figure."""
    anything = dict.fromkeys(re.findall(r"\{(\w+)", TEMPLATE), Anything())
    verdicts = dict.fromkeys(re.findall(r"\{(\w+):[a-z ]*reproduced", TEMPLATE), True)
    text = {}
    for holds in (True, False):
        text[holds] = claims_page(anything | verdicts | {"fit_is_close": np.bool_(holds)})
    counts = {holds: text[holds].count("| **reproduced in kind**") for holds in text}
    assert counts[True] == counts[False] + 1
    assert f"{counts[False]} reproduced in kind" in text[False]
    assert "VAF 1.5 and 1.5 %. **not reproduced**." in text[False]
    assert "VAF 1.5 and 1.5 %. **reproduced in kind**." in text[True]
