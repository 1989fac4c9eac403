"""Linear combinations of states as text, such as "theta1 - 0.5 theta2_rate".

They define features of the cost and sensed signals of a subject (docs/howto/weights.md,
docs/why/output_feedback.md).
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from impc.arrays import Array
from impc.errors import InputError

# Range of the largest factor of a feature; its square stays a normal floating-point number.
_SIZES = 1e-50, 1e50
_NUMBER = re.compile(r"(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


def linear_combination(text: str, names: Sequence[str]) -> Array:
    """Parse a text such as ``theta2 - 0.5 theta1`` into coefficients (n,) over `names` (n,)."""
    row, at = np.zeros(len(names)), 0
    longest_first = sorted(range(len(names)), key=lambda index: -len(names[index]))
    while at < len(text.rstrip()):
        start = at
        sign, at = _sign(text, at)
        if sign == 0 and start > 0:
            raise _unread(text, at, "+ or -", names)
        number = _NUMBER.match(text, at)
        known = [index for index in longest_first if _stands(text, at, names[index])]
        factor = 1.0
        if number and not known:
            factor, at = float(number[0]), _blank(text, number.end())
            at = _blank(text, at + 1) if text[at : at + 1] == "*" else at
            known = [index for index in longest_first if _stands(text, at, names[index])]
        if not known:
            raise _unread(text, at, "a name", names)
        row[known[0]] += (sign or 1) * factor
        at = _blank(text, at + len(names[known[0]]))
    if not np.any(row):
        raise InputError(f"feature {text!r}", "is zero", "give a combination of states")
    largest = float(np.max(np.abs(row)))
    if not _SIZES[0] <= largest <= _SIZES[1]:
        raise InputError(f"feature {text!r}", f"has a factor of {largest:g}", "scale it to about 1")
    return row


def _sign(text: str, at: int) -> tuple[int, int]:
    at = _blank(text, at)
    found = text[at : at + 1]
    return {"+": 1, "-": -1}.get(found, 0), _blank(text, at + 1) if found in "+-" else at


def _blank(text: str, at: int) -> int:
    while text[at : at + 1].isspace():
        at += 1
    return at


def _stands(text: str, at: int, name: str) -> bool:
    """Whether `name` occurs at `at`, not followed by further letters or digits."""
    after = text[at + len(name) : at + len(name) + 1]
    return text.startswith(name, at) and not (after.isalnum() or after == "_")


def _unread(text: str, at: int, wanted: str, names: Sequence[str]) -> InputError:
    return InputError(
        f"feature {text!r}",
        f"expected {wanted} at {text[at : at + 20]!r}",
        f"combine {', '.join(names)} with numbers, + and -",
    )
