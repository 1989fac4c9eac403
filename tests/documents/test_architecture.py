"""The drawing of the rooms is that of the code, and its arrows point down."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

import impc
from docs.rooms import DRAWING, ROOMS, drawing, floors, imports, room
from tests.documents.blocks import PAGES, ROOT, blocks

# Modules of the longest chain in which each needs the one below to be loaded; docs/architecture.md
# says why it is no less.
FLOORS = 20
ORDER = list(ROOMS)
# Files of users that docs/troubleshooting.md speaks of.
_OF_USERS = {"control.py", "file.py"}
CODE = [path for folder in ("impc", "plants", "experiments", "tests", "docs")
        for path in sorted((ROOT / folder).rglob("*.py"))
        if "_tutorials" not in path.parts]  # fmt: skip  # made by the site's build
GRAPH = imports()


def upwards(graph: dict[str, set[str]]) -> list[tuple[str, str]]:
    """Imports from a room that is higher, and those of the doors."""
    return [
        (name, other)
        for name, others in graph.items()
        for other in sorted(others)
        if ORDER.index(room(other)) > ORDER.index(room(name))
        or (room(other) == "door" and room(name) != "door")
    ]


def test_every_module_is_in_a_room() -> None:
    assert set(map(room, GRAPH)) == set(ROOMS)
    folders = {path.parent.name for path in (ROOT / "impc").glob("*/__init__.py")}
    assert folders == set(ROOMS) - {"base", "door"}


def test_arrows_point_down() -> None:
    assert upwards(GRAPH) == []


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
    found = imports(package=tmp_path / "impc")
    assert upwards(found) == [("model.plant", "__init__"), ("model.plant", "cli.fit")]
    loading = imports(typing=False, package=tmp_path / "impc")
    assert floors(loading) == ["cli.fit", "model.plant"]


def test_there_are_no_more_floors_than_there_were() -> None:
    assert len(floors(imports(typing=False))) <= FLOORS


def test_the_drawing_is_up_to_date() -> None:
    """Up to the numbers beside its dots: `make architecture` writes it."""
    shown, found = DRAWING.read_text(encoding="utf-8"), drawing(GRAPH)
    pair = [re.sub(r">\d+( modules)?<", ">#<", text) for text in (shown, found)]
    assert pair[0] == pair[1]
    assert "images/rooms.svg" in PAGES["docs/architecture.md"].read_text(encoding="utf-8")


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
    modules = set(GRAPH)
    strays = [
        f"{path.relative_to(ROOT)}:{node.lineno}: {item.name} is not defined in {node.module}"
        for path in CODE
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("impc.")
        for item in node.names
        if (module := str(node.module).removeprefix("impc."))
        and f"{module}.{item.name}" not in modules
        and item.name not in defined(module)
    ]
    assert strays == []


def test_no_public_name_hides_a_module() -> None:
    """Neither one directly in impc/ nor the one that it is defined in."""
    hidden = {module.split(".")[0] for module in GRAPH}
    own = {name for name in impc.__all__ if getattr(impc, name).__module__.split(".")[-1] == name}
    assert hidden.intersection(impc.__all__) | own == set()


@pytest.mark.parametrize("page", list(PAGES))
def test_every_file_that_a_page_names_is_there(page: str) -> None:
    """Paths of the code in full, impc/..., plants/... and so on, and names of modules alone."""
    text = PAGES[page].read_text(encoding="utf-8")
    prose = re.sub(r"^ *```.*?^ *```$", "", text, flags=re.MULTILINE | re.DOTALL)
    named = re.findall(
        r"(?<![\w/.-])((?:impc|plants|tests|experiments|docs)/[\w/.-]*\.(?:py|md|html|css|svg))\b",
        prose,
    )
    new = {block.file for block in blocks(page)}
    modules = {path.name for path in CODE} | new | _OF_USERS
    assert set(re.findall(r"`(\w+\.py)`", prose)) <= modules
    assert [
        name
        for name in sorted(set(named))
        if not (ROOT / name).exists() and Path(name).name not in new
    ] == []


def test_the_table_of_rooms_names_modules_of_each_room() -> None:
    text = PAGES["docs/architecture.md"].read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(impc/\w*/?)` \| (.*) \|$", text, flags=re.MULTILINE)
    assert {folder.removeprefix("impc/").strip("/") for folder, _ in rows} == {
        "" if name == "base" else name for name in set(ROOMS) - {"door"}
    }
    for folder, words in rows:
        named = re.findall(r"`([\w/]+\.py|\w+/)`", words)
        assert named
        assert [name for name in named if not (ROOT / folder / name).exists()] == []
