"""Read files in a separate process with limits on memory and computing time.

The format libraries are compiled or trust file headers: a damaged file can crash the process, fill
the memory or never end. One process serves a whole run. It imports none of the user's modules, is
replaced when a file ends it, and exchanges pickles through its pipes.
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

#: Module, function and library of each format that is read in the separate process.
READERS = {
    "matlab": ("impc.files.matlab", "read_matlab", "scipy.io"),
    "matrices": ("impc.files.matlab", "read_matrices", "scipy.io"),
    "matlab73": ("impc.files.matlab", "read_matlab73", "h5py"),
    "tdms": ("impc.files.recorders", "read_tdms", "nptdms"),
    "c3d": ("impc.files.recorders", "read_c3d", "c3d"),
    "spreadsheet": ("impc.files.spreadsheet", "read_spreadsheet", "python_calamine"),
    "cells": ("impc.files.spreadsheet", "read_cells", "python_calamine"),
}
# CPU seconds allowed for a file. Measured: 1.5 s for 100 MB of HDF5, 6 s for 10 MB of C3D.
_SECONDS, _SECONDS_A_MEGABYTE = 10, 2
# Bytes of memory allowed for a file: a reader holds its arrays up to three times.
_ROOM, _ROOM_A_BYTE = 800_000_000, 3
# Interval in s at which the process size is checked where the system cannot limit it.
_LOOK = 0.02
_BOUNDED = sys.platform == "linux"
# -P: do not import from the current folder; argv[1] is the folder of the running package.
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
# By process id of the parent: a forked process starts its own reader.
_children: dict[int, subprocess.Popen[bytes]] = {}


def read_apart(kind: str, path: Path, largest: int, sheet: str = "") -> Table:
    """Read `path` with reader `kind` (a key of `READERS`); arrays take at most `largest` bytes."""
    given = (path.absolute(), largest, sheet) if sheet else (path.absolute(), largest)
    found = _read(path, kind, *given)
    if found.rate is not None and not 0 < found.rate < math.inf:
        problem = f"states a rate of {found.rate:g} samples per second"
        raise DataError(str(path), problem, "export it again with its sampling rate")
    for values in found.columns.values():
        values.flags.writeable = False
    return Table(str(path), found.columns, found.units, found.rate, found.skipped, found.notes)


def matrices_apart(path: Path, largest: int) -> dict[str, Any]:
    """Numeric arrays and lists of text in a .mat file (version 5 to 7) with a saved plant."""
    try:
        found: dict[str, Any] = _read(path, "matrices", path.absolute(), largest)
    except DataError as error:
        raise InputError(f"plant {path}", error.problem, error.remedy) from None
    return found


def cells_apart(path: Path, largest: int) -> list[list[str]]:
    """Rows of the first sheet of a workbook as text; it may unpack to `largest` bytes."""
    found: dict[str, list[list[str]]] = _read(path, "cells", path.absolute(), largest)
    return found["cells"]


def match_apart(subject: str, pattern: str, text: str) -> dict[str, str | None] | None:
    """Named groups of a `pattern` that matches the whole `text`; None without a match.

    Runs apart because patterns such as ``(a+)+x`` need exponential time; `subject` is for messages.
    """
    try:
        found: dict[str, str | None] | None = _asked(subject, "match", (pattern, text), 0)
    except DataError:
        problem = f"cannot be matched with {text[:80]!r} in {_SECONDS} s"
        error = InputError(subject, problem, "remove nested repetitions such as (a+)+")
        raise error.at("", *subject.split(".")) from None
    return found


def _read(path: Path, kind: str, *given: Any) -> Any:
    """Result of reader `kind`; error messages name the file as the user gave it."""
    try:
        return _asked(str(path), kind, given, path.stat().st_size)
    except ImpcError as error:
        subject = error.subject.replace(str(path.absolute()), str(path), 1)
        said = DataError(subject, brief(error.problem, 300), error.remedy)
        raise said.at(str(path), *error.place) from None


def _asked(source: str, kind: str, given: tuple[Any, ...], size: int) -> Any:
    """Send a request to the reader process (started if needed) and return its answer."""
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
        except BaseException:  # interrupted: its late answer would be taken for the next one's
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
    """Kill a process that outgrows `room` bytes, on systems without a memory limit."""
    import psutil  # noqa: PLC0415  # not on Linux

    with contextlib.suppress(psutil.Error):
        process = psutil.Process(pid)
        most = process.memory_info().rss + room
        while not done.wait(_LOOK):
            if process.memory_info().rss > most:
                process.kill()


def _running(source: str) -> subprocess.Popen[bytes]:
    """Return the reader process; start one if there is none."""
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
    """End the reader process and return its exit status."""
    child = _children.pop(os.getpid(), None)
    if child is None:
        return 0
    child.kill()
    with contextlib.suppress(OSError):
        child.communicate()
    return child.wait()


def _why(source: str, kind: str, status: int, room: int, seconds: int) -> DataError:
    """Error that explains why the reader process ended, with a remedy."""
    again = "copy or export it again"
    if status in (-getattr(signal, "SIGXCPU", 0), 1):  # 1: `faulthandler` ended it
        return DataError(source, f"takes longer than {seconds} s to read; probably damaged", again)
    # Rust libraries abort if an allocation fails.
    rust = READERS.get(kind, ("",))[-1] == "python_calamine"
    if status == -_KILLED or (rust and status == -signal.SIGABRT):
        problem = f"takes more than {room / 1e9:.1f} GB to read"
        return DataError(source, problem, "save only the signals and seconds that are needed")
    name = signal.Signals(-status).name if status < 0 else f"status {status}"
    return DataError(source, f"is damaged and ends the process that reads it ({name})", again)


def serve() -> None:
    """Answer requests until the input ends (runs in the reader process)."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C and ends this process
    # Keep what libraries print out of the pipe with the answers.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    while True:
        try:
            kind, given, room, seconds = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        for module in READERS.get(kind, ())[::2]:  # imports must not count towards the limits
            with contextlib.suppress(ImportError):  # reported by the reader
                import_module(module)
        _limit(room, seconds)
        found = _found(kind, given)
        faulthandler.cancel_dump_traceback_later()
        pickle.dump(found, answers, protocol=pickle.HIGHEST_PROTOCOL)
        answers.flush()


def _limit(room: int, seconds: int) -> None:
    """Limit memory, and computing time in s; wall-clock time to ten times as long.

    CPU seconds keep the result independent of the machine's load.
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
    """Return the result of a reader, or the error that it raised."""
    try:
        if kind == "match":
            match = re.fullmatch(*given)
            return None if match is None else match.groupdict()
        module, function, _ = READERS[kind]
        return getattr(import_module(module), function)(*given)
    except (ImpcError, MemoryError) as error:
        return error.with_traceback(None)
    # With damaged files the libraries raise anything: struct.error, KeyError, AssertionError.
    except Exception as error:
        return damaged(str(given[0]), error)
