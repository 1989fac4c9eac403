"""Units of signals, beside a `control.StateSpace` that has no place for them (docs/units.md)."""

from __future__ import annotations

from typing import Any

__all__ = ["with_units"]


def with_units(system: Any, units: dict[str, str]) -> Any:
    """Return the `system` with `units`, SI units by the name of a signal (docs/units.md)."""
    system.units = units
    return system
