"""Change keys of a TOML text; comments, order and everything else stay."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from impc.errors import InputError
from impc.extras import optional
from impc.files.configuration import toml_content
from impc.files.draft import ON_VALUE

_TEXT = "configuration"


def edited(text: str, changes: Mapping[tuple[str, ...], Any]) -> str:
    """TOML `text` with the values of some TOML paths changed; None removes a key or table.

    Missing tables are made. The comment of a changed key goes if a draft wrote it about the value.
    """
    toml, wanted = optional("tomlkit", _TEXT), toml_content(text, _TEXT)
    for path, value in changes.items():
        table = _table(wanted, path, value, lambda _: {})
        table.pop(path[-1], None)
        table |= {} if value is None else {path[-1]: value}
    try:
        document = toml.parse(text)
        for path, value in changes.items():
            _change(toml, document, path, value)
        made: str = document.as_string().rstrip("\n") + "\n"
        same = tomllib.loads(made) == wanted
    except (toml.exceptions.TOMLKitError, ValueError):
        same = False
    if not same:  # whatever tomlkit writes wrongly
        raise InputError(_TEXT, "cannot be changed here", "change it in a text editor")
    return made


def _table(table: Any, path: tuple[str, ...], value: Any, make: Callable[[int], Any]) -> Any:
    """Table with the last key of the `path`; made if it is missing and there is a value."""
    for depth, name in enumerate(path[:-1], 2):
        if name not in table:
            if value is None:
                return {}
            table[name] = make(depth)
        table = table[name]
        if not isinstance(table, dict):
            raise InputError(f"{_TEXT}: {name}", "is not a table", "correct it").at("", *path)
    return table


def _change(toml: Any, document: Any, path: tuple[str, ...], value: Any) -> None:
    def made(depth: int) -> Any:
        found = toml.table(is_super_table=depth < len(path))
        return found if depth < len(path) else found.add(toml.items.Whitespace("\n"))

    key, table = path[-1], _table(document, path, value, made)
    body = table.value.body if isinstance(table, toml.items.Table) else []
    tables = (toml.items.Table, toml.items.AoT)
    lines = {name.key: _continued(body, place) for place, (name, item) in enumerate(body, 1)
             if name and not isinstance(item, tables)}  # fmt: skip
    end = max((part.stop for part in lines.values()), default=len(body))
    if key in lines:
        item = table.value.item(key)
        for one in (item, table) if key == "column" else (item,):
            if ON_VALUE.match(one.trivia.comment):
                one.trivia.comment = one.trivia.comment_ws = ""
    if value is None:
        for place in lines.get(key, ()):
            body[place] = None, toml.items.Null()
        table.pop(key, None)
    elif key not in table and end < len(body):
        # Beside the other keys, and not behind the comments after them.
        table.value._insert_at(end, toml.items.SingleKey(key), value)
    else:
        table[key] = value


def _continued(body: Sequence[Any], start: int) -> range:
    """Places from `start` on of indented lines, which continue the comment above them."""
    end = start
    while end < len(body) and re.match(" +#", body[end][1].as_string()):
        end += 1
    return range(start, end)
