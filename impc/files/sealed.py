"""Results that are kept in a folder, one JSON file each, sealed.

    {"sha256": ..., "name": ..., "digest": ..., "content": ...}

`name` says which result it is, `digest` of which recordings, plant, settings and versions
(`impc.files.digests`), `sha256` is that of the other three. A file that was damaged, edited,
renamed, or copied from another run is told from one that this run wrote, and never read as a
result.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from impc.errors import InputError, OutputError
from impc.files.writing import remove_empty, require_ordinary, write_whole

if TYPE_CHECKING:
    from pathlib import Path

_UNSAFE = re.compile(r"[^A-Za-z0-9+._/-]")


@dataclass(frozen=True)
class Kept:
    """Results by name, in a folder."""

    folder: Path  # Made when the first result is kept

    def path(self, name: str) -> Path:
        """The file of the result `name`; a slash in it makes a folder."""
        return self.folder / f"{_UNSAFE.sub('-', name)}.json"

    def find(self, name: str, digest: str) -> Any:
        """The content kept under a `name` by a run with that `digest`, or None."""
        path = self.path(name)
        try:
            require_ordinary(path)
            found = _unsealed(path.read_bytes())
        except FileNotFoundError:
            return None
        except OSError:
            found = None
        if found is None:
            raise InputError(
                f"file {path}",
                "is damaged, or not what this program wrote",
                "remove it and start again",
            )
        if (found["name"], found["digest"]) != (name, digest):
            raise InputError(
                f"file {path}",
                "was fitted to other recordings or with other settings, plant or versions",
                "give another folder, or remove it",
            )
        return found["content"]

    def recall_all(self, digest: str) -> dict[str, Any]:
        """All that runs with that `digest` kept, name -> content, oldest first."""
        found = {}
        for path in sorted(self._files(), key=lambda path: (path.stat().st_mtime_ns, path.name)):
            one = _unsealed(path.read_bytes())
            if one is not None and one["digest"] == digest and self.path(one["name"]) == path:
                found[one["name"]] = one["content"]
        return found

    def _files(self) -> list[Path]:
        files = self.folder.rglob("*.json")
        return [path for path in files if path.is_file() and os.access(path, os.R_OK)]

    def keep(self, name: str, digest: str, content: Any) -> None:
        """Write a result down: its `name`, its `content`, the `digest` of its origin."""
        body = {"content": content, "digest": digest, "name": name}
        sealed = f'{{"sha256": "{_seal(body)}", {_text(body)[1:]}\n'
        write_whole(self.path(name), sealed.encode())

    def discard(self, name: str) -> None:
        """Remove the result of that `name`, if there is one."""
        try:
            self.path(name).unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(
                f"file {self.path(name)}", f"cannot be removed ({error.strerror})", "remove it"
            ) from None

    def forget(self) -> None:
        """Remove what was kept: the final results have been written. Files of others stay."""
        try:
            for path in self._files():
                found = _unsealed(path.read_bytes())
                if found is not None and self.path(found["name"]) == path:
                    path.unlink()
            remove_empty(self.folder)
        except OSError as error:
            raise OutputError(
                f"folder {self.folder}", f"cannot be removed ({error.strerror})", "remove it"
            ) from None


def _text(body: dict[str, Any]) -> str:
    return json.dumps(body, sort_keys=True)


def _seal(body: dict[str, Any]) -> str:
    return hashlib.sha256(_text(body).encode()).hexdigest()


def _unsealed(text: bytes) -> dict[str, Any] | None:
    """What a sealed file holds; None when its seal is broken."""
    try:
        found: Any = json.loads(text)
        if not isinstance(found, dict) or set(found) != {"sha256", "name", "digest", "content"}:
            return None
        seal = found.pop("sha256")
        # Numbers are written so that they read the same again: so does the text of the rest.
        return found if seal == _seal(found) else None
    except (ValueError, RecursionError):
        return None
