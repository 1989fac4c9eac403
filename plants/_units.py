"""Units of signals and what they are, beside a `control.StateSpace` that has no place for them."""

from __future__ import annotations

from typing import Any

__all__ = ["with_uncertainty", "with_units"]


def with_units(system: Any, units: dict[str, str], words: dict[str, str] | None = None) -> Any:
    """Return the `system` with `units` and `words` by the names of signals (docs/units.md)."""
    system.units = units
    system.words = words or {}
    return system


def with_uncertainty(
    system: Any, parameters: dict[str, float], uncertainty: dict[str, float | str]
) -> Any:
    """Return the `system` with its parameters and how well they are known, by name.

    A standard deviation is in the unit of its parameter, or a share of it as "5 %".
    """
    system.parameters = parameters
    system.uncertainty = uncertainty
    return system
