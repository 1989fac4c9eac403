"""The [select] table of a study file."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from impc.errors import InputError
from impc.studies.fit.settings import read_settings

if TYPE_CHECKING:
    from collections.abc import Mapping


@dataclass(frozen=True)
class SelectSettings:
    """Settings of `impc select`."""

    bound: float = 0.05  # v, largest variance in normalised units, of the subset that is refitted
    # Of the sweep
    bounds: list[float] = field(default_factory=lambda: [0.05 + 0.1 * k for k in range(10)])
    least: int = 2  # n_min
    size: int = 5  # Parameters that the LASSO is to leave
    starts: int = 3  # Of the nominal fit
    replicates: int = 200  # Of the bootstrap
    draw: str = "block"  # How the bootstrap draws residuals
    nelder_mead: bool = False  # Whether Table C.1 is run too: slow
    seed: int = 0  # Of starts and replicates


def select_settings(table: Mapping[str, Any]) -> SelectSettings:
    """Read the [select] table."""
    found = read_settings("select", SelectSettings, table)
    _require_in_range(found)
    if found.draw not in ("single", "block"):
        raise InputError("[select] draw", f"got {found.draw!r}", "give single or block")
    return found


def _require_in_range(found: SelectSettings) -> None:
    # More replicates or starts than a thousand a day for a month are a slip of the keyboard.
    for name, value, least, most in (
        ("least", found.least, 1, 1000),
        ("size", found.size, 1, 1000),
        ("starts", found.starts, 1, 100_000),
        ("replicates", found.replicates, 2, 100_000),
        ("seed", found.seed, 0, 2**63 - 1),
    ):
        if not least <= value <= most:
            raise InputError(f"[select] {name}", f"got {value}", f"give {least} to {most}")
    for bound in (found.bound, *found.bounds):
        if not 0 < bound < math.inf:
            raise InputError("[select] bound, bounds", f"got {bound:g}", "give numbers above 0")
    if not found.bounds:
        raise InputError("[select] bounds", "is empty", "give one or more, or leave it out")
