"""What the signals of a plant are, in words: how a page's glossary begins (docs/units.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from impc.model.plant import Plant

__all__ = ["signal_words"]


def signal_words(plant: Plant) -> tuple[tuple[str, str], ...]:
    """Each signal of a `plant` that has words, with them and its unit."""
    names = dict.fromkeys((*plant.outputs, *plant.states, *plant.controls, *plant.disturbances))
    return tuple(
        (name, f"{words[0].upper()}{words[1:]}, in {plant.unit(name)}.")
        for name in names
        if (words := plant.word(name))
    )
