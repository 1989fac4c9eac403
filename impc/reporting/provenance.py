"""Provenance of a result: plant, command, input files, versions and date."""

from __future__ import annotations

import importlib.metadata
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from markupsafe import Markup

from impc.files.digests import Inputs

_PACKAGES = ("impc", "casadi", "clarabel", "control", "cvxpy", "numba", "numpy", "scipy")


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed"  # for example impc itself, run from a source tree
    return found


@dataclass(frozen=True)
class Provenance:
    """Information needed to reproduce a result."""

    plant_name: str = ""  # Import path or file; empty if there is no plant
    command: str = ""  # Command line
    # Arguments of the plant's function
    plant_arguments: Mapping[str, object] = field(default_factory=dict)
    files: tuple[str, ...] = ()  # Names of the recordings, without their folders
    inputs: Inputs | None = None  # Digests of all input files; None if there are none
    # Versions of Python and of the numerical packages
    versions: Mapping[str, str] = field(default_factory=_versions)
    # Date and time of creation, UTC, ISO 8601
    made: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"))

    def data(self) -> dict[str, Any]:
        """Entries in result.json."""
        return {
            "files": self.files,
            "command": self.command,
            "versions": dict(self.versions),
            "made": self.made,
            "sha256": None if self.inputs is None else self.inputs.plain(),
        }

    @property
    def terms(self) -> list[tuple[str, str]]:
        """Terms of the section "Provenance"; unknown entries are omitted."""
        code = Markup("<code>{}</code>")
        found = [("Recordings", ", ".join(self.files))]
        found += [("Command", self.command and code.format(self.command))]
        found += [("Plant", self.plant_name and code.format(self.plant_name + self.arguments))]
        versions = ", ".join(f"{name} {version}" for name, version in self.versions.items())
        found += [("Created", self.made), ("Software", versions)]
        if self.inputs is not None:
            seal = f"{self.inputs.digest[:16]} (SHA-256 of all input files; full in result.json)"
            found.append(("Fingerprint", seal))
        return [(name, text) for name, text in found if text]

    @property
    def arguments(self) -> str:
        """Arguments of the plant in brackets."""
        given = ", ".join(f"{name} {value}" for name, value in self.plant_arguments.items())
        return f" ({given})" if given else ""
