"""How every command ends: one line on stderr for whatever goes wrong, and a status that tells what.

What nobody has foreseen is a defect: its line names the place in the code and a log for the report.

The exit statuses of the `impc` command (docs/troubleshooting.md has the table).
"""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import sys
import warnings
from enum import IntEnum
from typing import TYPE_CHECKING, Any

import click

from impc.errors import ImpcError, one_line
from impc.files.writing import NO_ROOM

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from types import FrameType, TracebackType


class InterruptionError(Exception):
    """The keyboard's interruption of a command, as an exception that click leaves alone."""


class UnreadError(Exception):
    """Nobody reads the output any more."""


class StrayError(Exception):
    """A call of `sys.exit` or a broken pipe inside a command, which click would take for an end."""


def ended(run: Callable[[], Any]) -> int:
    """Do the work of `run`, and say in one line what went wrong; the exit status."""
    heard: list[str] = []
    try:
        with _quiet(heard):
            return int(run() or ExitStatus.DONE)
    except SystemExit:  # of click's shell completion
        raise
    except UnreadError:
        return ExitStatus.UNREAD
    except (InterruptionError, click.Abort) as error:
        kept = f"; {error}" if error.args else ""
        return _say(f"interrupted{kept}", ExitStatus.INTERRUPTED)
    except (ImpcError, click.ClickException) as error:
        told = error.format_message() if isinstance(error, click.ClickException) else error
        return _say(f"error: {told}", ExitStatus.BAD_INPUT)
    except BaseException as error:  # the net itself
        if isinstance(error, OSError) and error.errno in NO_ROOM:
            where = error.filename or "output"
            return _say(f"error: {where}: {error.strerror}; make room", ExitStatus.BAD_INPUT)
        return _defect(error, heard)


@contextlib.contextmanager
def interruptions() -> Iterator[None]:
    """Turn what click would end the program for into what `ended` tells."""
    try:
        yield
    except KeyboardInterrupt as interruption:
        raise InterruptionError(*interruption.args) from None
    except SystemExit as error:
        raise StrayError(f"sys.exit({error.code!r}) was called") from error
    except BrokenPipeError as error:
        raise (UnreadError() if _printing(error) else StrayError("a pipe broke")) from error


def _printing(error: BaseException) -> bool:
    """Whether it is the program's output that broke, and not a pipe to another process."""
    last = error.__traceback__
    while last is not None and last.tb_next is not None:
        last = last.tb_next
    return last is not None and str(last.tb_frame.f_globals.get("__name__")).startswith("click")


@contextlib.contextmanager
def own_process() -> Iterator[None]:
    """Settings of a process that is all ours; not for a command that is called from Python.

    The first interruption ends the work in order; a second one, while it does, ends it at once.
    What libraries say in passing of threads and of objects that are being deleted is not shown.
    """
    import threading  # noqa: PLC0415

    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # a name that the terminal's encoding lacks is no fault
            stream.reconfigure(errors="backslashreplace")
    sys.unraisablehook = lambda _: None
    threading.excepthook = lambda _: None
    with contextlib.suppress(ValueError):  # not the main thread
        signal.signal(signal.SIGINT, _Interrupts())
        # After all that may take long: Python itself would end by the signal, and not with 130.
        atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)
    yield
    with contextlib.suppress(OSError, ValueError, AttributeError):
        sys.stdout.flush()
        return
    # What nobody takes would be tried again, and told, when the interpreter ends.
    with contextlib.suppress(OSError, ValueError, AttributeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class _Interrupts:
    """Of the keyboard: the first raises, the second ends the process."""

    def __init__(self) -> None:
        self.first = True

    def __call__(self, signum: int, frame: FrameType | None) -> None:
        if self.first:
            self.first = False
            raise KeyboardInterrupt
        if not _SAID:
            os.write(2, b"impc: interrupted twice; ended at once\n")
        os._exit(ExitStatus.INTERRUPTED)


# Whether the line of this process is written: there is only one.
_SAID: list[str] = []


def _say(message: str, status: ExitStatus) -> ExitStatus:
    line = f"impc: {one_line(message)}"
    _SAID.append(line)
    with contextlib.suppress(OSError, ValueError):  # stderr is full or closed: the status is left
        click.echo(line, err=True)
    return status


def _defect(error: BaseException, heard: list[str]) -> ExitStatus:
    what = "out of memory" if isinstance(error, MemoryError) else f"{type(error).__name__}: "
    text = one_line(error, 200)
    found = f"defect: {what}{text} ({_place(error.__traceback__)}); {_logged(error, heard)}"
    return _say(found, ExitStatus.DEFECT)


def _place(traceback: TracebackType | None) -> str:
    """The line of this project that was reached last; of the library where there is none."""
    found = "unknown place"
    ours = False
    while traceback is not None:
        name = str(traceback.tb_frame.f_globals.get("__name__", "?"))
        here = name.partition(".")[0] in ("impc", "plants")
        if here or not ours:
            found, ours = f"{name}, line {traceback.tb_lineno}", here
        traceback = traceback.tb_next
    return found


def _logged(error: BaseException, heard: list[str]) -> str:
    """Write all that is known to a log that only the user can read, and say where it is."""
    import platform  # noqa: PLC0415  # --help needs none of these
    import tempfile  # noqa: PLC0415
    import traceback  # noqa: PLC0415

    path = ""
    try:
        lines = [
            f"impc {' '.join(sys.argv[1:])}",
            f"Python {platform.python_version()}, {platform.platform()}",
            *heard,
            *traceback.format_exception(error),
        ]
        handle, path = tempfile.mkstemp(prefix="impc-", suffix=".log")
        with open(handle, "w", encoding="utf-8", errors="backslashreplace") as stream:
            stream.write("\n".join(lines))
    except Exception as fault:  # a full disk, no memory: the line is told all the same
        if path:
            with contextlib.suppress(OSError):
                os.remove(path)
        return f"no log could be written ({one_line(fault, 100)})"
    return f"please report it with {path}"


@contextlib.contextmanager
def _quiet(heard: list[str]) -> Iterator[None]:
    """Keep what libraries warn of for the log; warnings that are errors are raised as before."""
    import logging  # noqa: PLC0415  # where click needs it not

    def keep(message: Warning | str, category: type[Warning], *place: Any) -> None:
        heard.append(f"{category.__name__}: {message} ({place[0]}, line {place[1]})")

    class Keep(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            heard.append(f"{record.name}: {record.getMessage()}")

    handler = Keep(logging.WARNING)
    logging.getLogger().addHandler(handler)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = keep  # type: ignore[assignment]
            yield
    finally:
        logging.getLogger().removeHandler(handler)


class ExitStatus(IntEnum):
    """What a script may ask of a command that has ended."""

    DONE = 0
    PARTIAL = 1
    BAD_INPUT = 2
    DEFECT = 70
    INTERRUPTED = 130
    UNREAD = 141
