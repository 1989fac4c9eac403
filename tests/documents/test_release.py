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


def test_the_demo_installs_what_the_project_needs_in_the_versions_of_the_whole_lock() -> None:
    small, whole = (
        set(re.findall(r"^([\w.-]+==\S+)", (ROOT / name).read_text(encoding="utf-8"), flags=re.M))
        for name in ("requirements-demo.lock", "requirements.lock")
    )
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    needed = {re.split(r"[<>=]", one)[0] for one in project["dependencies"]} | {"setuptools"}
    assert small < whole
    assert needed <= {one.split("==")[0] for one in small}
