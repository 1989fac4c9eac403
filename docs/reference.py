"""Reference pages made from the code: settings, results, commands, messages, public names.

`write_reference(folder)` writes a Markdown file for each, which the pages of `docs/ref` include.
"""

from __future__ import annotations

import ast
import dataclasses
import json
import re
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import click
import msgspec
from numpydoc.docscrape import ClassDoc

import impc
from impc import errors
from impc.cli.main import main
from impc.files.configuration import RecordingTable, ReportTable, SignalTable, SubjectTable
from impc.files.results import MethodRecord, ResultFile
from impc.nonlinear.files import OptimalFitSettings, ParameterSettings
from impc.studies.cohort.study import StudyTable
from impc.studies.fit import data
from impc.studies.fit.settings import FitSettings, ObserverSettings, StructureSettings
from impc.studies.plan.settings import PlanSettings
from impc.studies.selection.settings import SelectSettings

#: Heading -> class whose attributes are the keys of that TOML table.
SETTINGS = {
    "[subject]": SubjectTable,
    "[recording]": RecordingTable,
    "[signals.NAME]": SignalTable,
    "[fit]": FitSettings,
    "[fit.structure]": StructureSettings,
    "[fit.observer]": ObserverSettings,
    "[fit] of an optimal control problem": OptimalFitSettings,
    "[fit.parameters.NAME] of an optimal control problem": ParameterSettings,
    "[plan]": PlanSettings,
    "[study]": StudyTable,
    "[select]": SelectSettings,
    "[report]": ReportTable,
}
_GROUPS = {
    "files": "Files and configuration",
    "cli": "Commands",
    "model": "Plant, bounds, weights and recordings in Python",
    "control": "Controller and simulation",
    "inverse": "Estimation",
    "assess": "Estimation",
    "output_feedback": "Sensory noise",
    "nonlinear": "Optimal control problems",
    "studies": "Studies and their settings",
    "reporting": "Folders of results",
}
_TYPES = {
    r",? ?\boptional\b": "",
    r" or None\b": "",
    r"\bstr\b": "text",
    r"\bfloat\b": "number",
    r"\bint\b": "whole number",
    r"\bbool\b": "true or false",
    r"\bdict of text to\b": "table of",
}
_ERRORS = {name for name, kind in vars(errors).items() if isinstance(kind, type)}


def write_reference(folder: Path) -> None:
    """Write all pages into `folder`."""
    folder.mkdir(exist_ok=True)
    pages = {
        "settings": settings_page(),
        "results": results_page(),
        "cli": command_page(),
        "errors": message_page(),
        "api": name_page(),
    }
    for name, text in pages.items():
        (folder / f"{name}.md").write_text(text, encoding="utf-8")


def settings_page() -> str:
    """A table for each TOML table: key, type, default, meaning."""
    return "\n".join(_attributes(f"`{name}`", kind) for name, kind in SETTINGS.items())


def results_page() -> str:
    """The keys of every result.json, of its methods, and of a fit."""
    tables = _attributes("Every result", ResultFile) + _attributes("`methods.NAME`", MethodRecord)
    _, _, keys = str(data.__doc__).partition("\n\n")
    return f"{tables}\n## `impc fit` and `impc.report`\n\n```text\n{keys.strip()}\n```\n"


def _attributes(title: str, kind: type) -> str:
    defaults = {name: _default(field) for name, field in _fields(kind)}
    rows = [
        (f"`{item.name}`", defaults[item.name], _type(item.type), " ".join(item.desc))
        for item in ClassDoc(kind)["Attributes"]
        if item.name in defaults
    ]
    head = "| key | default | type | meaning |\n|---|---|---|---|\n"
    lines = ("| " + " | ".join(map(_cell, row)) + " |\n" for row in rows)
    return f"## {title}\n\n{head}{''.join(lines)}\n"


def _fields(kind: type) -> Iterable[tuple[str, Any]]:
    fields = dataclasses.fields if dataclasses.is_dataclass(kind) else msgspec.structs.fields
    return [(field.name, field) for field in fields(kind)]


def _default(field: Any) -> str:
    """As TOML and JSON write it; a dash if the key has none."""
    if callable(field.default_factory):
        return f"`{json.dumps(field.default_factory())}`"
    if field.default in (dataclasses.MISSING, msgspec.NODEFAULT):
        return "required"
    return "–" if field.default is None else f"`{json.dumps(field.default, default=str)}`"


def _type(text: str) -> str:
    """A type of Python in the words of users of TOML."""
    for name, word in _TYPES.items():
        text = re.sub(name, word, text)
    return text


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def command_page() -> str:
    """The help of each command."""
    parts = []
    for path, command in _commands((), main):
        context = click.Context(command, info_name=" ".join(("impc", *path)))
        context.terminal_width = 96
        parts.append(f"## `{context.info_name}`\n\n```text\n{command.get_help(context)}\n```\n")
    return "\n".join(parts)


def _commands(path: tuple[str, ...], group: click.Command) -> Iterable[tuple[tuple[str, ...], Any]]:
    yield path, group
    if isinstance(group, click.Group):
        context = click.Context(group)
        for name in group.list_commands(context):
            command = group.get_command(context, name)
            if command is not None and not command.hidden:
                yield from _commands((*path, name), command)


def message_page() -> str:
    """Every message that the code raises as it is written there, with its remedy, by subpackage."""
    package = Path(impc.__file__).parent
    found: dict[str, set[tuple[str, str]]] = defaultdict(set)
    for path in package.rglob("*.py"):
        group = _GROUPS.get(path.relative_to(package).parts[0], "Arguments in Python")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            found[group].update(_message(node))
    head = "| what is wrong | what to do |\n|---|---|\n"
    return "\n".join(
        f"## {group}\n\n{head}"
        + "".join(f"| {_cell(what)} | {_cell(remedy)} |\n" for what, remedy in sorted(found[group]))
        for group in dict.fromkeys([*_GROUPS.values(), "Arguments in Python"])
    )


def _message(node: ast.AST) -> Iterable[tuple[str, str]]:
    """Problem and remedy of a call of one of the exceptions, unless the problem is a variable."""
    if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name)):
        return
    if node.func.id in _ERRORS and len(node.args) == 3:
        what, remedy = (_written(part) for part in node.args[1:])
        if len(what.replace("…", " ").split()) > 1:
            yield what, "(the message names it)" if remedy == "…" else remedy


def _written(node: ast.expr) -> str:
    """A string as the code has it; … stands for what is put in when it runs."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(_written(part) for part in node.values)
    if isinstance(node, ast.BinOp):
        return _written(node.left) + _written(node.right)
    if isinstance(node, ast.IfExp):
        return f"{_written(node.body)} / {_written(node.orelse)}"
    return "…"


def name_page() -> str:
    """Signature and docstring of each public name, by subpackage."""
    groups: dict[str, list[str]] = {}
    for name in impc.__all__:
        package = getattr(impc, name).__module__.split(".")[1]
        groups.setdefault(_GROUPS.get(package, "Errors and values"), []).append(name)
    return "\n".join(
        f"## {group}\n\n" + "".join(map(_entry, groups[group]))
        for group in dict.fromkeys([*_GROUPS.values(), "Errors and values"])
        if group in groups
    )


def _entry(name: str) -> str:
    kind = "class" if isinstance(getattr(impc, name), type) else "function"
    return f"### {name}\n\n```{{eval-rst}}\n.. auto{kind}:: impc.{name}\n```\n\n"
