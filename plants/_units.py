"""Attach units, names and uncertainties to a `control.StateSpace`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def with_units(
    system: Any,
    units: dict[str, str],
    words: dict[str, str] | None = None,
    directions: dict[str, str] | None = None,
) -> Any:
    """Attach `units`, `words` and what is positive (`directions`) by signal name."""
    system.units = units
    system.words = words or {}
    system.directions = directions or {}
    return system


def with_uncertainty(
    system: Any,
    parameters: dict[str, float],
    uncertainty: dict[str, float | str],
    arguments: Mapping[str, tuple[str, ...]],
) -> Any:
    """Attach parameters and their standard deviations (in the unit, or relative as "5 %").

    `arguments` describes arguments and parameters: name -> (words, unit, and allowed texts if only
    some are).
    """
    system.parameters = parameters
    system.uncertainty = uncertainty
    system.arguments = arguments
    return system
