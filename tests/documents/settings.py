"""A block of TOML through the package's own readers, whole or a part."""

from __future__ import annotations

import tomllib
from pathlib import Path

import msgspec

from impc.files.configuration import read_configuration
from impc.nonlinear.files import optimal_fit_settings
from impc.studies.cohort.study import StudyTable
from impc.studies.fit.settings import fit_settings, read_settings
from impc.studies.selection.settings import SelectSettings

__all__ = ["require_valid"]

# What a part lacks to be a configuration.
_SIGNAL = '\n[signals.any]\ncolumn = "any"\nunit = "1"\n'


def require_valid(text: str, folder: Path) -> None:
    """Read a block as the commands do."""
    whole = "signals" in tomllib.loads(text)
    path = folder / "block.toml"
    path.write_text(text if whole else text + _SIGNAL, encoding="utf-8")
    found = read_configuration(path, "study", "model", "select")
    path.unlink()
    (optimal_fit_settings if "parameters" in found.fit else fit_settings)(found.fit)
    read_settings("select", SelectSettings, found.select)
    msgspec.convert(found.study, StudyTable)
