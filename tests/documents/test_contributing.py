"""What docs/contributing.md shows whole passes the checks that a contribution is held to."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.documents.blocks import ROOT, blocks

FILES = {
    block.file: block.text
    for block in blocks("docs/contributing.md")
    if block.file and block.file.endswith(".py") and "from __future__" in block.text
}


@pytest.mark.full
@pytest.mark.parametrize("tool", ["mypy --strict", "ruff check", "ruff format --check"])
def test_its_checks_pass(tool: str, tmp_path: Path) -> None:
    """As `make check` does, with the settings of the repository."""
    assert set(FILES) == {"pendulum.py", "json_columns.py", "equal_costs.py", "effort.py"}
    for name, text in FILES.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    files = [str(tmp_path / name) for name in FILES]
    settings = "--config-file" if tool.startswith("mypy") else "--config"
    command = [sys.executable, "-m", *tool.split(), settings, str(ROOT / "pyproject.toml"), *files]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
