"""Every block of the README and of the pages runs, in the order and the state of its page.

`python`: one namespace a page; a `text` block directly below is what it prints. `toml`: read by the
package. `sh`: line by line; a `text` block directly below is a part of what it prints. `json`:
parsed. `matlab` is not run: there is no MATLAB here. A block whose first line is a comment with a
file's name is saved under that name. What is run smaller or not at all is in `tables.py`.
"""

from __future__ import annotations

import contextlib
import io
import json
import re
from pathlib import Path

import pytest

from tests.documents.blocks import PAGES, Block, blocks, command_lines
from tests.documents.settings import require_valid
from tests.documents.shell import run_line, working_in
from tests.documents.tables import NOT_RUN, PREPARED, SMALLER

_SILENT = {"text", "bibtex", "matlab"}
_NUMBER = re.compile(r"[-+]?\d+(\.\d*)?(e[-+]?\d+)?")


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
    with working_in(tmp_path):
        for line in PREPARED.get(page, ()):
            run_line(line, kept)
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
        assert block.language in _SILENT, f"{where}: nothing runs {block.language!r}"


def run_shell(block: Block, kept: Path) -> None:
    """Run the lines of a block; compare with the `text` below it."""
    printed = ""
    for line in command_lines(block):
        if (block.page, line) in NOT_RUN:
            continue
        smaller = SMALLER.get((block.page, line))
        for run in (line,) if smaller is None else smaller.lines:
            printed += run_line(run, kept)
    changed = block.page in PREPARED or any(page == block.page for page, _ in SMALLER)
    found = iter([compared(line, not changed) for line in printed.splitlines()])
    for shown in (block.output or "").splitlines():
        assert compared(shown, not changed) in found, f"{block.page}:{block.line}: {shown}"


def compared(line: str, numbers: bool) -> str:
    """What two lines must have in common: the words, and the numbers of an unchanged page."""
    words = " ".join(line.split())
    return words if numbers else _NUMBER.sub("#", words)


def test_the_tables_have_no_stale_entries() -> None:
    lines = {
        (page, line)
        for page in PAGES
        for block in blocks(page)
        if block.language == "sh"
        for line in command_lines(block)
    }
    assert [entry for entry in (*NOT_RUN, *SMALLER) if entry not in lines] == []
    assert [page for page in PREPARED if page not in PAGES] == []
    assert set(NOT_RUN).isdisjoint(SMALLER)
    assert all(NOT_RUN.values())
    assert all(entry.reason for entry in SMALLER.values())


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
