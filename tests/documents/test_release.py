"""What a release needs says the same version and licence everywhere."""

from __future__ import annotations

import re
import tomllib

from tests.documents.blocks import ROOT


def test_version_licence_and_changelog_agree() -> None:
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    said = dict(re.findall(r'^([a-z-]+): *"?([^"\n]+)"?$', citation, flags=re.M))
    assert said["version"] == project["version"]
    assert said["license"] == project["license"] == "BSD-3-Clause"
    assert "BSD 3-Clause" in (ROOT / "LICENSE").read_text(encoding="utf-8")
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.findall(r"^## \[(.+?)\]", changes, flags=re.M)[0] == project["version"]
