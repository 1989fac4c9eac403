"""Files read in a process of their own, with a limit on memory and time.

HDF5 and scipy's reader of MATLAB 5 are compiled, and nptdms and c3d take what a header says: a
damaged file can end their process, fill the memory, or never end. It is then a process of their own
that ends, and the reason is one line. One such process serves a whole run; it starts with the first
file, and is replaced when it ends. A process that served before and fails is no verdict on a file:
that one is read again by a new one.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.errors import DataError, InputError
from impc.files.table import Table

if TYPE_CHECKING:
    from collections.abc import Iterator

    from impc.arrays import Array

# Seconds of computing that a file may take: measured, 1.5 s for 100 MB of HDF5 and 6 s for a C3D
# of 10 MB (60 000 frames), which is the slowest.
_SECONDS, _SECONDS_A_MEGABYTE = 10, 2
# Bytes that reading may take beside what the process begins with (0.1 GB): a reader holds the
# file's arrays up to three times.
_ROOM, _ROOM_A_BYTE = 800_000_000, 3
# What aborts where it is given no more memory, as libraries in Rust do.
_ABORTS = ("spreadsheet", "cells")
# Where the system bounds no address space, the size is looked at this often, in seconds.
_LOOK = 0.02
_BOUNDED = sys.platform == "linux"
# -P: never from the folder in which the command was typed. The package is the one that is running.
# Status 1 is that of a time that ran out.
_START = """
import sys
try:
    sys.path.insert(0, sys.argv[1]); import impc; del sys.path[0]
    from impc.files.reader_process import main; main()
except BaseException:
    sys.exit(3)
"""
_ENVIRONMENT = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "HDF5_PLUGIN_PRELOAD": "::",  # a file may name a filter; none is loaded from a folder
}


def read_apart(kind: str, path: Path, largest: int, sheet: str = "") -> Table:
    """Read the file at `path` in a process of its own: `kind` is a key of `READERS`.

    Its arrays take `largest` bytes at most; `sheet` is that of a workbook, where one is asked for.
    """
    source = str(path)
    named = {"sheet": sheet} if sheet else {}
    reply, columns = _asked(_request(kind, path, largest) | {"more": named})
    if "refused" in reply:
        raise DataError(*reply["refused"])
    told = reply["table"]
    return Table(
        source,
        dict(zip(told["names"], columns, strict=True)),
        told["units"],
        told["rate"],
        told["skipped"],
        tuple(told["notes"]),
    )


def matrices_apart(path: Path, largest: int) -> dict[str, Any]:
    """What a .mat file of version 5 to 7 at `path` holds of a saved plant, by name.

    Real arrays, (rows, columns) or more, of `largest` bytes at most, and lists of text.
    """
    reply, arrays = _asked(_request("matrices", path, largest))
    if "refused" in reply:
        raise InputError(f"plant {path}", *reply["refused"][1:])
    shapes: dict[str, list[int]] = reply["shapes"]
    matrices = {
        name: array.reshape(shape)
        for (name, shape), array in zip(shapes.items(), arrays, strict=True)
    }
    return {**matrices, **reply["texts"]}


def cells_apart(path: Path, largest: int) -> list[list[str]]:
    """The rows of the first sheet of the workbook at `path`, cells as texts.

    It may unpack to `largest` bytes.
    """
    reply, _ = _asked(_request("cells", path, largest))
    if "refused" in reply:
        raise InputError(*reply["refused"])
    rows: list[list[str]] = reply["texts"]["cells"]
    return rows


def match_apart(subject: str, pattern: str, text: str) -> dict[str, str | None] | None:
    """The named groups of a `pattern` that matches a whole `text`; None when it does not.

    Some patterns of users, such as ``(a+)+x``, take longer than anybody lives; `subject` is for the
    message.
    """
    request = {
        "do": "match",
        "pattern": pattern,
        "text": text,
        "room": _ROOM,
        "seconds": _SECONDS,
        "path": "",
        "source": "",
    }
    reply, _ = _asked(request)
    if "refused" in reply:
        problem = f"cannot be matched with {text[:80]!r} in {_SECONDS} s"
        raise InputError(subject, problem, "write no repetition within a repetition")
    groups: dict[str, str | None] | None = reply["groups"]
    return groups


@dataclass
class _Process:
    """A process that reads; `served` says whether it has answered before."""

    popen: subprocess.Popen[bytes]
    owner: int = field(default_factory=os.getpid)
    served: bool = False

    def ask(self, request: dict[str, Any]) -> tuple[dict[str, Any], list[Array]]:
        """Send a request and wait for its answer."""
        assert self.popen.stdin is not None
        with _watched(self.popen, request["room"]):
            self.popen.stdin.write(json.dumps(request).encode("ascii") + b"\n")
            self.popen.stdin.flush()
            length = int.from_bytes(self._bytes(8), "little")
            reply = json.loads(self._bytes(length))
            columns = [self._column(length) for length in reply.get("lengths", ())]
        self.served = True
        return reply, columns

    def _column(self, samples: int) -> Array:
        return np.frombuffer(self._bytes(8 * samples), dtype=np.float64)  # read-only, as bytes are

    def _bytes(self, size: int) -> bytes:
        assert self.popen.stdout is not None
        found = self.popen.stdout.read(size)
        if len(found) < size:
            raise EOFError
        return found

    def end(self) -> int:
        """End it; what it ended with."""
        if self.owner != os.getpid():  # a fork of whoever started it
            return 0
        if self.popen.poll() is None:
            self.popen.kill()
        with contextlib.suppress(OSError):
            self.popen.communicate()
        return self.popen.wait()


_lock = threading.Lock()
_current: list[_Process] = []


def _asked(request: dict[str, Any]) -> tuple[dict[str, Any], list[Array]]:
    """The answer of the process that is there, or of a new one."""
    with _lock:
        while True:
            try:
                process = _running()
            except OSError as error:
                reason = error.strerror or type(error).__name__
                problem = f"the process that reads it cannot be started ({reason})"
                return _refusal(request, problem, f"check that {sys.executable} can run"), []
            served = process.served
            try:
                reply, columns = process.ask(request)
            except (EOFError, OSError):
                reply = _refusal(request, *_why(_replaced(process), request))
            except BaseException:  # interrupted: its answer would be taken for the next one's
                _replaced(process)
                raise
            else:
                if "memory" not in reply:
                    return reply, columns
                _replaced(process)
                reply = _refusal(request, *_too_large(request))
            if not served:
                return reply, []


def _request(kind: str, path: Path, largest: int) -> dict[str, Any]:
    size = path.stat().st_size
    return {
        "do": kind,
        "path": str(path.absolute()),
        "source": str(path),
        "largest": largest,
        "room": _ROOM + _ROOM_A_BYTE * size,
        "seconds": _SECONDS + _SECONDS_A_MEGABYTE * size // 1_000_000,
    }


def _refusal(request: dict[str, Any], problem: str, remedy: str) -> dict[str, Any]:
    return {"refused": [request["source"], problem, remedy]}


def _running() -> _Process:
    """The process that is there, or a new one; OSError where none can be started."""
    if _current and _current[0].owner != os.getpid():
        _current.clear()
    if not _current:
        popen = subprocess.Popen(
            [sys.executable, "-P", "-c", _START, str(Path(__file__).parents[2])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **_ENVIRONMENT},
        )
        _current.append(_Process(popen))
    return _current[0]


def _replaced(process: _Process) -> int:
    """End a process so that the next request starts another."""
    _current.clear()
    return process.end()


@atexit.register
def _end() -> None:
    for process in _current:
        process.end()


def _why(status: int, request: dict[str, Any]) -> tuple[str, str]:
    """Why a process ended, and what to do."""
    again = "copy or export it again"
    if status == -getattr(signal, "SIGXCPU", 0) or status == 1:
        return f"takes longer than {request['seconds']} s to read: it is damaged", again
    aborted = status == -getattr(signal, "SIGABRT", 6) and request["do"] in _ABORTS
    if aborted or status == -getattr(signal, "SIGKILL", 9):
        return _too_large(request)
    name = signal.Signals(-status).name if status < 0 else f"status {status}"
    return f"is damaged and ends the process that reads it ({name})", again


def _too_large(request: dict[str, Any]) -> tuple[str, str]:
    return (
        f"takes more than {request['room'] / 1e9:.1f} GB to read",
        "save only the signals and seconds that are needed",
    )


@contextlib.contextmanager
def _watched(popen: subprocess.Popen[bytes], room: int) -> Iterator[None]:
    """End a process that grows too large, where the system does not see to it."""
    if _BOUNDED:
        yield
        return
    import psutil  # noqa: PLC0415

    done = threading.Event()

    def watch() -> None:
        with contextlib.suppress(psutil.Error):
            process = psutil.Process(popen.pid)
            most = process.memory_info().rss + room
            while not done.wait(_LOOK):
                if process.memory_info().rss > most:
                    popen.kill()
                    return

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
