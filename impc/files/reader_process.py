"""The process that reads files by libraries which a damaged file may end, or make take all memory.

It is started by `impc.files.apart` and serves one request after another: a line of JSON comes in,
eight bytes of length, JSON and arrays of float64 go out. It ends when its input ends, when a
request takes too long, and after a request that needed too much memory.
"""

from __future__ import annotations

import contextlib
import faulthandler
import json
import math
import os
import re
import signal
import sys
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from impc.errors import ImpcError, brief
from impc.files.names import damaged
from impc.files.units import is_unit

if TYPE_CHECKING:
    from collections.abc import Iterable
    from typing import BinaryIO

    from impc.arrays import Array
    from impc.files.table import Table

#: Module, function and library of each format that is read here.
READERS = {
    "matlab": ("impc.files.matlab", "read_matlab", "scipy.io"),
    "matrices": ("impc.files.matlab", "read_matrices", "scipy.io"),
    "matlab73": ("impc.files.matlab73", "read_matlab73", "h5py"),
    "tdms": ("impc.files.tdms", "read_tdms", "nptdms"),
    "c3d": ("impc.files.c3d_analog", "read_c3d", "c3d"),
    "spreadsheet": ("impc.files.spreadsheet", "read_spreadsheet", "python_calamine"),
    "cells": ("impc.files.spreadsheet", "read_cells", "python_calamine"),
}
# Address space that a process may keep beyond what it began with: more has leaked.
_LEAK = 100_000_000


def main() -> None:
    """Serve until the input ends."""
    with contextlib.suppress(ValueError):  # not the main thread, in tests
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # whoever asks is interrupted, and ends this
    # What libraries print must not stand among the answers.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    began = 0
    for line in sys.stdin.buffer:
        request = json.loads(line)
        _prepare(request)
        began = began or _address_space()
        _limit(request)
        reply, columns = _answer(request)
        faulthandler.cancel_dump_traceback_later()
        _send(answers, reply, columns)
        if "memory" in reply or _address_space() > began + _LEAK:
            return


def _prepare(request: dict[str, Any]) -> None:
    """Import what the request needs, so that its limits are for the file alone."""
    for module in READERS.get(request["do"], ())[::2]:
        with contextlib.suppress(ImportError):  # the reader says so
            import_module(module)
    if request["do"] == "spreadsheet":
        is_unit("mV")  # its headings have units: pint's registry is no leak


def _limit(request: dict[str, Any]) -> None:
    """No more than so much memory and so many seconds, whatever a library does.

    Seconds are of computing, so that a busy machine changes no verdict; a file that makes its
    library wait is ended by the clock after ten times as long.
    """
    seconds = int(request["seconds"])
    faulthandler.dump_traceback_later(10 * seconds, exit=True)
    try:
        import resource  # noqa: PLC0415  # not on Windows
    except ImportError:
        return
    used = sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
    limits = {"RLIMIT_CORE": 0, "RLIMIT_CPU": math.ceil(used) + seconds}
    if _address_space():
        limits["RLIMIT_AS"] = _address_space() + int(request["room"])
    for name, most in limits.items():
        kind = getattr(resource, name)
        hard = resource.getrlimit(kind)[1]
        resource.setrlimit(kind, (most if hard < 0 else min(most, hard), hard))


def _address_space() -> int:
    """Bytes of address space; 0 where the system does not tell, as it then bounds none."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    except (OSError, ValueError):
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def _answer(request: dict[str, Any]) -> tuple[dict[str, Any], Iterable[Array]]:
    """The reply and its arrays; {"memory": True} for too much, {"refused": ...} for a reason."""
    try:
        if request["do"] == "match":
            found = re.fullmatch(request["pattern"], request["text"])
            return {"groups": None if found is None else found.groupdict()}, ()
        module, function, _ = READERS[request["do"]]
        read = getattr(import_module(module), function)
        found = read(Path(request["path"]), request["largest"], **request.get("more", {}))
    except MemoryError:
        return {"memory": True}, ()
    except ImpcError as error:
        return _refused(request, error), ()
    # The libraries meet damaged files with any exception: struct.error, KeyError, AssertionError.
    except Exception as error:
        return _refused(request, damaged(request["path"], error)), ()
    return _matrices(found) if isinstance(found, dict) else _columns(request, found)


def _columns(request: dict[str, Any], table: Table) -> tuple[dict[str, Any], Iterable[Array]]:
    if table.rate is not None and not (math.isfinite(table.rate) and table.rate > 0):
        problem = f"says {table.rate:g} samples per second"
        return {"refused": [request["source"], problem, "export it again with its rate"]}, ()
    told = {
        "names": list(table.columns),
        "units": dict(table.units),
        "rate": table.rate,
        "skipped": dict(table.skipped),
        "notes": table.notes,
    }
    lengths = [table.samples] * len(table.columns)
    return {"table": told, "lengths": lengths}, table.columns.values()


def _matrices(found: dict[str, Any]) -> tuple[dict[str, Any], Iterable[Array]]:
    """Arrays by their shape, row by row behind the reply; lists of names within it."""
    arrays = {name: value for name, value in found.items() if not isinstance(value, list)}
    reply = {
        "shapes": {name: value.shape for name, value in arrays.items()},
        "texts": {name: value for name, value in found.items() if name not in arrays},
        "lengths": [value.size for value in arrays.values()],
    }
    return reply, [value.ravel() for value in arrays.values()]


def _refused(request: dict[str, Any], error: ImpcError) -> dict[str, Any]:
    """The parts of an error, with the file's name as the user gave it."""
    subject = error.subject.replace(request["path"], request["source"], 1)
    return {"refused": [subject, brief(error.problem, 300), error.remedy]}


def _send(answers: BinaryIO, reply: dict[str, Any], columns: Iterable[Array]) -> None:
    text = json.dumps(reply).encode("ascii")
    answers.write(len(text).to_bytes(8, "little") + text)
    for values in columns:
        answers.write(values.data)
    answers.flush()
