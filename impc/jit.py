"""numba's `njit` with a safe cache.

numba detects changes in the file of a function, but not in those of functions that it calls.
Compiled code is therefore kept in a folder named by the digest of all compiled sources: in
NUMBA_CACHE_DIR, else next to the package, or in the user's cache folder; if neither is writable, in
a private temporary folder, or nowhere. Below it, modules are found by name, so that a checkout can
be copied or moved; numba compares the contents of their sources. Cached code is executed as it is
read: a folder that another user could have made or can write to is never used, nor one named by a
file of the working folder (docs/howto/speed.md).
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import logging
import os
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from impc.settings_files import ignore_settings_files

F = TypeVar("F", bound="Callable[..., Any]")


def njit(**options: Any) -> Callable[[F], F]:
    """`numba.njit` with `options`; without a cache if there is no folder for it."""
    ignore_settings_files("numba")
    import numba  # noqa: PLC0415  # takes 0.25 s; `keep_caches` does not need it

    _listen()

    def decorate(function: F) -> F:
        make: Any = numba.njit
        config: Any = numba.core.config
        before = config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES
        config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES = _compiled(), "impc.cache_locator.ByModule"
        try:
            found: F = make(**{**options, "cache": bool(config.CACHE_DIR)})(function)
        finally:
            config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES = before
        return found

    return decorate


def inner(**options: Any) -> Callable[[F], F]:
    """`njit` of a function that only compiled code calls: nothing is compiled for Python."""
    return njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, **options)


def say_when_compiling(say: Callable[[str], None]) -> None:
    """Call `say`, in place of the logger, once when code is compiled that is not in the cache."""
    _waiting[:] = [say]


_waiting: list[Callable[[str], None]] = [logging.getLogger("impc").info]


@functools.cache
def _listen() -> None:
    """Report once when numba compiles."""
    from numba.core import event  # noqa: PLC0415  # with numba, not before

    class Once(event.Listener):
        def on_start(self, _event: Any) -> None:
            while _waiting:
                _waiting.pop()("compiling once, a minute or two (`impc warm --help`: in advance)")

        def on_end(self, _event: Any) -> None:
            """No output."""

    register: Any = event.register
    register("numba:compile", Once())


@functools.cache
def _compiled() -> str:
    """Cache folder for the current sources; empty if there is none."""
    base, package = _base(), Path(__file__).parent
    if base is None:
        return ""
    digest = hashlib.sha256()
    for path in sorted([Path(__file__), *package.rglob("compiled_*.py")]):
        digest.update(path.read_bytes())
    return str(base / f"compiled-{digest.hexdigest()[:16]}")


def _base() -> Path | None:
    """Parent of the cache folder: from the environment, next to the package, or at home."""
    named = os.environ.get("NUMBA_CACHE_DIR")
    if named:
        return Path(named)
    places = (Path(__file__).parent / "__pycache__", cache_home() / "impc")
    return next((place for place in places if _writable(place)), None)


def keep_caches() -> str:
    """Give numba and matplotlib a cache folder if they have none; return a note or "".

    Call it before either is imported; child processes inherit the folder.
    """
    stated = []
    if _base() is None:
        stated.append("NUMBA_CACHE_DIR")
    if "MPLCONFIGDIR" not in os.environ and not (
        _writable(cache_home() / "matplotlib") and _writable(_config_home() / "matplotlib")
    ):
        stated.append("MPLCONFIGDIR")
    if not stated:
        return ""
    folder = _private_folder()
    if folder is None:
        return "caches are disabled: no folder for them can be written; set TMPDIR to one"
    for name in stated:
        os.environ[name] = str(folder / name.lower())
        (folder / name.lower()).mkdir(exist_ok=True)
    return f"caches are kept in {folder}: home or installation folder cannot be written"


def cache_home() -> Path:
    """Folder of the user for caches."""
    return Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))


def _config_home() -> Path:
    return Path(os.environ.get("XDG_CONFIG_HOME") or os.path.expanduser("~/.config"))


def _writable(folder: Path) -> bool:
    """Whether files can be made in a folder, or the folder can; creates nothing."""
    for place in (folder, *folder.parents):
        if place.is_dir():
            return os.access(place, os.W_OK | os.X_OK)
        if place.exists():
            return False
    return False


def _private_folder() -> Path | None:
    """Temporary folder that only this user can access; None if there is none."""
    import tempfile  # noqa: PLC0415  # seldom needed

    user = os.getuid() if hasattr(os, "getuid") else 0  # Windows: temporary files are private
    try:
        folder = Path(tempfile.gettempdir(), f"impc-{user}")
        with contextlib.suppress(FileExistsError):
            folder.mkdir(mode=0o700)
        found = folder.lstat()
    except OSError:
        return None
    ours = stat.S_ISDIR(found.st_mode) and found.st_uid == user
    return folder if ours and (os.name != "posix" or not found.st_mode & 0o077) else None
