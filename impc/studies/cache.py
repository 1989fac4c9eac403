"""Results in a folder, one JSON file each, computed once: who is interrupted goes on from there.

    {"sha256": ..., "content": ..., "digest": ..., "name": ...}

`name` says which result it is, `digest` of which recordings, plant, settings and versions
(`impc.files.digests`), and `sha256` is that of all that follows it. What was damaged, edited,
renamed or copied, or belongs to another digest, is not used: it is computed again.
"""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec

from impc.arrays import frozen
from impc.errors import OutputError
from impc.files.disk import remove_empty, write_whole

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")

_UNSAFE = re.compile(r"[^A-Za-z0-9+._/-]")
_SEAL = b'{"sha256": "%s", '
_SEALED = len(_SEAL % (b"0" * 64))


def to_json(value: Any) -> Any:
    """A dataclass, or a mapping, as its fields; arrays as lists."""
    return msgspec.to_builtins(value, enc_hook=lambda array: array.tolist())


def from_json(content: Any, kind: type[T]) -> T:
    """The dataclass of that `kind`, from what `to_json` made of it."""
    return msgspec.convert(content, kind, dec_hook=lambda _, array: frozen(array))


@dataclass(frozen=True)
class Cache:
    """Results by name, in a folder."""

    folder: Path  # Made when the first result is kept

    def path(self, name: str) -> Path:
        """The file of the result `name`; a slash in it makes a folder."""
        return Path(f"{self.folder}/{_UNSAFE.sub('-', name)}.json")

    def find(self, name: str, digest: str) -> Any:
        """The content kept under that `name` and `digest`; None where there is none to use."""
        found = _unsealed(self.path(name))
        if found is None or (found["name"], found["digest"]) != (name, digest):
            return None
        return found["content"]

    def keep(self, name: str, digest: str, content: Any) -> None:
        """Write a result down: its `name`, its `content`, the `digest` of its origin."""
        body = {"content": content, "digest": digest, "name": name}
        text = json.dumps(body).encode()[1:] + b"\n"
        seal = hashlib.sha256(text).hexdigest().encode()
        # Cut short by a power failure it is computed again; a flush takes a disk 1 to 20 ms.
        write_whole(self.path(name), _SEAL % seal + text, flush=False)

    def discard(self, name: str) -> None:
        """Remove the result of that `name`, if there is one."""
        try:
            self.path(name).unlink(missing_ok=True)
        except OSError as error:
            raise _unremovable(f"file {self.path(name)}", error) from None

    def forget(self) -> None:
        """Remove what was kept: the final results have been written. Files of others stay."""
        try:
            for path in self.folder.rglob("*.json"):
                found = _unsealed(path)
                if found is not None and self.path(found["name"]) == path:
                    path.unlink()
            remove_empty(self.folder)
        except OSError as error:
            raise _unremovable(f"folder {self.folder}", error) from None


def _unsealed(path: Path) -> dict[str, Any] | None:
    """What a sealed file holds; None where there is none, or its seal is broken."""
    try:
        if not path.is_file():  # a pipe would be waited for
            return None
        text = path.read_bytes()
    except OSError:
        return None
    seal = hashlib.sha256(text[_SEALED:]).hexdigest().encode()
    if text[:_SEALED] != _SEAL % seal:
        return None
    found: dict[str, Any] = json.loads(b"{" + text[_SEALED:])
    return found


def _unremovable(subject: str, error: OSError) -> OutputError:
    return OutputError(subject, f"cannot be removed ({error.strerror})", "remove it")


@dataclass(frozen=True)
class Steps:
    """Results of a command that come one after the other, all with one digest."""

    cache: Cache
    digest: str
    done: Callable[[str], None] = lambda _: None  # Told the name of each result when it is there
    names: list[str] = field(default_factory=list)  # Of those that are there

    def get(
        self,
        name: str,
        compute: Callable[[], T],
        decode: Callable[[Any], T],
        encode: Callable[[T], Any] = to_json,
    ) -> T:
        """The result `name`, from the folder or computed now and then written down."""
        content = self.cache.find(name, self.digest)
        if content is None:
            found = compute()
            self.cache.keep(name, self.digest, encode(found))
        else:
            found = decode(content)
        self.names.append(name)
        self.done(name)
        return found

    def kept(self) -> str:
        """The message for a user who interrupts the command."""
        if not self.names:
            return "nothing was done yet"
        done = ", ".join(self.names)
        return f"kept in {self.cache.folder}: {done}; the same command goes on from there"
