"""Fits in processes of their own, one after the other: each is the command that its page shows.

The process ends with its input (IMPC_STOP_WITH_INPUT): closing the pipe stops a fit as Ctrl-C does,
and a server that ends in whatever way leaves no fit behind. Fits of several servers of one user
wait for each other by a locked folder.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

from impc.cli.ending import ExitStatus
from impc.errors import OutputError
from impc.jit import cache_home
from impc.reporting.writer import owned

# Seconds between two attempts to lock the folder.
_AGAIN = 0.5


class State(Enum):
    """State of a fit, in words for pages."""

    WAITING = "Waiting"
    RUNNING = "Running"
    DONE = "Finished"
    STOPPED = "Stopped"
    REFUSED = "Not possible"
    FAILED = "Failed"


_ENDS = {
    ExitStatus.DONE: State.DONE,
    ExitStatus.BAD_INPUT: State.REFUSED,
    ExitStatus.INTERRUPTED: State.STOPPED,
}


@dataclass
class Fit:
    """One fit: what its process has reported so far."""

    words: tuple[str, ...]  # The command
    out: Path  # Folder of its results
    state: State = State.WAITING
    done: list[str] = field(default_factory=list)  # Titles of finished stages
    total: int = 0
    left: float | None = None  # s
    said: str = ""  # Last line that is no progress: the error, or what an interruption kept
    began: float = 0.0
    ended: float = 0.0
    _stop: threading.Event = field(default_factory=threading.Event)
    _process: subprocess.Popen[str] | None = None

    @property
    def over(self) -> bool:
        """Whether nothing more will happen."""
        return self.state not in (State.WAITING, State.RUNNING)

    @property
    def seconds(self) -> int:
        """Time since it began, without waiting."""
        return round((self.ended or time.monotonic()) - self.began) if self.began else 0

    def stop(self) -> None:
        """Stop as Ctrl-C does, finished stages are kept; the second time at once."""
        again = self._stop.is_set()
        self._stop.set()
        if self._process is not None:
            if again:
                self._process.kill()
            self._close()

    def _close(self) -> None:
        assert self._process is not None
        assert self._process.stdin is not None  # a pipe
        with contextlib.suppress(OSError):
            self._process.stdin.close()

    def run(self) -> None:
        """Wait for other fits of this user, run the command, and listen to it."""
        with _turn(self._stop) as ours:
            if not ours:
                self.state = State.STOPPED
                return
            self.began, self.state = time.monotonic(), State.RUNNING
            try:
                status = self._run()
            except OSError as error:  # no memory or disk for a process
                status, self.said = -1, str(error)
            self.ended = time.monotonic()
            failed = State.STOPPED if self._stop.is_set() else State.FAILED
            self.state = next((end for code, end in _ENDS.items() if code == status), failed)

    def _run(self) -> int:
        """Exit status of the command."""
        given = {"IMPC_PROGRESS": "json", "IMPC_STOP_WITH_INPUT": "1", "IMPC_QUIET": "",
                 "PYTHONIOENCODING": "utf-8:backslashreplace"}  # fmt: skip
        # -P: the working folder may hold files called impc.py or numpy.py.
        with subprocess.Popen(
            [sys.executable, "-P", "-m", "impc", *self.words[1:], "--yes"],
            stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
            encoding="utf-8", errors="replace", env=os.environ | given,
        ) as self._process:  # fmt: skip
            if self._stop.is_set():  # meanwhile
                self._close()
            assert self._process.stderr is not None  # a pipe
            for line in self._process.stderr:
                self._hear(line.strip())
            return self._process.wait()

    def _hear(self, line: str) -> None:
        try:
            event: dict[str, Any] = json.loads(line)
            count, self.total, self.left = int(event["done"]), int(event["total"]), event["left"]
            if count:
                self.done.append(str(event["title"]))
        except (ValueError, TypeError, KeyError):
            self.said = line.removeprefix("impc: ") or self.said


class Fits:
    """The fits of one server, in the order in which they were asked for."""

    def __init__(self) -> None:
        self._turns = ThreadPoolExecutor(1)
        self._last: dict[Path, Fit] = {}

    def start(self, words: Sequence[str], out: Path) -> None:
        """Queue the command that writes to `out`, unless it is queued or running."""
        known = self._last.get(out.parent)
        if known is None or known.over:
            self._last[out.parent] = Fit(tuple(words), out)
            self._turns.submit(self._last[out.parent].run)

    def of(self, folder: Path) -> Fit | None:
        """The last fit with results in a `folder`."""
        return self._last.get(folder)

    def before(self, fit: Fit) -> int:
        """Number of fits of this server that come before one."""
        open_ones = [one for one in self._last.values() if not one.over]
        return open_ones.index(fit) if fit in open_ones else 0

    def stop(self) -> None:
        """Stop all, as the server ends."""
        for one in self._last.values():
            one.stop()


@contextlib.contextmanager
def _turn(stop: threading.Event) -> Iterator[bool]:
    """Hold the lock of this user's fits; false if `stop` was set before."""
    folder = cache_home() / "impc" / "fits"
    with contextlib.ExitStack() as held:
        while not stop.is_set():
            try:
                held.enter_context(owned(folder, "app"))
                break
            except OutputError:
                if not os.access(folder, os.W_OK):  # no such folder can be made: fit at once
                    break
                stop.wait(_AGAIN)
        yield not stop.is_set()
