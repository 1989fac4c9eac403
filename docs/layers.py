"""Import graph of impc, read from the code without importing it, and its drawing.

    python -m docs.layers      writes docs/images/layers.svg

The subpackages are ordered in layers. Modules directly in impc/ are the lowest layer, "base";
`impc/__init__.py` and `impc/__main__.py` are the highest, "package".
"""

from __future__ import annotations

import ast
from collections import Counter
from html import escape
from pathlib import Path

__all__ = ["DRAWING", "SUBPACKAGES", "circles", "drawing", "imports", "longest_chain", "subpackage"]

ROOT = Path(__file__).parents[1]
#: Written by this module, shown by docs/dev/architecture.md.
DRAWING = ROOT / "docs/images/layers.svg"
#: From the lowest layer up, with their content: a module imports from its own layer and lower ones.
SUBPACKAGES = {
    "base": "errors, arrays, checks of arguments",
    "model": "plant, bounds, weights, recording, Riccati",
    "control": "controller, terminal set, closed loop",
    "inverse": "problem, residual, searches, methods",
    "assess": "intervals, model tests, statements",
    "files": "recordings and results in files",
    "reporting": "pages, figures, tables, writing",
    "output_feedback": "optional: subjects with sensory noise",
    "studies": "example, fit, compare, cohorts, ...",
    "nonlinear": "optional: nonlinear optimal control",
    "cli": "commands: parse, call, print",
    "app": "optional: the same in a browser",
    "package": "import impc, python -m impc",
}


def imports(package: Path = ROOT / "impc") -> dict[str, set[str]]:
    """The modules of impc that each module of it imports, by name without `impc.`.

    Imports for types alone and inside functions count.
    """
    files = {_name(path, package): path for path in sorted(package.rglob("*.py"))}
    found = {}
    for name, path in files.items():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        named = [item for node in ast.walk(tree) for item in _named(node, package.name)]
        found[name] = {_known(item, files) for item in named} - {name}
    return found


def subpackage(module: str) -> str:
    """The key of `SUBPACKAGES` that a module belongs to."""
    first, _, rest = module.partition(".")
    if first in ("__init__", "__main__"):
        return "package"
    return first if rest or first in SUBPACKAGES else "base"


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Groups of modules that reach each other by imports."""
    reached = {name: set(others) for name, others in graph.items()}
    for middle in graph:
        for others in reached.values():
            if middle in others:
                others.update(reached[middle])
    found = {frozenset(other for other in others if name in reached[other])
             for name, others in reached.items() if name in others}  # fmt: skip
    return sorted(map(sorted, found))


def longest_chain(graph: dict[str, set[str]]) -> list[str]:
    """The longest chain of modules of which each imports the next, from the top."""
    longest: dict[str, list[str]] = {}

    def chain(name: str) -> list[str]:
        if name not in longest:
            longest[name] = []  # a cycle of types ends here
            below = [chain(other) for other in sorted(graph[name])]
            longest[name] = [name, *max(below, key=len, default=[])]
        return longest[name]

    return max((chain(name) for name in sorted(graph)), key=len)


def drawing(graph: dict[str, set[str]]) -> str:
    """The layers as SVG, with a dot and the number of imports for each pair of subpackages.

    A dot joins the horizontal line of the importing subpackage to the vertical line of the
    imported one.
    """
    counts = Counter(
        (subpackage(name), subpackage(other))
        for name, others in graph.items()
        for other in others
        if subpackage(name) != subpackage(other)
    )
    modules = Counter(map(subpackage, graph))
    shown = [name for name in reversed(SUBPACKAGES) if name != "package"]
    top = {name: 10 + _STEP * index for index, name in enumerate(shown)}
    rail = {name: 340 + 32 * index for index, name in enumerate(shown[1:])}
    parts = [_box(name, top[name], modules[name]) for name in shown]
    for name in shown:
        to = {rail[other]: counts[name, other] for other in rail if counts[name, other]}
        if to:
            parts.append(f'<path d="M320 {top[name] + 36}H{max(to)}" stroke="#555"/>')
        parts += [_dot(x, top[name] + 36, count) for x, count in to.items()]
        above = [other for other in shown if counts[other, name]]
        if name in rail and above:
            parts.append(
                f'<path d="M{rail[name]} {top[above[0]] + 36}V{top[name] + 12}H321" fill="none"'
                ' stroke="#555" marker-end="url(#a)"/>'
            )
    width, height = max(rail.values()) + 34, _STEP * len(shown)
    return _PAGE.format(width=width, height=height, parts="\n".join(parts))


_STEP = 64
_PAGE = """\
<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" \
font-family="Helvetica, Arial, sans-serif" font-size="14">
<title>The subpackages of impc, and how often each imports from those below it</title>
<defs><marker id="a" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="8" markerHeight="8" \
orient="auto"><path d="M0 0 10 5 0 10z"/></marker></defs>
<rect width="{width}" height="{height}" fill="#fff"/>
{parts}
</svg>
"""


def _box(name: str, top: int, count: int) -> str:
    title = "impc/*.py" if name == "base" else f"impc/{name}/"
    return (
        f'<rect x="10" y="{top}" width="310" height="46" rx="4" fill="#eef4fa" stroke="#222"/>\n'
        f'<text x="20" y="{top + 19}" font-size="16" font-weight="bold">{title}</text>\n'
        f'<text x="310" y="{top + 19}" text-anchor="end">{count} modules</text>\n'
        f'<text x="20" y="{top + 38}">{escape(SUBPACKAGES[name])}</text>'
    )


def _dot(x: int, y: int, count: int) -> str:
    return (
        f'<circle cx="{x}" cy="{y}" r="4"/>\n'
        f'<text x="{x + 4}" y="{y - 6}" font-size="13">{count}</text>'
    )


def _name(path: Path, package: Path) -> str:
    parts = path.relative_to(package).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" and len(parts) > 1 else parts)


def _named(node: ast.AST, package: str) -> list[str]:
    """Dotted names that a statement imports from the package, without its name."""
    if isinstance(node, ast.Import):
        names = [item.name for item in node.names]
    elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
        names = [f"{node.module}.{item.name}" for item in node.names]
    else:
        names = []
    inside = [name.partition(".") for name in names]
    return [rest for first, _, rest in inside if first == package]


def _known(name: str, files: dict[str, Path]) -> str:
    """The module that a dotted name is, or that it is a name in."""
    while name and name not in files:
        name = name.rpartition(".")[0]
    return name or "__init__"


if __name__ == "__main__":
    DRAWING.write_text(drawing(imports()), encoding="utf-8")
    print(DRAWING.relative_to(ROOT))
