"""Attach units, names and uncertainties to a `control.StateSpace`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def with_signals(system: Any, signals: Mapping[str, tuple[str, ...]]) -> Any:
    """Attach the unit of each signal and, where given, its words and what is positive."""
    for place, kind in enumerate(("units", "words", "directions")):
        given = {name: each[place] for name, each in signals.items() if len(each) > place}
        setattr(system, kind, given)
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
