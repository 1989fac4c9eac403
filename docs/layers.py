"""What imports what in impc, read from the code, and the drawing of its rooms.

    python -m docs.rooms      writes docs/images/rooms.svg

A room is a folder of impc/; the modules beside them are the floor below all rooms, and
`impc/__init__.py` and `impc/__main__.py` the doors above. Nothing is imported to find this out.
"""

from __future__ import annotations

import ast
from collections import Counter
from html import escape
from pathlib import Path

__all__ = ["DRAWING", "ROOMS", "drawing", "floors", "imports", "room"]

ROOT = Path(__file__).parents[1]
#: Written by this module, shown by docs/architecture.md.
DRAWING = ROOT / "docs/images/rooms.svg"
#: From the ground up, with what each holds: a module imports from its own room and those before.
ROOMS = {
    "base": "errors, arrays, checks of arguments",
    "model": "plant, bounds, weights, recording, Riccati",
    "control": "controller, terminal set, closed loop",
    "inverse": "problem, residual, searches, methods",
    "assess": "what an estimate is worth",
    "files": "recordings and results in files",
    "reporting": "pages, figures, tables, writing",
    "output_feedback": "optional: subjects with sensory noise",
    "studies": "example, fit, compare, cohorts, ...",
    "nonlinear": "optional: problems of the user's own",
    "cli": "commands: parse, call, print",
    "door": "import impc, python -m impc",
}
#: The one module with arrows up: methods of an estimate call functions of higher rooms when used.
RESULT = "inverse.estimates"


def imports(typing: bool = True, package: Path = ROOT / "impc") -> dict[str, set[str]]:
    """The modules of impc that each module of it imports, by name without `impc.`.

    Parameters
    ----------
    typing : bool
        Whether what is imported for its types alone counts, and what is imported inside a function.
    package : Path
        Folder of the package; its name is that of the package.
    """
    files = {_name(path, package): path for path in sorted(package.rglob("*.py"))}
    found = {}
    for name, path in files.items():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        named = [
            item for node in _imports(tree.body, typing) for item in _named(node, package.name)
        ]
        found[name] = {_known(item, files) for item in named} - {name}
    if typing and RESULT in found:
        highest = list(ROOMS).index(room(RESULT))
        found[RESULT] = {one for one in found[RESULT] if list(ROOMS).index(room(one)) <= highest}
    return found


def room(module: str) -> str:
    """The room of a module of impc, a key of `ROOMS`."""
    first, _, rest = module.partition(".")
    if first in ("__init__", "__main__"):
        return "door"
    return first if rest or first in ROOMS else "base"


def floors(graph: dict[str, set[str]]) -> list[str]:
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
    """The rooms above each other as SVG, with a dot for every pair of which one imports the other.

    A room's line goes to the right; a dot, with the number of imports, joins it to the line that
    goes down into the room that is imported.
    """
    counts = Counter(
        (room(name), room(other))
        for name, others in graph.items()
        for other in others
        if room(name) != room(other)
    )
    modules = Counter(map(room, graph))
    shown = [name for name in reversed(ROOMS) if name != "door"]
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
<title>The rooms of impc, and how often each imports from those below it</title>
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
        f'<text x="20" y="{top + 38}">{escape(ROOMS[name])}</text>'
    )


def _dot(x: int, y: int, count: int) -> str:
    return (
        f'<circle cx="{x}" cy="{y}" r="4"/>\n'
        f'<text x="{x + 4}" y="{y - 6}" font-size="13">{count}</text>'
    )


def _name(path: Path, package: Path) -> str:
    parts = path.relative_to(package).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" and len(parts) > 1 else parts)


def _imports(body: list[ast.stmt], typing: bool) -> list[ast.stmt]:
    found: list[ast.stmt] = []
    for node in body:
        if isinstance(node, ast.Import | ast.ImportFrom):
            found.append(node)
        elif typing:
            inside = [item for item in ast.walk(node) if isinstance(item, ast.stmt)]
            found += [item for item in inside if isinstance(item, ast.Import | ast.ImportFrom)]
        elif isinstance(node, ast.With | ast.Try):
            found += _imports(node.body, typing)
    return found


def _named(node: ast.stmt, package: str) -> list[str]:
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
