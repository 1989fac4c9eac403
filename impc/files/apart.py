"""Files read in a process of their own, with a limit on memory and time.

HDF5 and scipy's reader of MATLAB 5 are compiled, and nptdms and c3d take what a header says: a
damaged file can end their process, fill the memory, or never end. One process serves a whole run:
it starts with the first file, by the one interpreter and none of the user's modules, and is
replaced when a file ends it. Requests and answers are pickles in its pipes, and it ends when they
close.
"""

from __future__ import annotations

import atexit
import contextlib
import faulthandler
import math
import os
import pickle
import re
import signal
import subprocess
import sys
import threading
from importlib import import_module
from pathlib import Path
from typing import Any

from impc.errors import DataError, ImpcError, InputError, brief
from impc.files.disk import damaged
from impc.files.table import Table

#: Module, function and library of each format that is read here.
READERS = {
    "matlab": ("impc.files.matlab", "read_matlab", "scipy.io"),
    "matrices": ("impc.files.matlab", "read_matrices", "scipy.io"),
    "matlab73": ("impc.files.matlab73", "read_matlab73", "h5py"),
    "tdms": ("impc.files.recorders", "read_tdms", "nptdms"),
    "c3d": ("impc.files.recorders", "read_c3d", "c3d"),
    "spreadsheet": ("impc.files.spreadsheet", "read_spreadsheet", "python_calamine"),
    "cells": ("impc.files.spreadsheet", "read_cells", "python_calamine"),
}
# Seconds of computing that a file may take: measured, 1.5 s for 100 MB of HDF5 and 6 s for a C3D
# of 10 MB (60 000 frames), which is the slowest.
_SECONDS, _SECONDS_A_MEGABYTE = 10, 2
# Bytes that reading may take: a reader holds the file's arrays up to three times.
_ROOM, _ROOM_A_BYTE = 800_000_000, 3
# Where the system bounds no address space, the size is looked at this often, in seconds.
_LOOK = 0.02
_BOUNDED = sys.platform == "linux"
# -P: never from the folder in which the command was typed. The package is the one that is running.
_START = """
import sys
try:
    sys.path.insert(0, sys.argv[1]); import impc; del sys.path[0]
    from impc.files.apart import serve; serve()
except BaseException:
    sys.exit(3)
"""
_ENVIRONMENT = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "HDF5_PLUGIN_PRELOAD": "::",  # a file may name a filter; none is loaded from a folder
}
_KILLED = getattr(signal, "SIGKILL", 9)
_lock = threading.Lock()
# By the process that started it: a fork has one of its own.
_children: dict[int, subprocess.Popen[bytes]] = {}


def read_apart(kind: str, path: Path, largest: int, sheet: str = "") -> Table:
    """Read the file at `path` in a process of its own: `kind` is a key of `READERS`.

    Its arrays take `largest` bytes at most; `sheet` is that of a workbook, where one is asked for.
    """
    given = (path.absolute(), largest, sheet) if sheet else (path.absolute(), largest)
    found = _read(path, kind, *given)
    if found.rate is not None and not 0 < found.rate < math.inf:
        problem = f"says {found.rate:g} samples per second"
        raise DataError(str(path), problem, "export it again with its rate")
    for values in found.columns.values():
        values.flags.writeable = False
    return Table(str(path), found.columns, found.units, found.rate, found.skipped, found.notes)


def matrices_apart(path: Path, largest: int) -> dict[str, Any]:
    """What a .mat file of version 5 to 7 at `path` holds of a saved plant, by name.

    Real arrays, (rows, columns) or more, of `largest` bytes at most, and lists of text.
    """
    try:
        found: dict[str, Any] = _read(path, "matrices", path.absolute(), largest)
    except DataError as error:
        raise InputError(f"plant {path}", error.problem, error.remedy) from None
    return found


def cells_apart(path: Path, largest: int) -> list[list[str]]:
    """The rows of the first sheet of the workbook at `path`, cells as texts.

    It may unpack to `largest` bytes.
    """
    found: dict[str, list[list[str]]] = _read(path, "cells", path.absolute(), largest)
    return found["cells"]


def match_apart(subject: str, pattern: str, text: str) -> dict[str, str | None] | None:
    """The named groups of a `pattern` that matches a whole `text`; None when it does not.

    Some patterns of users, such as ``(a+)+x``, take longer than anybody lives; `subject` is for the
    message.
    """
    try:
        found: dict[str, str | None] | None = _asked(subject, "match", (pattern, text), 0)
    except DataError:
        problem = f"cannot be matched with {text[:80]!r} in {_SECONDS} s"
        raise InputError(subject, problem, "write no repetition within a repetition") from None
    return found


def _read(path: Path, kind: str, *given: Any) -> Any:
    """What the reader of a `kind` returns; messages name the file as it was given."""
    try:
        return _asked(str(path), kind, given, path.stat().st_size)
    except ImpcError as error:
        subject = error.subject.replace(str(path.absolute()), str(path), 1)
        raise DataError(subject, brief(error.problem, 300), error.remedy) from None


def _asked(source: str, kind: str, given: tuple[Any, ...], size: int) -> Any:
    """The answer of the process that is there, or of a new one."""
    room, seconds = _ROOM + _ROOM_A_BYTE * size, _SECONDS + _SECONDS_A_MEGABYTE * size // 1_000_000
    done = threading.Event()
    with _lock:
        child = _running(source)
        assert child.stdin is not None
        assert child.stdout is not None
        if not _BOUNDED:
            threading.Thread(target=_watch, args=(child.pid, room, done), daemon=True).start()
        try:
            pickle.dump((kind, given, room, seconds), child.stdin)
            child.stdin.flush()
            found = pickle.load(child.stdout)
        except (EOFError, OSError):
            found = _why(source, kind, _ended(), room, seconds)
        except BaseException:  # interrupted: its answer would be taken for the next one's
            _ended()
            raise
        finally:
            done.set()
        if isinstance(found, MemoryError):
            found = _why(source, kind, -_KILLED, room, seconds)
            _ended()
    if isinstance(found, Exception):
        raise found
    return found


def _watch(pid: int, room: int, done: threading.Event) -> None:
    """End a process that grows too large, where the system does not see to it."""
    import psutil  # noqa: PLC0415  # not on Linux

    with contextlib.suppress(psutil.Error):
        process = psutil.Process(pid)
        most = process.memory_info().rss + room
        while not done.wait(_LOOK):
            if process.memory_info().rss > most:
                process.kill()


def _running(source: str) -> subprocess.Popen[bytes]:
    """The process that is there, or a new one."""
    child = _children.get(os.getpid())
    if child is not None and child.poll() is None:
        return child
    _ended()
    try:
        _children[os.getpid()] = subprocess.Popen(
            [sys.executable, "-P", "-c", _START, str(Path(__file__).parents[2])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **_ENVIRONMENT},
        )
    except OSError as error:
        reason = error.strerror or type(error).__name__
        problem = f"the process that reads it cannot be started ({reason})"
        raise DataError(source, problem, f"check that {sys.executable} can run") from None
    return _children[os.getpid()]


@atexit.register
def _ended() -> int:
    """End the process that is there; what it ended with."""
    child = _children.pop(os.getpid(), None)
    if child is None:
        return 0
    child.kill()
    with contextlib.suppress(OSError):
        child.communicate()
    return child.wait()


def _why(source: str, kind: str, status: int, room: int, seconds: int) -> DataError:
    """Why a process ended, and what to do."""
    again = "copy or export it again"
    if status in (-getattr(signal, "SIGXCPU", 0), 1):  # 1: `faulthandler` ended it
        return DataError(source, f"takes longer than {seconds} s to read: it is damaged", again)
    # Libraries in Rust abort where they are given no more memory.
    rust = READERS.get(kind, ("",))[-1] == "python_calamine"
    if status == -_KILLED or (rust and status == -signal.SIGABRT):
        problem = f"takes more than {room / 1e9:.1f} GB to read"
        return DataError(source, problem, "save only the signals and seconds that are needed")
    name = signal.Signals(-status).name if status < 0 else f"status {status}"
    return DataError(source, f"is damaged and ends the process that reads it ({name})", again)


def serve() -> None:
    """Answer requests until the input ends; in the process that reads."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # whoever asks is interrupted, and ends this
    # What libraries print must not stand among the answers.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    while True:
        try:
            kind, given, room, seconds = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        for module in READERS.get(kind, ())[::2]:  # so that its limits are for the file alone
            with contextlib.suppress(ImportError):  # the reader says so
                import_module(module)
        _limit(room, seconds)
        found = _found(kind, given)
        faulthandler.cancel_dump_traceback_later()
        pickle.dump(found, answers, protocol=pickle.HIGHEST_PROTOCOL)
        answers.flush()


def _limit(room: int, seconds: int) -> None:
    """No more than so much memory and so many seconds, whatever a library does.

    Seconds are of computing, so that a busy machine changes no verdict; a file that makes its
    library wait is ended by the clock after ten times as long.
    """
    faulthandler.dump_traceback_later(10 * seconds, exit=True)
    if sys.platform == "win32":
        return
    import resource  # noqa: PLC0415  # not on Windows

    used = sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
    limits = {resource.RLIMIT_CORE: 0, resource.RLIMIT_CPU: math.ceil(used) + seconds}
    if _BOUNDED:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        limits[resource.RLIMIT_AS] = pages * os.sysconf("SC_PAGE_SIZE") + room
    for kind, most in limits.items():
        hard = resource.getrlimit(kind)[1]
        resource.setrlimit(kind, (most if hard < 0 else min(most, hard), hard))


def _found(kind: str, given: tuple[Any, ...]) -> Any:
    """What a reader returns, or the error that it raises."""
    try:
        if kind == "match":
            match = re.fullmatch(*given)
            return None if match is None else match.groupdict()
        module, function, _ = READERS[kind]
        return getattr(import_module(module), function)(*given)
    except (ImpcError, MemoryError) as error:
        return error.with_traceback(None)
    # The libraries meet damaged files with any exception: struct.error, KeyError, AssertionError.
    except Exception as error:
        return damaged(str(given[0]), error)
