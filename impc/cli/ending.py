"""Turn every failure of a command into one stderr line and an exit status.

An unexpected exception is a defect: its line names the place in the code and a log file. The table
of exit statuses is in docs/ref/cli.md.
"""

from __future__ import annotations

import atexit
import contextlib
import logging
import os
import signal
import sys
import time
import traceback
from enum import IntEnum
from typing import TYPE_CHECKING, Any

import click

from impc.errors import ImpcError, one_line
from impc.files.disk import NO_ROOM

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


# Seconds from an interruption by the end of stdin to the end of the process.
_PATIENCE = 20.0


class ExitStatus(IntEnum):
    """Exit statuses of the `impc` command."""

    DONE = 0
    PARTIAL = 1
    BAD_INPUT = 2
    DEFECT = 70
    INTERRUPTED = 130
    UNREAD = 141


def ended(run: Callable[[], Any]) -> int:
    """Call `run`, print any failure in one line, and return the exit status."""
    heard: list[str] = []
    try:
        with _quiet(heard):
            return int(run() or ExitStatus.DONE)
    except SystemExit:  # of click's shell completion
        raise
    except click.Abort as error:
        kept = f"; {error}" if error.args else ""
        return _say(f"interrupted{kept}", ExitStatus.INTERRUPTED)
    except (ImpcError, click.ClickException) as error:
        stated = error.format_message() if isinstance(error, click.ClickException) else error
        return _say(f"error: {stated}", ExitStatus.BAD_INPUT)
    except BaseException as error:
        if isinstance(error, OSError) and error.errno in NO_ROOM:
            where = error.filename or "output"
            return _say(f"error: {where}: {error.strerror}; free disk space", ExitStatus.BAD_INPUT)
        return _defect(error, heard)


@contextlib.contextmanager
def interruptions() -> Iterator[None]:
    """Convert the exceptions that click handles itself into those that `ended` reports."""
    try:
        yield
    except KeyboardInterrupt as interruption:
        raise click.Abort(*interruption.args) from None
    except SystemExit as error:
        raise RuntimeError(f"sys.exit({error.code!r}) was called") from error
    except BrokenPipeError as error:
        if _frames(error)[-1][0].startswith("click"):  # the reader closed the output pipe
            raise click.exceptions.Exit(ExitStatus.UNREAD) from None
        raise RuntimeError("a pipe broke") from error


def _frames(error: BaseException) -> list[tuple[str, int]]:
    """Module and line of each call in the traceback of an error."""
    steps = traceback.walk_tb(error.__traceback__)
    return [(str(frame.f_globals.get("__name__", "?")), line) for frame, line in steps]


@contextlib.contextmanager
def own_process() -> Iterator[None]:
    """Process-wide settings of the `impc` program; not for commands called from Python.

    The first interruption stops the work cleanly, a second one ends the process at once. With
    IMPC_STOP_WITH_INPUT=1 the end of stdin is one: a program that starts impc holds a pipe, and no
    run outlives it. Library messages about threads and about objects being deleted are hidden.
    """
    import threading  # noqa: PLC0415

    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # escape characters that the encoding lacks
            stream.reconfigure(errors="backslashreplace")
    sys.unraisablehook = lambda _: None
    threading.excepthook = lambda _: None
    with contextlib.suppress(ValueError):  # not the main thread
        signal.signal(signal.SIGINT, _interrupt)
        # Ignored during exit: Python would otherwise die of the signal instead of returning 130.
        atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)
        if os.environ.get("IMPC_STOP_WITH_INPUT", "") == "1":
            threading.Thread(target=_interrupt_with_input, daemon=True).start()
    yield
    with contextlib.suppress(OSError, ValueError, AttributeError):
        sys.stdout.flush()
        return
    # Otherwise the interpreter flushes again at exit and prints the failure.
    with contextlib.suppress(OSError, ValueError, AttributeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _interrupt_with_input() -> None:
    """Wait for the end of stdin, then interrupt, and end the process if that does not."""
    with contextlib.suppress(OSError):  # no stdin
        while os.read(0, 1):  # not sys.stdin: its lock would block the exit
            pass
    if os.name == "posix":  # to the process: also ends a system call that waits
        os.kill(os.getpid(), signal.SIGINT)
    else:
        signal.raise_signal(signal.SIGINT)
    # An interruption within a lock of Python's thread pools leaves it taken: 1 of 8 runs waited on.
    time.sleep(_PATIENCE)
    os._exit(ExitStatus.INTERRUPTED)


def _interrupt(_signum: int, _frame: object) -> None:
    """Raise at the first interruption; the second ends the process."""
    signal.signal(signal.SIGINT, _end_at_once)
    raise KeyboardInterrupt


def _end_at_once(_signum: int, _frame: object) -> None:
    if not _SAID:
        os.write(2, b"impc: interrupted twice; stopped at once\n")
    os._exit(ExitStatus.INTERRUPTED)


# The line that this process has printed, if any: it prints only one.
_SAID: list[str] = []


def _say(message: str, status: ExitStatus) -> ExitStatus:
    line = f"impc: {one_line(message)}"
    _SAID.append(line)
    with contextlib.suppress(OSError, ValueError):  # stderr is full or closed
        click.echo(line, err=True)
    return status


def _defect(error: BaseException, heard: list[str]) -> ExitStatus:
    what = "out of memory" if isinstance(error, MemoryError) else f"{type(error).__name__}: "
    text = one_line(error, 200)
    frames = _frames(error)
    ours = [place for place in frames if place[0].partition(".")[0] in ("impc", "plants")]
    name, line = (ours or frames)[-1]
    place = f"{name}, line {line}"
    found = f"defect: {what}{text} ({place}); {_logged(error, heard)}"
    return _say(found, ExitStatus.DEFECT)


def _logged(error: BaseException, heard: list[str]) -> str:
    """Write the traceback to a log that only the user can read; return the text that names it."""
    import platform  # noqa: PLC0415  # --help needs none of these
    import tempfile  # noqa: PLC0415

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
    except Exception as fault:  # full disk or memory: the line is printed without a log
        if path:
            with contextlib.suppress(OSError):
                os.remove(path)
        return f"no log could be written ({one_line(fault, 100)})"
    return f"please report it with {path}"


@contextlib.contextmanager
def _quiet(heard: list[str]) -> Iterator[None]:
    """Collect warnings of libraries for the log; warnings set to errors are still raised."""
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: heard.append(f"{record.name}: {record.getMessage()}")  # type: ignore[method-assign]
    logging.getLogger().addHandler(handler)
    logging.captureWarnings(True)
    try:
        yield
    finally:
        logging.captureWarnings(False)
        logging.getLogger().removeHandler(handler)
