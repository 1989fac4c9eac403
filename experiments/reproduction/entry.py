"""Lines of the reproduction table: claim of the dissertation, result here, verdict."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

__all__ = ["Chapter", "Entry", "Verdict", "agrees", "drawing", "kind"]


class Verdict(Enum):
    """Verdict on a statement of the dissertation."""

    REPRODUCED = "reproduced"
    IN_KIND = "reproduced in kind"
    LOST = "cannot be: lost"
    NOT = "not reproduced"


@dataclass(frozen=True)
class Entry:
    """A line of the table.

    Attributes
    ----------
    item : str
        "(3.4)", "Table 4.3", "Figure 3.2", or "Claim, 3.4" for a statement of that section.
    says : str
        Statement of the dissertation; if its text is lost, what can be inferred.
    where : tuple of str
        Names in this repository, "module:name" or "module".
    found : str
        Result, computed when the table is made.
    verdict : Verdict
    why : str
        Reason; required if the verdict is not `REPRODUCED`.
    figure : str
        Path of the figure drawn here, inside the folder of results; or empty.
    """

    item: str
    says: str
    where: tuple[str, ...]
    found: str
    verdict: Verdict
    why: str = ""
    figure: str = ""


@dataclass(frozen=True)
class Chapter:
    """Lines under one heading; `stand_in` describes the data used instead of lost ones."""

    title: str
    stand_in: str
    entries: tuple[Entry, ...]


def agrees(holds: bool) -> Verdict:
    """Verdict on a statement that can be reproduced exactly."""
    return Verdict.REPRODUCED if holds else Verdict.NOT


def kind(holds: bool) -> Verdict:
    """Verdict on a statement about lost data, tested on simulated data."""
    return Verdict.IN_KIND if holds else Verdict.NOT


def drawing(item: str, says: str) -> Entry:
    """Entry of a drawing of the seat or its model, which has no result to reproduce."""
    return Entry(
        item,
        says,
        ("plants.seated_balance",),
        "The model is in the module, with its equations.",
        Verdict.IN_KIND,
        "A drawing of the apparatus or the model, not a result.",
    )
