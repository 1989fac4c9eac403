"""Where the recordings of a study are: by a pattern, a table, or names as BIDS has them."""

from __future__ import annotations

import glob
import re
from pathlib import Path

from impc.errors import InputError
from impc.files.formats import FORMATS
from impc.studies.cohort.names import checked_name
from impc.studies.cohort.sheet import read_sheet

__all__ = ["KEYS", "Found", "find_by_entities", "find_by_pattern", "find_by_table"]

#: Labels of a trial.
KEYS = ("subject", "visit", "condition", "trial")
_ENTITIES = {"subject": "sub", "visit": "ses", "condition": "task", "trial": "run"}
_NAME = r"[^/\\_]+?"

#: A recording with its labels, by `KEYS`.
Found = tuple[dict[str, str], Path]


def find_by_pattern(where: str, folder: Path, pattern: str) -> list[Found]:
    """Files whose path matches a pattern with {subject}, {visit}, {condition} and {trial}."""
    if Path(pattern).is_absolute():
        folder = Path(Path(pattern).anchor)
        pattern = pattern[len(folder.as_posix()) :]
    matching = re.compile(_expression(where, pattern))
    parts = re.split(r"(\{\w+\})", pattern)
    wild = "".join("*" if part.startswith("{") else glob.escape(part) for part in parts)
    found = []
    for file in sorted(folder.glob(wild)):
        match = matching.fullmatch(file.relative_to(folder).as_posix())
        if match:
            found.append((_labels(_printable(file), match.groupdict()), file))
    return found


def _expression(where: str, pattern: str) -> str:
    """The regular expression of a pattern."""
    names = re.findall(r"\{(\w+)\}", pattern)
    unknown = [name for name in names if name not in KEYS]
    if unknown or "subject" not in names:
        raise InputError(
            where, f"names {', '.join(unknown) or 'no subject'}",
            f"use {', '.join(f'{{{name}}}' for name in KEYS)}",
        )  # fmt: skip
    rest = re.sub(r"\{\w+\}", "", pattern)
    if re.search(r"[{}\x00-\x1f]", rest) or "**" in pattern:
        raise InputError(
            where, f"cannot be {pattern[:80]!a}", "write a path with names in {braces}"
        )
    together = re.search(r"\{\w+\}\{\w+\}", pattern)
    if together:
        raise InputError(
            where, f"has nothing between {together[0]}", "write a character between, or use `table`"
        )
    expression, seen = "", set()
    for part in re.split(r"(\{\w+\})", Path(pattern).as_posix()):
        name = part[1:-1]
        if part.startswith("{") and name in seen:
            expression += f"(?P={name})"
        elif part.startswith("{"):
            expression += f"(?P<{name}>{_NAME})"
            seen.add(name)
        else:
            expression += re.escape(part)
    return expression


def find_by_entities(folder: Path) -> list[Found]:
    """Files in a `folder` and below whose names have sub-, and may have ses-, task- and run-."""
    found = []
    for file in sorted(folder.rglob("sub-*")):
        hidden = any(part.startswith(".") for part in file.relative_to(folder).parts)
        if hidden or file.suffix.lower() not in FORMATS or not file.is_file():
            continue
        entities = dict(re.findall(r"(?:^|_)([a-z]+)-([^_.]+)", file.name))
        labels = {key: entities.get(short, "") for key, short in _ENTITIES.items()}
        if labels["subject"]:
            found.append((_labels(_printable(file), labels), file))
    return found


def find_by_table(path: Path) -> list[Found]:
    """Files and labels from the table at `path`, with the columns file and subject, maybe more."""
    sheet = read_sheet(path)
    if not {"file", "subject"} <= set(sheet.heads):
        raise InputError(sheet.where, "lacks a column", "name the columns file, subject")
    found = []
    for row in sheet.rows:
        if not row["file"] or not row["subject"]:
            raise InputError(sheet.where, "has a row without file or subject", "fill every row")
        found.append((_labels(sheet.where, row), path.parent / row["file"]))
    return found


def _labels(where: str, given: dict[str, str]) -> dict[str, str]:
    return {key: checked_name(where, key, given.get(key) or "") for key in KEYS}


def _printable(file: Path) -> str:
    """A path for a message: its name may have bytes that are no text, and control characters."""
    text = str(file).encode("utf-8", "backslashreplace").decode()
    return text if text.isprintable() else ascii(text)[1:-1]
