"""What docs/contributing.md shows whole keeps the rules that a contribution is held to."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

from tests.documents.blocks import ROOT, blocks
from tests.documents.test_docstrings import faults

FILES = {
    block.file: block.text
    for block in blocks("docs/contributing.md")
    if block.file and block.file.endswith(".py") and "from __future__" in block.text
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    return tmp_path


def test_there_is_one_of_each_kind() -> None:
    assert set(FILES) == {"pendulum.py", "json_columns.py", "equal_costs.py", "effort.py"}


@pytest.mark.parametrize("name", FILES)
def test_its_docstrings_say_it_all(
    name: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(folder))
    module = importlib.import_module(name.removesuffix(".py"))
    monkeypatch.delitem(sys.modules, module.__name__, raising=False)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    plumbing = name == "json_columns.py"  # a room that needs no source
    for public, thing in vars(module).items():
        if public.startswith("_") or getattr(thing, "__module__", "") != module.__name__:
            continue
        found = faults(f"{module.__name__}:{public}", thing)
        assert [fault for fault in found if not (plumbing and fault == "no source")] == []


@pytest.mark.full
@pytest.mark.parametrize("tool", ["mypy --strict", "ruff check", "ruff format --check"])
def test_its_checks_pass(tool: str, folder: Path) -> None:
    """As `make check` does, with the settings of the repository."""
    files = [str(folder / name) for name in FILES]
    settings = "--config-file" if tool.startswith("mypy") else "--config"
    command = [sys.executable, "-m", *tool.split(), settings, str(ROOT / "pyproject.toml"), *files]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
