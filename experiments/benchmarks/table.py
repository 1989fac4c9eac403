"""Rows of the benchmark table, and the files with them."""

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
    """One result: a ratio (or a number) with its upper limit.

    Attributes
    ----------
    what, compared : str
        The measured case, and the reference.
    value : float or None
        None if the reference is not installed.
    limit : float or None
        Largest accepted value; None if for information.
    unit : str
        Unit of the value; empty for a ratio.
    note : str
        Medians and quartiles, or why there is no value.
    """

    what: str
    compared: str
    value: float | None
    limit: float | None
    unit: str
    note: str


def compare(what: str, compared: str, own: Timing, other: Timing, limit: float | None) -> Row:
    """Row with a ratio of medians; the note has both medians and quartiles."""
    return Row(what, compared, own.median / other.median, limit, "", f"{_say(own)} / {_say(other)}")


def write_tables(rows: list[Row], folder: Path, runs: int) -> str:
    """Write results.md and results.json, each complete or not at all; return results.md."""
    lines = [
        "# Benchmarks",
        "",
        "Written by `make bench`. Ratios of median times measured in turn in one run, quartiles in "
        "brackets. W1 is the example with two states, W2 the simulated seat. Times are of the "
        "machine named below; only ratios can be compared. Every method has one BLAS thread "
        "(`OPENBLAS_NUM_THREADS=1`): the matrices are small, and with two threads on a busy "
        "machine one fit took six times as long.",
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
