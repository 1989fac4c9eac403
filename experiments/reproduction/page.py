"""Pages that scripts write: tables, filled paragraphs, and the reproduction table from its text."""

from __future__ import annotations

import re
import textwrap
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["CLAIMS", "FIGURES", "VERDICTS", "claims_page", "joined", "table"]

#: The claims, one a row, with the names of values in braces.
CLAIMS = Path(__file__).with_name("claims.md")
#: Verdicts on a statement of the dissertation.
VERDICTS = ("reproduced", "reproduced in kind", "cannot be: lost", "not reproduced")
#: Figures drawn here, inside the folder of results, by the claim that they show.
FIGURES = {
    "Figure 2.3": "reliability/figures/trial.svg",
    "Figure 2.4": "reliability/figures/trial.svg",
    "Figure 2.5": "reliability/figures/transfer-visits.svg",
    "Figure 2.6": "reliability/figures/transfer-subjects.svg",
    "Figure 3.2": "example/figures/feedback_gain-case-A.svg",
    "Figure 3.3": "example/figures/inverse_mpc-case-A.svg",
    "Figure 3.4": "example/figures/inverse_lqr_output-case-A.svg",
    "Figure 3.7": "fit/figures/movement.svg",
    "(3.26)": "fit/figures/statements.svg",
    "Figure 4.5": "select/figures/parameters.svg",
    "Figure 5.3, yaw": "yaw/figures/solution-space.svg",
    "Figure 5.3, pitch": "pitch/figures/solution-space.svg",
}


class _Holds:
    """Truth value; with a verdict as its format, that verdict or "not reproduced"."""

    def __init__(self, holds: object) -> None:
        self.holds = bool(holds)

    def __format__(self, verdict: str) -> str:
        if not verdict:
            return "yes" if self.holds else "no"
        return f"**{verdict if self.holds else VERDICTS[-1]}**"


def claims_page(values: Mapping[str, Any]) -> str:
    """Text of the claims with their values, the count of each verdict, and the figures.

    `values` has numbers, texts, parts of `result.json`, and truth values of verdicts.
    """
    given = {
        name: _Holds(one) if isinstance(one, bool | np.bool_) else one
        for name, one in values.items()
    }
    text = CLAIMS.read_text(encoding="utf-8").format_map(given)
    rows = [re.split(r" (?<!\\)\| ", line.strip("| ")) for line in text.splitlines()
            if line.startswith("| **")]  # fmt: skip
    counts = Counter(row[0].split("**")[1] for row in rows)
    counted = ", ".join(f"{counts[verdict]} {verdict}" for verdict in VERDICTS)
    claims = {row[1]: row for row in rows}
    figures = "\n".join(_figure(claims[item], path) for item, path in FIGURES.items())
    text = text.replace("COUNTS", f"Of {len(rows)} lines: {counted}.")
    return text.replace("FIGURES", figures).rstrip() + "\n"


def _figure(row: list[str], path: str) -> str:
    verdict, item, says, here = row
    found = re.sub(r" \(`.*`\)$", "", here)
    return (
        f"### {item}\n\n*The dissertation:* {says}\n\n"
        f"```{{figure}} {path.replace('/', '-')}\n:alt: {item}\n:width: 100%\n\n"
        f"Here: {found} **{verdict.split('**')[1]}**.\n```\n"
    )


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Markdown table of texts."""
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (heads, ["---"] * len(heads), *rows))


def joined(*parts: str) -> str:
    """Markdown page of parts; lines of plain paragraphs and list items have 100 columns."""
    blocks = [block.strip("\n") for part in parts for block in part.split("\n\n")]
    return "\n\n".join(_filled(block) for block in blocks if block) + "\n"


def _filled(block: str) -> str:
    """A paragraph or list in lines of 100 columns; headings, tables and pictures as they are."""
    if block[0] in "#|!":
        return block
    items = re.split(r"\n(?=- )", block)
    return "\n".join(
        textwrap.fill(" ".join(item.split()), 100, subsequent_indent="  " * item.startswith("- "))
        for item in items
    )
