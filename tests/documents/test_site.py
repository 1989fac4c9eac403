"""The site builds from nothing: examples run, and a warning is an error, as in `make docs`."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.documents.blocks import ROOT


@pytest.mark.full
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    """About four minutes; a link within the site that leads nowhere is a warning too."""
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html",
               "-d", str(tmp_path / "doctrees"), "docs", str(tmp_path / "html")]  # fmt: skip
    done = subprocess.run(
        command, cwd=ROOT, env=os.environ | {"OPENBLAS_NUM_THREADS": "1"}, capture_output=True,
        text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-5000:]
    built = {path.relative_to(tmp_path / "html").as_posix() for path in tmp_path.rglob("*.html")}
    assert {"index.html", "start.html", "reproduction/index.html"} <= built
    assert {f"ref/{page}.html" for page in ("settings", "cli", "errors", "api")} <= built
    assert len([name for name in built if name.startswith("_examples/")]) > 5
