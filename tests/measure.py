"""Sizes of the code, tests and pages: `make measure`.

Lines include docstrings and blank lines. Presentation code is identified by file names.
"""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from types import FrameType
from typing import Any

from docs.layers import ROOT, circles, imports, longest_chain, subpackage
from tests.documents.blocks import PAGES, blocks

_SHOWN = re.compile(
    r"reporting/|/\w*(report|page|figures|tables?|sentences|words|schema|verdict|findings?|charts|"
    r"sheet|identified|truth|asked)\.py$|\.(html|css|js)$"
)
_OF_DOCUMENTS = re.compile(r"tests/documents/|tests/test_public")


def _lines(paths: list[Path]) -> int:
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)


def _files(folder: str, *endings: str) -> list[Path]:
    found = (ROOT / folder).rglob("*")
    return sorted(path for path in found if path.suffix in endings and "_build" not in path.parts)


def _docstrings(paths: list[Path]) -> int:
    count = 0
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
            if isinstance(node, documented) and ast.get_docstring(node) is not None:
                first = node.body[0]
                count += (first.end_lineno or first.lineno) - first.lineno + 1
    return count


def _share_of_documents() -> tuple[int, float]:
    command = [sys.executable, "-m", "pytest", "--collect-only", "-p", "no:cacheprovider"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    ids = [line for line in listed.splitlines() if "::" in line]
    return len(ids), sum(bool(_OF_DOCUMENTS.match(line)) for line in ids) / len(ids)


def _followed() -> tuple[int, int, int]:
    """Files and functions that the README's Python example enters, and the depth of its calls."""
    (example,) = [one.text for one in blocks("README.md") if "impc.fit(" in one.text]
    package, entered = str(ROOT / "impc"), set[tuple[str, str]]()
    depth = deepest = 0

    def follow(frame: FrameType, event: str, _argument: Any) -> None:
        nonlocal depth, deepest
        code = frame.f_code
        if code.co_filename.startswith(package) and event in ("call", "return"):
            depth += 1 if event == "call" else -1
            deepest = max(deepest, depth)
            if event == "call" and not code.co_name.startswith("<"):
                entered.add((code.co_filename, code.co_qualname))

    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        exec(example, {"__name__": "page"})  # compiles what is not in the cache
        sys.setprofile(follow)
        exec(example, {"__name__": "page"})
        sys.setprofile(None)
        os.chdir(ROOT)
    return len({name for name, _ in entered}), len(entered), deepest


def main() -> None:
    """Print the table."""
    ours, run = _files("impc", ".py"), imports()
    shown = [path for path in _files("impc", ".py", ".html", ".css", ".js")
             if _SHOWN.search(str(path.relative_to(ROOT / "impc")))]  # fmt: skip
    inside = {
        name: {other for other in others if subpackage(other) == "inverse"}
        for name, others in run.items()
        if subpackage(name) == "inverse"
    }
    words = sum(len(path.read_text(encoding="utf-8").split()) for path in PAGES.values())
    ids, share = _share_of_documents()
    rows = {
        "impc/: lines, of them docstrings": f"{_lines(ours):,}, {_docstrings(ours):,}",
        "impc/: modules": f"{len(run)}",
        "tests/: lines": f"{_lines(_files('tests', '.py')):,}",
        "docs/ and README: words": f"{words:,}",
        "test ids, of them of documents": f"{ids:,}, {100 * share:.0f} %",
        "inverse/: modules, import layers": f"{len(inside)}, {len(longest_chain(inside))}",
        "import circles, types counted": f"{len(circles(run))}",
        "presentation (Python, templates, styles, scripts)": f"{len(shown)} files, "
        f"{_lines(shown):,} lines",
        "README's Python example: files, functions, depth": "{}, {}, {}".format(*_followed()),
    }
    for name, value in rows.items():
        print(f"{name:<52}{value}")


if __name__ == "__main__":
    main()
