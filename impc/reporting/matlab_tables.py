"""The tables of a result as one MATLAB file: a struct a table, a field a column (docs/results.md).

Names follow MATLAB's rules: letters, digits and underscores, a letter first, 63 characters at most.
Columns of numbers are column vectors, all others cell arrays of text.
"""

from __future__ import annotations

import io
import math
import re
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.io

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from impc.reporting.document import TextTable

__all__ = ["matlab_tables"]

_LONGEST = 63


def matlab_tables(tables: Mapping[str, TextTable]) -> bytes:
    """The bytes of a .mat file of version 5."""
    content = {}
    for name, table in zip(_names(list(tables)), tables.values(), strict=True):
        columns = list(zip(*table.rows, strict=True)) or [()] * len(table.heads)
        fields = zip(_names(table.heads), columns, strict=True)
        content[name] = {field: _column(values) for field, values in fields}
    stream = io.BytesIO()
    save: Any = scipy.io.savemat  # its stubs know paths only
    save(stream, content, long_field_names=True, oned_as="column")
    return stream.getvalue()


def _names(given: Sequence[str]) -> list[str]:
    """Names that MATLAB takes; what becomes the same is told apart by a number."""
    found: list[str] = []
    for text in given:
        name = re.sub(r"\W", "_", text, flags=re.ASCII)
        name = (name if re.match("[A-Za-z]", name) else f"x{name}")[:_LONGEST]
        count = 1
        while name in found:
            count += 1
            name = f"{name[: _LONGEST - 4]}_{count}"
        found.append(name)
    return found


def _column(values: Sequence[Any]) -> Any:
    numbers = [math.nan if value is None else value for value in values]
    if all(isinstance(value, int | float) for value in numbers):
        return np.array(numbers, dtype=np.float64)[:, None]
    cells = np.empty((len(numbers), 1), dtype=object)
    cells[:, 0] = [str(value) for value in values]
    return cells
