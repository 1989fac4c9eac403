"""Store of intermediate results (JSON files), from which interrupted commands continue.

    {"sha256": ..., "content": ..., "digest": ..., "name": ...}

`digest` identifies recordings, plant, settings and versions (`impc.files.digests`); `sha256` covers
everything after it. Files that are damaged, edited, renamed or of another digest are ignored.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from impc.arrays import frozen
from impc.errors import OutputError
from impc.files.disk import remove_empty, write_whole

T = TypeVar("T")

_UNSAFE = re.compile(r"[^A-Za-z0-9+._/-]")
_SEAL = b'{"sha256": "%s", '
_SEALED = len(_SEAL % (b"0" * 64))


def to_json(value: Any) -> Any:
    """Convert a dataclass or mapping to built-in types; arrays to lists."""
    return msgspec.to_builtins(value, enc_hook=lambda array: array.tolist())


def from_json(content: Any, kind: type[T]) -> T:
    """Convert the output of `to_json` back to a dataclass of this `kind`."""
    return msgspec.convert(content, kind, dec_hook=lambda _, array: frozen(array))


@dataclass(frozen=True)
class Cache:
    """Results by name in a folder."""

    folder: Path  # Created with the first result

    def path(self, name: str) -> Path:
        """File of the result `name`; a slash in the name makes a subfolder."""
        return Path(f"{self.folder}/{_UNSAFE.sub('-', name)}.json")

    def find(self, name: str, digest: str) -> Any:
        """Content stored under this `name` and `digest`; None if there is none."""
        found = _unsealed(self.path(name))
        if found is None or (found["name"], found["digest"]) != (name, digest):
            return None
        return found["content"]

    def digest(self, name: str) -> str | None:
        """Digest under which the result `name` is stored; None if there is none."""
        found = _unsealed(self.path(name))
        return None if found is None else found["digest"]

    def keep(self, name: str, digest: str, content: Any) -> None:
        """Store the `content` of a result under its `name` and the `digest` of its inputs."""
        body = {"content": content, "digest": digest, "name": name}
        text = json.dumps(body).encode()[1:] + b"\n"
        seal = hashlib.sha256(text).hexdigest().encode()
        # No flush (1 to 20 ms): a file cut short by a power failure is detected and recomputed.
        write_whole(self.path(name), _SEAL % seal + text, flush=False)

    def forget(self) -> None:
        """Remove all stored results and keep other files."""
        try:
            for path in self.folder.rglob("*.json"):
                found = _unsealed(path)
                if found is not None and self.path(found["name"]) == path:
                    path.unlink()
            remove_empty(self.folder)
        except OSError as error:
            problem = f"cannot be removed ({error.strerror})"
            raise OutputError(f"folder {self.folder}", problem, "remove it") from None


def _unsealed(path: Path) -> dict[str, Any] | None:
    """Content of a sealed file; None if it does not exist or its checksum is wrong."""
    try:
        if not path.is_file():  # reading a pipe would block
            return None
        text = path.read_bytes()
    except OSError:
        return None
    seal = hashlib.sha256(text[_SEALED:]).hexdigest().encode()
    if text[:_SEALED] != _SEAL % seal:
        return None
    found: dict[str, Any] = json.loads(b"{" + text[_SEALED:])
    return found


@dataclass(frozen=True)
class Steps:
    """Results of the consecutive steps of a command, all with one digest."""

    cache: Cache
    digest: str
    # Called with the name of each available result, and `found=` whether it was stored
    done: Callable[..., None] = lambda _, *, found: None
    # Names of the available results, and whether each was stored
    names: dict[str, bool] = field(default_factory=dict)

    def get(
        self,
        name: str,
        compute: Callable[[], T],
        decode: Callable[[Any], T],
        encode: Callable[[T], Any] = to_json,
    ) -> T:
        """Return the stored result `name`, or compute and store it."""
        content = self.cache.find(name, self.digest)
        if content is None:
            found = compute()
            self.cache.keep(name, self.digest, encode(found))
        else:
            found = decode(content)
        self.names[name] = content is not None
        self.done(name, found=self.names[name])
        return found

    def kept(self) -> str:
        """Message after an interruption."""
        if not self.names:
            return "no step was finished"
        done = "; ".join(self.names)
        return f"kept in {self.cache.folder}: {done}; the same command continues from there"
