"""Results of a cohort in a folder: one file a unit of work, written whole and renamed into place.

    OUT/manifest.json                  the units, their digests, the versions
    OUT/units/NAME/fit.json            a fit, sealed (`impc.files.sealed`), or
    OUT/units/NAME/failed.json         why there is none
    OUT/units/NAME/replicate-0007.json, or replicate-0007-failed.json
    OUT/cohort.log                     what happened when

A file that is there is finished work: it is never computed again, and never overwritten. One that
is damaged, or of other recordings, settings, plants or versions than the study has now, is refused.
"""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from impc.files.sealed import Kept
from impc.files.writing import IN_ITS_PLACE, require_ordinary, unwritable
from impc.reporting.writer import owned

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

_FIT = "fit"


@dataclass(frozen=True)
class Store:
    """A folder of results."""

    folder: Path  # Where the files are
    # Of every unit, by its name, as the study is now (`unit_digest`). A unit without one, because a
    # recording cannot be read, has no results.
    digests: Mapping[str, str] = field(default_factory=dict)

    def fit(self, unit: str) -> dict[str, Any] | None:
        """The fit of a unit, or None."""
        return self._find(unit, _FIT)

    def replicate(self, unit: str, index: int) -> dict[str, Any] | None:
        """The replicate `index` of a `unit`, or None."""
        return self._find(unit, _replicate(index))

    def keep_fit(self, unit: str, content: Mapping[str, Any]) -> None:
        """Write the fit of a `unit` down: `content`."""
        self._keep(unit, _FIT, "failed", content)

    def keep_replicate(self, unit: str, index: int, content: Mapping[str, Any]) -> None:
        """Write the replicate `index` of a `unit` down: `content`."""
        name = _replicate(index)
        self._keep(unit, name, f"{name}-failed", content)

    def keep_failure(self, unit: str, index: int | None, reason: str) -> None:
        """Write down why a `unit` has no fit, or no replicate `index`: the `reason`."""
        name = "failed" if index is None else f"{_replicate(index)}-failed"
        digest = self.digests.get(unit, "")
        self._kept.keep(f"{unit}/{name}", digest, {"reason": reason})

    def log(self, line: str) -> None:
        """Add a `line` to cohort.log."""
        path = self.folder / "cohort.log"
        try:
            require_ordinary(path)
            with path.open("a", encoding="utf-8") as stream:
                stream.write(line + "\n")
        except OSError as error:
            raise unwritable(f"file {path}", error, IN_ITS_PLACE) from None

    @property
    def _kept(self) -> Kept:
        return Kept(self.folder / "units")

    def _find(self, unit: str, name: str) -> dict[str, Any] | None:
        if unit not in self.digests:
            return None
        found: dict[str, Any] | None = self._kept.find(f"{unit}/{name}", self.digests[unit])
        return found

    def _keep(self, unit: str, name: str, failure: str, content: Mapping[str, Any]) -> None:
        self._kept.discard(f"{unit}/{failure}")
        self._kept.keep(f"{unit}/{name}", self.digests[unit], content)


@contextmanager
def open_store(folder: Path, digests: Mapping[str, str]) -> Iterator[Store]:
    """Hold a folder for one run of a study whose units have these `digests`."""
    with owned(folder, "cohort"):
        yield Store(folder, digests)


def _replicate(index: int) -> str:
    return f"replicate-{index:04d}"
