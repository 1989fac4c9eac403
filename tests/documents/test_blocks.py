"""Every block of the README and of the pages runs, in the order of its page; the site builds.

`python`: one namespace a page; a `text` block directly below is what it prints. `sh`: line by line;
a `text` block directly below is a part of what it prints. `toml`: read by the package. `json`:
parsed. `console` and `matlab` are shown only: they need a network, another system or a new
environment. A block whose first line is a comment with a file's name is saved under that name.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import msgspec
import numpy as np
import pytest

from impc.files.configuration import read_configuration
from impc.nonlinear.files import optimal_fit_settings
from impc.studies.cohort.study import StudyTable
from impc.studies.fit.settings import fit_settings, read_settings
from impc.studies.selection.settings import SelectSettings
from tests.documents.blocks import PAGES, ROOT, Block, blocks, command_lines
from tests.documents.shell import run_line, working_in

_SHOWN = {"text", "bibtex", "console", "matlab"}
# What a part lacks to be a configuration.
_SIGNAL = '\n[signals.any]\ncolumn = "any"\nunit = "1"\n'
# These two make an environment, and the tests run inside one.
_MAKE = {"make demo", "make test"}


@pytest.fixture(scope="session")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("simulated")


@pytest.mark.usefixtures("blank_figures")
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=[] if page == "README.md" else pytest.mark.full)
        for page in PAGES
        if blocks(page)
    ],
)
def test_the_blocks_run(page: str, kept: Path, tmp_path: Path) -> None:
    names: dict[str, object] = {"__name__": "page"}
    with working_in(tmp_path), np.printoptions():  # restored after the page
        for block in blocks(page):
            if block.file is not None:
                Path(block.file).write_text(block.text, encoding="utf-8")
            run_block(block, names, kept)


def run_block(block: Block, names: dict[str, object], kept: Path) -> None:
    """Run one block in the current folder."""
    where = f"{block.page}:{block.line}"
    if block.language == "python":
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile("\n" * (block.line - 1) + block.text, block.page, "exec"), names)
        assert block.output is None or printed.getvalue() == block.output, where
    elif block.language == "toml":
        require_valid(block.text, Path())
    elif block.language == "sh":
        run_shell(block, kept)
    elif block.language == "json":
        json.loads(block.text)
    else:
        assert block.language in _SHOWN, f"{where}: nothing runs {block.language!r}"


def require_valid(text: str, folder: Path) -> None:
    """Read a block as the commands do."""
    whole = "signals" in tomllib.loads(text)
    path = folder / "block.toml"
    path.write_text(text if whole else text + _SIGNAL, encoding="utf-8")
    found = read_configuration(path, "study", "model", "select")
    path.unlink()
    (optimal_fit_settings if "parameters" in found.fit else fit_settings)(found.fit)
    read_settings("select", SelectSettings, found.select)
    msgspec.convert(found.study, StudyTable)


def run_shell(block: Block, kept: Path) -> None:
    """Run the lines of a block; the `text` below it must be among what they print."""
    lines = [line for line in command_lines(block) if line not in _MAKE]
    printed = "".join(run_line(line, kept) for line in lines)
    found = iter([" ".join(line.split()) for line in printed.splitlines()])
    for shown in (block.output or "").splitlines():
        assert " ".join(shown.split()) in found, f"{block.page}:{block.line}: {shown}"


def test_no_block_is_overlooked_and_links_lead_somewhere() -> None:
    for page, path in PAGES.items():
        content = path.read_text(encoding="utf-8")
        fences = re.findall(r"^ *```(.*)$", content, flags=re.M)
        assert "~~~" not in content
        opened = [fence for fence in fences[::2] if not fence.startswith("{")]
        assert opened == [block.language for block in blocks(page)]
        links = re.findall(r"\]\(([^)#]+)[^)]*\)", content)
        local = [link for link in links if "://" not in link]
        assert [link for link in local if not (path.parent / link).exists()] == [], page


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
