"""One line of the reproduction table: what the dissertation says, and what is found here."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

__all__ = ["Chapter", "Entry", "Verdict", "agrees", "drawing", "kind"]


class Verdict(Enum):
    """How the dissertation's statement stands."""

    REPRODUCED = "reproduced"
    IN_KIND = "reproduced in kind"
    LOST = "cannot be: lost"
    NOT = "not reproduced"


@dataclass(frozen=True)
class Entry:
    """A line.

    Attributes
    ----------
    item : str
        "(3.4)", "Table 4.3", "Figure 3.2", or "Claim, 3.4" for a statement of that section.
    says : str
        What the dissertation says; where its text has lost it, what can be inferred.
    where : tuple of str
        Names in this repository, "module:name" or "module".
    found : str
        Computed when the table is made.
    verdict : Verdict
    why : str
        Needed where the verdict is not `REPRODUCED`.
    figure : str
        Path of the PNG that this package draws for it, inside the folder of results; or empty.
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
    """Lines under one heading; `stand_in` says what takes the place of data that are lost."""

    title: str
    stand_in: str
    entries: tuple[Entry, ...]


def agrees(holds: bool) -> Verdict:
    """Of a statement that is found exactly as it was made, or is not."""
    return Verdict.REPRODUCED if holds else Verdict.NOT


def kind(holds: bool) -> Verdict:
    """Of a statement about the dissertation's own data, looked for in data of ours."""
    return Verdict.IN_KIND if holds else Verdict.NOT


def drawing(item: str, says: str) -> Entry:
    """A figure of the seat or of its model: there is nothing in it to reproduce."""
    return Entry(
        item,
        says,
        ("plants.seated_balance",),
        "The model is in the module, with its equations.",
        Verdict.IN_KIND,
        "A drawing of the apparatus or the model, not a result.",
    )
