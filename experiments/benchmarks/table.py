"""The rows of the benchmark table, and the files that they are written to."""

from __future__ import annotations

import json
import os
import platform
from dataclasses import asdict, dataclass
from importlib.metadata import version
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from experiments.benchmarks.timing import Timing

__all__ = ["Row", "compare", "write_tables"]

_PACKAGES = ("casadi", "numpy", "scipy", "numba", "clarabel", "cvxpy")


@dataclass(frozen=True)
class Row:
    """One claim: a ratio (or a plain number) beside what it must not exceed.

    Attributes
    ----------
    what, compared : str
        What was measured, and against what.
    value : float or None
        None when the peer is not installed.
    limit : float or None
        None where the figure is for information.
    unit : str
        Empty for a ratio.
    note : str
        Medians and quartiles, or why there is no figure.
    """

    what: str
    compared: str
    value: float | None
    limit: float | None
    unit: str
    note: str


def compare(what: str, compared: str, own: Timing, other: Timing, limit: float | None) -> Row:
    """A ratio of medians, with both medians and quartiles in the note."""
    return Row(what, compared, own.median / other.median, limit, "", f"{_say(own)} / {_say(other)}")


def write_tables(rows: list[Row], folder: Path, runs: int) -> str:
    """Write results.md and results.json, whole or not at all; return the former."""
    lines = [
        "# Benchmarks",
        "",
        "Written by `make bench`. Ratios of medians measured side by side in one run; in brackets "
        "the quartiles. Times are of the machine named below; only the ratios travel. `make bench` "
        "gives every method one BLAS thread: the matrices are small, and with two threads on a "
        "busy machine one fit took six times as long (`OPENBLAS_NUM_THREADS=1`).",
        "",
        "| what | against | measured | at most | median [quartiles], ms |",
        "|---|---|---|---|---|",
        *(_line(row) for row in rows),
        "",
        f"{runs} runs; {platform.machine()}, {os.cpu_count()} cores, Python "
        f"{platform.python_version()}, "
        + ", ".join(f"{name} {version(name)}" for name in _PACKAGES),
        "",
    ]
    text = "\n".join(lines)
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in (
        ("results.md", text),
        ("results.json", json.dumps([asdict(row) for row in rows], indent=1) + "\n"),
    ):
        part = folder / f".{name}.part"
        part.write_text(content, encoding="utf-8")
        part.replace(folder / name)
    return text


def _line(row: Row) -> str:
    value = "-" if row.value is None else f"{_digits(row.value)} {row.unit}".strip()
    limit = "" if row.limit is None else f"{_digits(row.limit)} {row.unit}".strip()
    if row.value is not None and row.limit is not None and row.value > row.limit:
        value += " **(missed)**"
    return f"| {row.what} | {row.compared} | {value} | {limit} | {row.note} |"


def _digits(value: float) -> str:
    return f"{value:.3g}" if value < 1000 else f"{value:.0f}"


def _say(timing: Timing) -> str:
    low, high = timing.spread
    return f"{1e3 * timing.median:.3g} [{1e3 * low:.3g}, {1e3 * high:.3g}]"
