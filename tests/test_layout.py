"""Functions fit a screen, and tests stand where the modules stand."""

from __future__ import annotations

import ast

from tests.documents.blocks import ROOT

LONGEST = 60
#: Compiled inner loops: a call would have to pass, and allocate, what they keep in registers.
KERNELS = {
    "impc/control/compiled_loop.py": {"solve_dual", "run"},
}


def test_functions_fit_a_screen() -> None:
    long: dict[str, set[str]] = {}
    for package in ("impc", "plants"):
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if (
                    isinstance(node, ast.FunctionDef)
                    and (node.end_lineno or 0) - node.lineno >= LONGEST
                ):
                    long.setdefault(path.relative_to(ROOT).as_posix(), set()).add(node.name)
    assert long == KERNELS
