"""Vocabulary and sentences of the pages, version and licence, and labels of axes."""

from __future__ import annotations

import re
import tomllib

import pytest

from impc.reporting.style import new_figure
from tests.documents.blocks import PAGES, ROOT
from tests.labelled_axes import require_labels

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


def test_version_licence_and_changelog_agree() -> None:
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    said = dict(re.findall(r'^([a-z-]+): *"?([^"\n]+)"?$', citation, flags=re.M))
    assert said["version"] == project["version"]
    assert said["license"] == project["license"] == "BSD-3-Clause"
    assert "BSD 3-Clause" in (ROOT / "LICENSE").read_text(encoding="utf-8")
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.findall(r"^## \[(.+?)\]", changes, flags=re.M)[0] == project["version"]


def test_the_demo_installs_what_the_project_needs_in_the_versions_of_the_whole_lock() -> None:
    small, whole = (
        set(re.findall(r"^([\w.-]+==\S+)", (ROOT / name).read_text(encoding="utf-8"), flags=re.M))
        for name in ("requirements-demo.lock", "requirements.lock")
    )
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    needed = {re.split(r"[<>=]", one)[0] for one in project["dependencies"]} | {"setuptools"}
    assert small < whole
    assert needed <= {one.split("==")[0] for one in small}


def test_units_are_asked_for_and_names_need_none() -> None:
    figure = new_figure(3.0, 2.0)
    ax = figure.subplots()
    ax.plot([0, 1], [0, 1])
    with pytest.raises(AssertionError, match="no label"):
        require_labels(figure)
    ax.set_xlabel("time (s)")
    ax.set_ylabel("angle")
    with pytest.raises(AssertionError, match="'angle' does not end in a unit"):
        require_labels(figure)
    ax.set_ylabel("angle (deg)")
    require_labels(figure)
    ax.set_xlabel("")
    ax.set_xticks([0, 1], ["first", "second"])
    require_labels(figure)
