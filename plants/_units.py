"""Attach units, names and uncertainties to a `control.StateSpace`."""

from __future__ import annotations

from typing import Any

__all__ = ["with_uncertainty", "with_units"]


def with_units(system: Any, units: dict[str, str], words: dict[str, str] | None = None) -> Any:
    """Attach `units` and `words` by signal name (docs/howto/recordings.md)."""
    system.units = units
    system.words = words or {}
    return system


def with_uncertainty(
    system: Any, parameters: dict[str, float], uncertainty: dict[str, float | str]
) -> Any:
    """Attach parameters and their standard deviations (in the unit, or relative as "5 %")."""
    system.parameters = parameters
    system.uncertainty = uncertainty
    return system
