"""All faults and findings of recordings at once; `recording_of` raises the first fault."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

from impc.errors import ImpcError
from impc.files.checks import fault
from impc.files.clock import column_of
from impc.files.reading import (
    clock_of,
    faults_of,
    label_of,
    names_of,
    recording_of,
    signal_of,
    unequal,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from impc.files.checks import Notice
    from impc.files.configuration import Configuration
    from impc.files.table import Table
    from impc.model.plant import Plant

T = TypeVar("T")


def examine(
    tables: Sequence[Table], configuration: Configuration, plant: Plant
) -> tuple[Notice, ...]:
    """All faults of a configuration and of recordings, and the findings of all checks, each once.

    Of each signal of a recording the first fault is given, which explains the others.
    """
    found = [fault(error) for error in faults_of(configuration, plant)]
    faulty = {one.place[1] for one in found if one.place}
    names = [name for name in names_of(configuration, plant) if name not in faulty]

    def tried(read: Callable[..., T], *given: Any) -> T | None:
        try:
            return read(*given)
        except ImpcError as error:
            found.append(fault(error))
            return None

    trials, given = [], (configuration, plant, found)
    for table in tables:
        if (trial := tried(recording_of, table, *given)) is not None:
            trials.append((table.source, trial))
            continue
        tried(label_of, table.source, configuration.recording)
        clock = tried(clock_of, table, *given)
        for name in names:
            if clock is not None:
                tried(signal_of, table, clock, name, *given)
            else:  # at least its column
                place = ("signals", name, "column")
                tried(column_of, table, configuration.signals[name].column, place)
    return tuple(dict.fromkeys([*found, *unequal(trials)]))
