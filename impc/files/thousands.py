"""Thousands separators: 999 above 1.000, which may be a thousand and may be one."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from impc.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence


def require_no_thousands(
    source: str, names: Mapping[int, str], rows: Iterable[tuple[int, Sequence[str]]], sign: str
) -> None:
    """Refuse a column whose decimal `sign` may divide thousands.

    It may where the sign always stands before three digits and behind one to three that do not
    begin with 0, and other values are whole numbers without a sign. A program that writes decimals
    writes 999.000 there, or 1. `names` are those of the columns by their place in `rows`, which are
    numbers of lines with their fields; `source` is the file.
    """
    grouped = re.compile(rf"[+-]?[1-9]\d{{0,2}}(?:{re.escape(sign)}\d{{3}})+")
    left = dict(names)
    first: dict[int, tuple[int, str]] = {}
    whole: set[int] = set()
    for number, fields in rows:
        for index in list(left):
            item = fields[index].strip()
            if sign not in item:
                if item.lstrip("+-").isdigit():
                    whole.add(index)
            elif grouped.fullmatch(item):
                first.setdefault(index, (number, item))
            else:
                del left[index]  # decimals, without a doubt
        if not left:
            return
    for index, name in left.items():
        if index in whole and index in first:
            line, item = first[index]
            raise DataError(
                source,
                f"column {name!r} has whole numbers and {item!r} in line {line}, which may "
                "be a thousand",
                "export it without thousands separators, or with as many decimals in every row",
            )
