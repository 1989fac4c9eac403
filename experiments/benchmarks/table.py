"""Table of the benchmarks: results.md and results.json."""

from __future__ import annotations

import json
import os
import platform
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

from experiments.benchmarks.timing import Timing
from experiments.summary import markdown
from impc.reporting.writer import write_files

__all__ = ["Row", "compare", "write_tables"]

_PACKAGES = ("casadi", "numpy", "scipy", "numba", "clarabel", "cvxpy")
_HEAD = """# Benchmarks

Written by `make bench`. Ratios of median times measured in turn in one run, quartiles in brackets.
W1 is the example with two states, W2 the simulated seat. Times are of the machine named below; only
ratios can be compared. Every method has one BLAS thread (`OPENBLAS_NUM_THREADS=1`): matrices are
small, and with two threads on a busy machine one fit took six times as long.
"""


class Row(NamedTuple):
    """One result: a ratio, or a number with a unit."""

    what: str  # The measured case
    compared: str  # Its reference
    value: float | None  # None if the reference is not installed
    limit: float | None = None  # Largest accepted value; None if for information
    unit: str = ""  # Empty for a ratio
    note: str = ""  # Medians and quartiles, or why there is no value


def compare(
    what: str, compared: str, own: Timing, other: Timing, limit: float | None = None
) -> Row:
    """Row with a ratio of medians; the note has both medians and quartiles."""
    return Row(what, compared, own.median / other.median, limit, "", f"{_say(own)} / {_say(other)}")


def write_tables(rows: list[Row], folder: Path, runs: int) -> str:
    """Write results.md and results.json; return results.md."""
    versions = ", ".join(f"{name} {version(name)}" for name in _PACKAGES)
    machine = f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    head = ["what", "against", "measured", "at most", "median [quartiles], ms"]
    table = markdown(head, [_cells(row) for row in rows])
    text = f"{_HEAD}\n{table}\n\n{runs} runs; {machine}, {versions}\n"
    content = json.dumps([row._asdict() for row in rows], indent=1) + "\n"
    write_files(folder, {"results.md": text.encode(), "results.json": content.encode()})
    return text


def _cells(row: Row) -> list[str]:
    value = "-" if row.value is None else f"{_digits(row.value)} {row.unit}".strip()
    limit = "" if row.limit is None else f"{_digits(row.limit)} {row.unit}".strip()
    if row.value is not None and row.limit is not None and row.value > row.limit:
        value += " **(missed)**"
    return [row.what, row.compared, value, limit, row.note]


def _digits(value: float) -> str:
    return f"{value:.3g}" if value < 1000 else f"{value:.0f}"


def _say(timing: Timing) -> str:
    low, high = timing.spread
    return f"{1e3 * timing.median:.3g} [{1e3 * low:.3g}, {1e3 * high:.3g}]"
