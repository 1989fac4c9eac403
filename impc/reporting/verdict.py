"""What a result allows to be said: one value, for page, terminal and result.json."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import fill, indent
from typing import Any

from impc.reporting.finding import Level

#: Columns of a terminal.
WIDTH = 100
_BADGES = {
    Level.GREEN: "Ready to report",
    Level.AMBER: "Check before reporting",
    Level.RED: "Do not report",
    Level.NOTE: "Note",
}


@dataclass(frozen=True)
class Claim:
    """What may, or may not, be reported."""

    text: str  # A sentence
    why: str = ""  # With its numbers, or why not


@dataclass(frozen=True)
class Key:
    """A number that stands first on the page."""

    value: str
    unit: str  # Behind it, small
    label: str  # What it is
    detail: str = ""  # Interval, or what it is about


@dataclass(frozen=True)
class Alert:
    """Something that was found, which restricts what may be reported."""

    level: Level
    title: str
    found: str
    means: str
    todo: Sequence[str]  # Steps, in their order

    def data(self) -> dict[str, Any]:
        """For result.json."""
        named = {name: getattr(self, name) for name in ("title", "found", "means")}
        return {"level": self.level.value, **named, "todo": list(self.todo)}


@dataclass(frozen=True)
class Verdict:
    """The answer of a page, how far it may be trusted, and what may be made of it.

    Green: all standard statements may be reported; amber: some, and an alert says which; red:
    nothing about how the subject controls the movement. A note has no badge.
    """

    level: Level
    headline: str
    sentence: str
    alerts: Sequence[Alert] = ()
    may: Sequence[Claim] = ()
    may_not: Sequence[Claim] = ()
    badge: str = ""  # In place of the usual words

    @property
    def words(self) -> str:
        """The words of the badge."""
        return self.badge or _BADGES[self.level]

    def data(self) -> dict[str, Any]:
        """For result.json."""
        return {
            "level": self.level.value,
            "headline": self.headline,
            "sentence": self.sentence,
            "alerts": [alert.data() for alert in self.alerts],
            "may_report": [_line(claim) for claim in self.may],
            "may_not_report": [_line(claim) for claim in self.may_not],
        }

    def text(self) -> str:
        """For a terminal."""
        badge = f"[{self.words}] " if self.level is not Level.NOTE else ""
        parts = [fill(badge + self.headline, WIDTH), fill(self.sentence, WIDTH)]
        for alert in self.alerts:
            lines = [alert.found, alert.means, *(f"- {step}" for step in alert.todo)]
            inside = indent("\n".join(fill(line, WIDTH - 2) for line in lines), "  ")
            parts.append(f"{alert.title}:\n{inside}")
        return "\n".join(part for part in parts if part)


def _line(claim: Claim) -> str:
    return f"{claim.text} {claim.why}".strip()
