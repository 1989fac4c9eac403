"""What a plant and its signals are, in words: for the end of every page (docs/units.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from impc.model.plant import Plant


def signal_words(plant: Plant) -> tuple[tuple[str, str], ...]:
    """Each signal of a `plant` that has words, with them and its unit."""
    names = dict.fromkeys((*plant.outputs, *plant.states, *plant.controls, *plant.disturbances))
    return tuple(
        (name, f"{words[0].upper()}{words[1:]}, in {plant.unit(name)}.")
        for name in names
        if (words := plant.word(name))
    )


def body_sentence(plant: Plant) -> str:
    """Which body every simulation of a page moved, that of a `plant` or its matrices."""
    if plant.body is None:
        return "What moves is the linear plant, by which the controller predicts too."
    return (
        "What moves are the plant's own equations, which are not linear; the controller predicts "
        "by their linearisation at rest."
    )
