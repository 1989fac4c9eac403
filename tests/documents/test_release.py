"""What a release needs is there, and says the same version everywhere."""

from __future__ import annotations

import re
import tomllib

from tests.documents.blocks import ROOT

CITATION = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def field(name: str) -> str | None:
    found = re.search(rf"^{name}: *\"?([^\"\n]+)\"?$", CITATION, flags=re.M)
    return None if found is None else found[1].strip()


def test_the_citation_has_what_its_format_requires() -> None:
    assert field("cff-version") == "1.2.0"
    assert field("message")
    assert field("title")
    assert field("type") in ("software", "dataset")
    assert re.search(r"^authors:\n  - (name|family-names): \S", CITATION, flags=re.M)
    keys = set(re.findall(r"^([a-z-]+):", CITATION, flags=re.M))
    assert keys <= {
        "abstract", "authors", "cff-version", "commit", "contact", "date-released", "doi",
        "identifiers", "keywords", "license", "license-url", "message", "preferred-citation",
        "references", "repository", "repository-artifact", "repository-code", "title", "type",
        "url", "version",
    }  # fmt: skip
    date = field("date-released")
    assert date is None or re.fullmatch(r"\d{4}-\d{2}-\d{2}", date)


def test_version_and_licence_agree() -> None:
    assert field("version") == PROJECT["version"]
    assert field("license") == PROJECT["license"] == "BSD-3-Clause"
    assert "BSD 3-Clause" in (ROOT / "LICENSE").read_text(encoding="utf-8")


def test_the_changelog_has_a_place_for_what_comes() -> None:
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    headings = re.findall(r"^## \[(.+?)\]", changes, flags=re.M)
    assert headings[0] == "Unreleased"
    tagged = [name for name in headings[1:] if not re.fullmatch(r"\d+\.\d+\.\d+", name)]
    assert tagged == []
