"""Write docs/reproduction: `make reproduce`, or `python -m experiments.reproduction`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.reproduction import balance, example, key, seat, sensitive
from experiments.reproduction.appendices import appendix_entries
from experiments.reproduction.balance import balance_entries
from experiments.reproduction.entry import Chapter
from experiments.reproduction.evidence import gather
from experiments.reproduction.example import controller_entries, example_entries
from experiments.reproduction.key import key_entries
from experiments.reproduction.page import figure_name, page
from experiments.reproduction.seat import seat_entries
from experiments.reproduction.sensitive import sensitive_entries
from impc.reporting.writer import write_files

if TYPE_CHECKING:
    from experiments.reproduction.evidence import Evidence

ROOT = Path(__file__).parents[2]


def main() -> None:
    """Run the commands that have no result yet, compute the entries, write page and figures."""
    parser = argparse.ArgumentParser(description="The reproduction table.")
    parser.add_argument("--results", type=Path, default=ROOT / "results" / "reproduction")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "reproduction")
    given = parser.parse_args()
    chapters = _chapters(gather(given.results))
    drawn = [entry for chapter in chapters for entry in chapter.entries if entry.figure]
    figures = {figure_name(entry): (given.results / entry.figure).read_bytes() for entry in drawn}
    write_files(given.out, figures | {"index.md": page(chapters).encode()})
    print(f"Written to {given.out}: index.md and its figures")


def _chapters(evidence: Evidence) -> list[Chapter]:
    print("computing the entries: a minute", flush=True)
    inverse_mpc = [*controller_entries(), *example_entries(evidence)]
    return [
        Chapter(
            "Chapter 2: reliability of the seated-balance test",
            balance.STAND_IN,
            tuple(balance_entries(evidence)),
        ),
        Chapter("Chapter 3: inverse MPC", example.STAND_IN, tuple(inverse_mpc)),
        Chapter(
            "Chapter 3: the seated-balance experiment",
            seat.STAND_IN,
            tuple(seat_entries(evidence)),
        ),
        Chapter(
            "Chapter 4: sensitive parameters",
            sensitive.STAND_IN,
            tuple(sensitive_entries(evidence)),
        ),
        Chapter("Chapter 5: key parameters", key.STAND_IN, tuple(key_entries(evidence))),
        Chapter(
            "Appendices",
            "On the mean subject of table 4.3, simulated.",
            tuple(appendix_entries()),
        ),
    ]


if __name__ == "__main__":
    main()
