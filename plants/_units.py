"""Units of signals and what they are, beside a `control.StateSpace` that has no place for them."""

from __future__ import annotations

from typing import Any

__all__ = ["with_units"]


def with_units(system: Any, units: dict[str, str], words: dict[str, str] | None = None) -> Any:
    """Return the `system` with `units` and `words` by the names of signals (docs/units.md)."""
    system.units = units
    system.words = words or {}
    return system
