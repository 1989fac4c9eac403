"""Names of subjects, visits, conditions, trials and groups, checked where a study is read.

They become names of files and folders, cells of tables and lines on the terminal. What is let in
here is safe in all of them: letters, digits, spaces and . + - _, beginning with a letter or digit.
"""

from __future__ import annotations

import unicodedata

from impc.errors import InputError

__all__ = ["checked_name"]

_BETWEEN = frozenset(" .+-_")
_LONGEST = 64


def checked_name(where: str, what: str, text: str) -> str:
    """The name as it is used: its ends stripped, its accents composed (NFC)."""
    name = unicodedata.normalize("NFC", text.strip())
    bad = [letter for letter in name if not (letter.isalnum() or letter in _BETWEEN)]
    if bad:
        raise InputError(
            f"{where}: {what} {name[:_LONGEST]!a}", f"has {bad[0]!a} in it",
            "use letters, digits, spaces and . + - _",
        )  # fmt: skip
    if name and not name[0].isalnum():
        raise InputError(
            f"{where}: {what} {name!a}", "begins oddly", "begin with a letter or digit"
        )
    if len(name) > _LONGEST:
        raise InputError(
            f"{where}: {what} {name[:_LONGEST]!a}...", f"has {len(name)} characters",
            f"use at most {_LONGEST}",
        )  # fmt: skip
    return name
