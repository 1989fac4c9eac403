"""Verdict of a report: conclusion, warnings, and statements that may be reported or not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import fill, indent
from typing import Any

from impc.levels import Level

#: Width of the text in a terminal, in characters.
WIDTH = 100


@dataclass(frozen=True)
class Claim:
    """Statement that may, or may not, be reported."""

    text: str
    why: str = ""  # Supporting numbers, or the reason why it may not be reported


@dataclass(frozen=True)
class Key:
    """Key number at the top of the page."""

    value: str
    unit: str
    label: str
    detail: str = ""  # For example its interval


@dataclass(frozen=True)
class Alert:
    """Warning: a finding, its consequence, and what to do."""

    level: Level
    title: str
    found: str
    means: str
    todo: Sequence[str]  # Steps, in order

    def data(self) -> dict[str, Any]:
        """Entry in result.json."""
        named = {name: getattr(self, name) for name in ("title", "found", "means")}
        return {"level": self.level.value, **named, "todo": list(self.todo)}


@dataclass(frozen=True)
class Verdict:
    """Conclusion of a page, warnings, and statements that may or may not be reported.

    Green: all standard statements may be reported. Amber: some; an alert says which. Red: none
    about how the person controls the movement. A note has no badge.
    """

    level: Level
    headline: str
    sentence: str
    alerts: Sequence[Alert] = ()
    may: Sequence[Claim] = ()
    may_not: Sequence[Claim] = ()
    badge: str = ""  # Replaces the usual words of the badge
    kind: str = ""  # Name of the leading kind of finding, if it has one

    @property
    def words(self) -> str:
        """Words of the badge."""
        return self.badge or self.level.words

    def data(self) -> dict[str, Any]:
        """Entry in result.json."""
        return {
            "level": self.level.value,
            "headline": self.headline,
            "sentence": self.sentence,
            "kind": self.kind,
            "alerts": [alert.data() for alert in self.alerts],
            "may_report": [_line(claim) for claim in self.may],
            "may_not_report": [_line(claim) for claim in self.may_not],
        }

    def text(self) -> str:
        """Text for a terminal."""
        badge = f"[{self.words}] " if self.level is not Level.NOTE else ""
        parts = [fill(badge + self.headline, WIDTH), fill(self.sentence, WIDTH)]
        for alert in self.alerts:
            lines = [alert.found, alert.means, *(f"- {step}" for step in alert.todo)]
            inside = indent("\n".join(fill(line, WIDTH - 2) for line in lines), "  ")
            parts.append(f"{alert.title}:\n{inside}")
        return "\n".join(part for part in parts if part)


def _line(claim: Claim) -> str:
    return f"{claim.text} {claim.why}".strip()
