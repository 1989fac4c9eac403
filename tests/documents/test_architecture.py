"""Imports point down, functions fit a screen, and files that pages and docstrings name exist."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import impc
from docs.layers import DRAWING, SUBPACKAGES, circles, drawing, imports, subpackage
from tests.documents.blocks import PAGES, ROOT, blocks

ORDER = list(SUBPACKAGES)
# Files of users in examples.
_OF_USERS = {"control.py", "file.py"}
CODE = [path for folder in ("impc", "plants", "experiments", "tests", "docs")
        for path in sorted((ROOT / folder).rglob("*.py"))
        if "_examples" not in path.parts]  # fmt: skip  # written by the site's build
GRAPH = imports()
LONGEST = 60
#: Compiled inner loops: a call would have to pass, and allocate, what they keep in registers.
KERNELS = {"impc/control/compiled_dual.py": {"solve_dual"}}


def upwards(graph: dict[str, set[str]]) -> list[tuple[str, str]]:
    """Imports from a higher layer, and imports of the package itself."""
    return [
        (name, other)
        for name, others in graph.items()
        for other in sorted(others)
        if ORDER.index(subpackage(other)) > ORDER.index(subpackage(name))
        or (subpackage(other) == "package" and subpackage(name) != "package")
    ]


def test_arrows_point_down_and_the_drawing_shows_them() -> None:
    assert set(map(subpackage, GRAPH)) == set(SUBPACKAGES)
    assert upwards(GRAPH) == []
    # Up to the numbers beside its dots: `make architecture` writes it.
    shown, found = DRAWING.read_text(encoding="utf-8"), drawing(GRAPH)
    pair = [re.sub(r">\d+( modules)?<", ">#<", text) for text in (shown, found)]
    assert pair[0] == pair[1]


def test_no_modules_import_each_other() -> None:
    assert circles(GRAPH) == []


def test_an_arrow_that_points_up_is_found(tmp_path: Path) -> None:
    for folder in ("impc/model", "impc/cli"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "__init__.py").write_text("")
    (tmp_path / "impc/cli/fit.py").write_text("import impc.model.plant\n")
    (tmp_path / "impc/model/plant.py").write_text(
        "from typing import TYPE_CHECKING\n"
        "if TYPE_CHECKING:\n    from impc.cli.fit import command\n"
        "def late():\n    from impc import Plant\n"
    )
    (tmp_path / "impc/__init__.py").write_text("")
    found = imports(tmp_path / "impc")
    assert upwards(found) == [("model.plant", "__init__"), ("model.plant", "cli.fit")]


@cache
def defined(module: str) -> frozenset[str]:
    """Names that a module binds itself: functions, classes, constants."""
    path = ROOT / "impc" / module.replace(".", "/")
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    found = set()
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            stored = (item for item in ast.walk(node) if isinstance(item, ast.Name))
            found |= {item.id for item in stored if isinstance(item.ctx, ast.Store)}
    return frozenset(found)


def test_a_name_is_imported_from_the_module_that_defines_it() -> None:
    strays = [
        f"{path.relative_to(ROOT)}:{node.lineno}: {item.name} is not defined in {node.module}"
        for path in CODE
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("impc.")
        for item in node.names
        if (module := str(node.module).removeprefix("impc."))
        and f"{module}.{item.name}" not in GRAPH
        and item.name not in defined(module)
    ]
    assert strays == []


def test_no_public_name_hides_a_module() -> None:
    hidden = {module.split(".")[0] for module in GRAPH}
    own = {name for name in impc.__all__ if getattr(impc, name).__module__.split(".")[-1] == name}
    assert hidden.intersection(impc.__all__) | own == set()


def test_every_file_that_a_page_or_a_docstring_names_is_there() -> None:
    """Paths of the code in full, impc/..., plants/... and so on, and names of modules alone."""
    path = (
        r"(?<![\w/.-])((?:impc|plants|tests|experiments|docs)/[\w/.-]*\.(?:py|md|html|css|svg))\b"
    )
    missing = set()
    for page, file in PAGES.items():
        prose = re.sub(r"^ *```.*?^ *```$", "", file.read_text("utf-8"), flags=re.M | re.S)
        new = {block.file for block in blocks(page)}
        modules = {code.name for code in CODE} | new | _OF_USERS
        missing |= {(page, name) for name in re.findall(r"`(\w+\.py)`", prose)
                    if name not in modules}  # fmt: skip
        missing |= {(page, name) for name in re.findall(path, prose)
                    if not (ROOT / name).exists() and Path(name).name not in new}  # fmt: skip
    for code in CODE:
        if code.is_relative_to(ROOT / "impc"):
            named = re.findall(
                r"(?:docs|experiments)/[\w/-]+\.md", code.read_text(encoding="utf-8")
            )
            missing |= {(code.name, name) for name in named if not (ROOT / name).exists()}
    assert missing == set()


def lines(node: ast.FunctionDef) -> int:
    """Of its code, without the docstring and its example."""
    stated = node.body[0] if ast.get_docstring(node) else None
    whole = (node.end_lineno or 0) - node.lineno + 1
    return whole - (0 if stated is None else (stated.end_lineno or 0) - stated.lineno + 1)


def test_functions_fit_a_screen() -> None:
    long: dict[str, set[str]] = {}
    for package in ("impc", "plants"):
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.FunctionDef) and lines(node) > LONGEST:
                    long.setdefault(path.relative_to(ROOT).as_posix(), set()).add(node.name)
    assert long == KERNELS
