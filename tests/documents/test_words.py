"""The README, the pages and the package keep to the vocabulary and to short sentences."""

from __future__ import annotations

import re

from tests.documents.blocks import PAGES, ROOT

_PRIVATE = re.compile(
    r"\b(told|tells|untold|wandering|judged|stands at|but for what|all but none)\b"
)
_LONGEST = 40  # words


def test_no_private_words() -> None:
    code = [path for folder in ("impc", "plants") for path in (ROOT / folder).rglob("*.py")]
    texts = {path.name: path.read_text(encoding="utf-8") for path in (*PAGES.values(), *code)}
    assert {name: found for name, text in texts.items() if (found := _PRIVATE.findall(text))} == {}


def test_no_sentence_is_too_long() -> None:
    for page, path in PAGES.items():
        text = re.sub(r"^ *```.*?^ *```$", "\n", path.read_text("utf-8"), flags=re.M | re.S)
        text = re.sub(r"^(\|| {4}|#).*$", "", text, flags=re.M)  # tables, formulas, headings
        text = re.sub(r"^ *([-*]|\d+\.) ", "\n\n", text, flags=re.M)
        text = re.sub(r"\]\([^)]*\)", "]", text)  # targets of links
        sentences = re.split(r"(?<=[.!?:;])\**\)?\s|\n\s*\n", text)
        assert [one for one in sentences if len(one.split()) > _LONGEST] == [], page
