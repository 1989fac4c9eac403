"""Write docs/reproduction: `make reproduce`, or `python -m experiments.reproduction`."""

from __future__ import annotations

import argparse
from pathlib import Path

from experiments.reproduction.balance import balance_values
from experiments.reproduction.evidence import gather
from experiments.reproduction.example import controller_values, example_values
from experiments.reproduction.page import FIGURES, claims_page
from experiments.reproduction.seat import seat_values
from experiments.reproduction.selection import appendix_values, key_values, sensitive_values
from impc.reporting.writer import write_files

ROOT = Path(__file__).parents[2]


def main() -> None:
    """Run the commands that have no result yet, compute the values, write page and figures."""
    parser = argparse.ArgumentParser(description="The reproduction table.")
    parser.add_argument("--results", type=Path, default=ROOT / "results" / "reproduction")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "reproduction")
    given = parser.parse_args()
    evidence = gather(given.results)
    print("computing the values: a minute", flush=True)
    text = claims_page(
        balance_values(evidence)
        | controller_values()
        | example_values(evidence)
        | seat_values(evidence)
        | sensitive_values(evidence)
        | key_values(evidence)
        | appendix_values()
    )
    drawn = {path.replace("/", "-"): given.results / path for path in FIGURES.values()}
    figures = {name: path.read_bytes() for name, path in drawn.items()}
    write_files(given.out, figures | {"index.md": text.encode()})
    print(f"Written to {given.out}: index.md and its figures")


if __name__ == "__main__":
    main()
