"""Functions fit a screen."""

from __future__ import annotations

import ast

from tests.documents.blocks import ROOT

LONGEST = 60
#: Compiled inner loops: a call would have to pass, and allocate, what they keep in registers.
KERNELS = {"impc/control/compiled_dual.py": {"solve_dual"}}


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
