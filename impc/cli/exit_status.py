"""The exit statuses of the `impc` command (docs/troubleshooting.md has the table)."""

from __future__ import annotations

from enum import IntEnum

__all__ = ["ExitStatus"]


class ExitStatus(IntEnum):
    """What a script may ask of a command that has ended.

    Attributes
    ----------
    DONE
        Everything asked for is written.
    PARTIAL
        A study is written, but some of it could not be computed; stderr names what.
    BAD_INPUT
        A file, an option, a plant or a folder cannot be used; nothing is written.
    DEFECT
        The program itself failed; stderr names the log. As EX_SOFTWARE of sysexits.h.
    INTERRUPTED
        From the keyboard: 128 + SIGINT, as shells have it.
    UNREAD
        Nobody reads its output any more, as in ``impc ... | head -1``: 128 + SIGPIPE.
    """

    DONE = 0
    PARTIAL = 1
    BAD_INPUT = 2
    DEFECT = 70
    INTERRUPTED = 130
    UNREAD = 141
