"""Markdown page of the entries, with figures next to their counterparts."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from experiments.reproduction.entry import Verdict

if TYPE_CHECKING:
    from collections.abc import Sequence

    from experiments.reproduction.entry import Chapter, Entry

__all__ = ["figure_name", "page"]

_HEAD = """\
# The reproduction table

Every equation, table, figure and numerical claim of the dissertation (A. Ramadan, Michigan State
University, 2018): how it stands, what it says, what is found here and where. Most of its
equations and numbers are lost from the available text; its recordings were never public.
Written by `make reproduce`, which runs the commands of the package and computes every number in
the last column.

- **reproduced**: the same statement holds here, checked against something independent.
- **reproduced in kind**: found on a stand-in or on simulated subjects, or rebuilt from the text
  around a lost formula.
- **cannot be: lost**: the dissertation's numbers are gone; what is found here stands for itself.
- **not reproduced**: looked for and not found, with the reason.
"""


def page(chapters: Sequence[Chapter]) -> str:
    """Page with counts, one table for each chapter, and the figures."""
    everything = [entry for chapter in chapters for entry in chapter.entries]
    counts = Counter(entry.verdict for entry in everything)
    counted = ", ".join(f"{counts[verdict]} {verdict.value}" for verdict in Verdict)
    parts = [_HEAD, f"Of {len(everything)} lines: {counted}.\n"]
    for chapter in chapters:
        parts.append(f"## {chapter.title}\n\n{chapter.stand_in}\n")
        parts.append("| verdict | | the dissertation | here |\n|---|---|---|---|")
        parts.extend(_row(entry) for entry in chapter.entries)
        parts.append("")
    parts.append("## Figures beside their counterparts\n")
    parts.extend(_figure(entry) for entry in everything if entry.figure)
    return "\n".join(parts).rstrip() + "\n"


def figure_name(entry: Entry) -> str:
    """File name of the figure next to the page."""
    return entry.figure.replace("/", "-")


def _row(entry: Entry) -> str:
    where = ", ".join(f"`{name}`" for name in entry.where)
    why = f" {entry.why}" if entry.why else ""
    cells = (f"**{entry.verdict.value}**.{why}", entry.item, entry.says, f"{entry.found} ({where})")
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _figure(entry: Entry) -> str:
    return (
        f"### {entry.item}\n\n*The dissertation:* {entry.says}\n\n"
        f"```{{figure}} {figure_name(entry)}\n:alt: {entry.item}\n:width: 100%\n\n"
        f"Here: {entry.found} **{entry.verdict.value}**.\n```\n"
    )
