"""Levels of findings, of checks and of verdicts, with the words of their badges."""

from __future__ import annotations

import enum


class Level(enum.Enum):
    """How far a finding restricts what may be reported; a red finding of a check stops a fit."""

    GREEN = "green"  # No restriction
    AMBER = "amber"  # Some statements must not be made
    RED = "red"  # No statement about the person's control may be made
    NOTE = "note"  # For information

    @property
    def words(self) -> str:
        """Words of the badge of a verdict."""
        return _WORDS[self]


_WORDS = {
    Level.GREEN: "Ready to report",
    Level.AMBER: "Check before reporting",
    Level.RED: "Do not report",
    Level.NOTE: "Note",
}
