"""The exit statuses of the `impc` command (docs/troubleshooting.md has the table)."""

from __future__ import annotations

from enum import IntEnum

__all__ = ["ExitStatus"]


class ExitStatus(IntEnum):
    """What a script may ask of a command that has ended."""

    DONE = 0
    PARTIAL = 1
    BAD_INPUT = 2
    DEFECT = 70
    INTERRUPTED = 130
    UNREAD = 141
